#!/usr/bin/env python3
"""Make docs/acting.gif of a video that `turbopi eval` wrote: README's animation, at most 400 KB.

    turbopi eval libero src/turbopi/data/small_policy --tasks 2 --initial-states 30 --videos all --smooth-videos \\
        --precision f32 --out RUN
    python scripts/make_readme_gif.py RUN/videos/task02_state30_success.mp4

It needs turbopi[libero]. LIBERO's renders are MIT licensed, Copyright (c) 2023 Lifelong Robot Learning.
"""

import argparse
import itertools
from pathlib import Path

import imageio.v3 as iio
import numpy as np
from PIL import Image

OUT = Path(__file__).parent.parent / "docs" / "acting.gif"
WIDTH, EVERY, LAST, MILLISECONDS, COLOURS = 400, 3, 6, 120, 64  # every third frame; the last one stays
STILL = 6  # of 255: a pixel that changes by no more than that keeps its colour, which makes the file a third smaller


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    frames = list(iio.imread(parser.parse_args().video))
    height = round(len(frames[0]) * WIDTH / len(frames[0][0]))
    chosen = [Image.fromarray(frame).resize((WIDTH, height)) for frame in frames[::EVERY] + [frames[-1]] * LAST]
    for before, now in itertools.pairwise(range(len(chosen))):
        was, is_now = np.asarray(chosen[before]), np.asarray(chosen[now])
        still = np.abs(was.astype(int) - is_now).max(axis=-1, keepdims=True) <= STILL
        chosen[now] = Image.fromarray(np.where(still, was, is_now))
    some = Image.new("RGB", (WIDTH, 4 * height))  # one palette, of four of them
    for i, image in enumerate(chosen[:: max(1, len(chosen) // 4)][:4]):
        some.paste(image, (0, i * height))
    palette = some.quantize(COLOURS)
    first, *others = (image.quantize(palette=palette, dither=Image.Dither.NONE) for image in chosen)
    first.save(OUT, save_all=True, append_images=others, duration=MILLISECONDS, loop=0, optimize=True)
    print(f"{OUT}: {len(chosen)} frames, {OUT.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
