#!/usr/bin/env python3
"""Make docs/acting.gif of a video that `turbopi eval` wrote: README's moving picture, at most 600 KB.

    turbopi eval libero src/turbopi/data/small_policy --tasks 2 --initial-states 30 --videos all --smooth-videos \\
        --precision f32 --out RUN
    python scripts/make_readme_gif.py RUN/videos/task02_state30_success.mp4

It needs turbopi[libero]. LIBERO's renders are MIT licensed, Copyright (c) 2023 Lifelong Robot Learning.
"""

import argparse
from pathlib import Path

import imageio.v3 as iio
from PIL import Image

OUT = Path(__file__).parent.parent / "docs" / "acting.gif"
WIDTH, EVERY, LAST, MILLISECONDS, COLOURS = 400, 3, 6, 120, 64  # every third frame; the last one stays


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    frames = list(iio.imread(parser.parse_args().video))
    height = round(len(frames[0]) * WIDTH / len(frames[0][0]))
    chosen = [Image.fromarray(frame).resize((WIDTH, height)) for frame in frames[::EVERY] + [frames[-1]] * LAST]
    some = Image.new("RGB", (WIDTH, 4 * height))  # one palette, of four of them
    for i, image in enumerate(chosen[:: max(1, len(chosen) // 4)][:4]):
        some.paste(image, (0, i * height))
    palette = some.quantize(COLOURS)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in chosen)
    first.save(OUT, save_all=True, append_images=others, duration=MILLISECONDS, loop=0, optimize=True)
    print(f"{OUT}: {len(chosen)} frames, {OUT.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
