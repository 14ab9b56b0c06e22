#!/usr/bin/env python3
"""Make docs/acting.webp of a video that `turbopi eval` wrote: README's animation, at most 200 KB.

    turbopi eval libero src/turbopi/data/small_policy --tasks 2 --initial-states 30 --videos all --smooth-videos \\
        --precision f32 --out RUN
    python scripts/make_readme_animation.py RUN/videos/task02_state30_success.mp4

It needs turbopi[libero]. LIBERO's renders are MIT licensed, Copyright (c) 2023 Lifelong Robot Learning.
"""

import argparse
from pathlib import Path

import imageio.v3 as iio
from PIL import Image

OUT = Path(__file__).parent.parent / "docs" / "acting.webp"
WIDTH, EVERY, LAST, MILLISECONDS, QUALITY = 400, 3, 6, 120, 50  # every third frame; the last one stays


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    frames = list(iio.imread(parser.parse_args().video))
    height = round(len(frames[0]) * WIDTH / len(frames[0][0]))
    first, *others = (Image.fromarray(one).resize((WIDTH, height)) for one in frames[::EVERY] + [frames[-1]] * LAST)
    first.save(
        OUT,
        save_all=True,
        append_images=others,
        duration=MILLISECONDS,
        loop=0,
        quality=QUALITY,
        method=6,
        minimize_size=True,
        allow_mixed=True,
    )
    print(f"{OUT}: {1 + len(others)} frames, {OUT.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
