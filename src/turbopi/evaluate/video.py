"""Films of episodes: what the cameras saw, the instruction, and the chunk that the policy predicted.

A frame is drawn with Pillow, which is a hundred times faster than a plot of its own for each.
"""

import importlib.util
import math
import struct
import textwrap
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from turbopi.evaluate.frames import Frame, lengths
from turbopi.support.errors import OutputError, TurboPiError
from turbopi.support.files import new_file

VIEW = 320  # pixels of each camera's square
PANEL = 150  # height of the chunk's plots
MARGIN = 14
END_S = 1.5  # the last frame stays
MIN_FPS = 8.0  # frames are repeated up to this rate: players stutter below it
INSTALL = "pip install 'imageio[ffmpeg]'"

Color = tuple[int, int, int]
BACKGROUND, INK, FAINT = (250, 250, 248), (32, 33, 36), (150, 152, 158)
CARRIED_OUT, MEANWHILE = (226, 231, 243), (252, 232, 196)
LEGEND = "The chunk that the policy predicted. Blue: carried out. Line: now."
DELAYED = "Amber: the chunk before was still running, while this one was computed. Rings: what it commanded."
LEGEND_HEIGHT = 18  # of a line
LINES: tuple[Color, ...] = ((31, 119, 180), (214, 102, 12), (44, 140, 60), (150, 90, 170))
NOTE, FAINT_INK = (176, 98, 0), (95, 99, 104)
ENDINGS: dict[str, Color] = {"success": (24, 128, 56), "failure": (190, 40, 40), "aborted": (190, 40, 40)}


def check_can_write() -> None:
    """Raise TurboPiError with the install command if videos can't be written."""
    if any(importlib.util.find_spec(name) is None for name in ("imageio", "imageio_ffmpeg")):
        raise TurboPiError(f"videos need imageio and ffmpeg: {INSTALL}, or give --videos none")


def write_video(path: Path, frames: Sequence[Frame], caption: str, ending: str, robot: str, control_hz: float) -> None:
    """An MP4 at the robot's own speed, `control_hz` steps of it a second. Frames may be unevenly far apart."""
    import imageio.v2 as imageio

    path.parent.mkdir(parents=True, exist_ok=True)
    shown = lengths(frames)  # control steps
    unit = math.gcd(*shown[:-2]) if len(shown) > 2 else shown[0]  # the episode ends at any step
    repeats = max(1, int(np.ceil(MIN_FPS * unit / control_hz)))
    fps = control_hz / unit * repeats
    delayed = any(frame.entered for frame in frames)
    groups = chunk_groups(robot, frames[0].chunk.shape[1])
    options: dict[str, Any] = {"fps": fps, "codec": "libx264", "quality": 7, "macro_block_size": 2}
    writer: Any  # imageio's own types lack the methods of its writers
    with new_file(path, ending=path.suffix) as temporary:
        with imageio.get_writer(temporary, **options) as writer:
            for number, frame in enumerate(frames):
                last = number == len(frames) - 1
                camera_image = draw_frame(frame, caption, groups, ending if last else None, delayed=delayed)
                times = 1 if last else math.ceil(shown[number] / unit)
                for _ in range(times * repeats + (round(END_S * fps) if last else 0)):
                    writer.append_data(camera_image)
        if not _is_finished(temporary):  # imageio doesn't tell that ffmpeg has failed
            raise OutputError(f"can't write {path}: ffmpeg could not finish it; is there room?")


def _is_finished(on_frame: Path) -> bool:
    """Whether an MP4 has all of its boxes, among them the index, which comes last. (ISO/IEC 14496-12, 4.2)"""
    size, at, kinds = on_frame.stat().st_size, 0, set()
    with on_frame.open("rb") as stream:
        while at + 8 <= size:
            stream.seek(at)
            length, kind = struct.unpack(">I4s", stream.read(8))
            if length == 1:
                (length,) = struct.unpack(">Q", stream.read(8).ljust(8, b"\0"))
            if length < 8:
                return False
            at += length
            kinds.add(kind)
    return at == size and b"moov" in kinds


def chunk_groups(robot: str, width: int) -> list[tuple[str, dict[int, str]]]:
    """How the action's numbers belong together: (title, {index: name})."""
    from turbopi.support.action_groups import action_groups

    return [(group.title, dict(list(group.names.items())[: len(LINES)])) for group in action_groups(robot, width)]


def draw_frame(
    frame: Frame,
    caption: str,
    groups: Sequence[tuple[str, dict[int, str]]],
    ending: str | None,
    *,
    delayed: bool = False,
) -> np.ndarray:
    """One frame of a video: uint8[h, w, 3], both even. `delayed`: the video's chunks took over after a delay."""
    width = len(frame.camera_images) * VIEW + (len(frame.camera_images) + 1) * MARGIN
    lines = textwrap.wrap(caption, width=max(20, width // 9))
    top = MARGIN + 22 * len(lines) + 6
    legend = [LEGEND, DELAYED] if delayed else [LEGEND]
    bottom = top + VIEW + MARGIN + PANEL
    height = bottom + 6 + LEGEND_HEIGHT * len(legend) + 6
    image = Image.new("RGB", (width + width % 2, height + height % 2), BACKGROUND)
    draw = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        draw.text((MARGIN, MARGIN - 4 + 22 * number), line, fill=INK, font=_font(17))
    for number, camera_image in enumerate(frame.camera_images):
        view = Image.fromarray(camera_image).resize((VIEW, VIEW), Image.Resampling.BILINEAR)
        image.paste(view, (MARGIN + number * (VIEW + MARGIN), top))
    _tag(draw, (MARGIN + 8, top + 8), f"step {frame.step}", INK)
    if frame.note:
        _tag(draw, (MARGIN + 8, top + VIEW - 32), frame.note, NOTE)
    if ending is not None:
        _tag(draw, (MARGIN + 8, top + 36), ending, ENDINGS[ending])
    step = (width - MARGIN) / len(groups)
    for number, (title, names) in enumerate(groups):
        left = MARGIN + number * step
        box = (left, top + VIEW + MARGIN, left + step - MARGIN, bottom)
        _draw_group(draw, box, title, names, frame)
    for number, line in enumerate(legend):
        draw.text((MARGIN, bottom + 6 + LEGEND_HEIGHT * number), line, fill=FAINT_INK, font=_font(12))
    return np.asarray(image)


def _draw_group(
    draw: ImageDraw.ImageDraw,
    box: tuple[float, float, float, float],
    title: str,
    names: dict[int, str],
    frame: Frame,
) -> None:
    """The chunk's lines of one group, in [-1, 1] or further; the part that is carried out is shaded.

    So is the part before it, during which the robot carried out the chunk before: that one's commands are rings.
    """
    x0, y0, x1, y1 = box
    chunk = frame.chunk
    draw.text((x0, y0), title, fill=INK, font=_font(13))
    x = x0 + draw.textlength(title, font=_font(13)) + 8
    if len(names) > 1:
        for number, name in enumerate(names.values()):
            draw.text((x, y0 + 1), name, fill=LINES[number], font=_font(12))
            x += draw.textlength(name, font=_font(12)) + 7
    y0 += 20
    columns = list(names)
    before = frame.before[:, columns] if len(frame.before) else np.zeros((0, len(columns)))
    values = np.concatenate((chunk[:, columns], before))
    finite = values[np.isfinite(values)]
    limit = max(1.0, float(np.abs(finite).max()) if finite.size else 1.0)

    def place(row: float, value: float) -> tuple[float, float]:
        across = row / max(1, len(chunk) - 1)
        return x0 + across * (x1 - x0), (y0 + y1) / 2 - value / limit * (y1 - y0) / 2

    seam = place(max(frame.entered - 0.5, 0), 0)[0]
    if frame.planned > frame.entered:
        draw.rectangle((seam, y0, max(place(frame.planned - 1, 0)[0], seam), y1), fill=CARRIED_OUT)
    if frame.entered:
        draw.rectangle((x0, y0, seam, y1), fill=MEANWHILE)
    if frame.done:
        now = place(frame.done - 1, 0)[0]
        draw.line((now, y0, now, y1), fill=FAINT, width=2)
    draw.rectangle((x0, y0, x1, y1), outline=(205, 207, 212))
    draw.line((*place(0, 0), *place(len(chunk) - 1, 0)), fill=(215, 217, 222))
    for number, column in enumerate(columns):
        rows = [row for row in range(len(chunk)) if np.isfinite(chunk[row, column])]
        unused = [row for row in rows if row < frame.entered]
        for part, color in ((unused, _faded(LINES[number])), (rows[len(unused) :], LINES[number])):
            points = [place(row, chunk[row, column]) for row in part]
            if len(points) > 1:
                draw.line(points, fill=color, width=2)
            for px, py in points:
                draw.ellipse((px - 2, py - 2, px + 2, py + 2), fill=color)
        for row, value in enumerate(before[:, number], start=frame.entered - len(before)):
            px, py = place(row, value)
            draw.ellipse((px - 4, py - 4, px + 4, py + 4), outline=LINES[number], width=2)
    draw.text((x0 + 4, y0 + 2), f"{limit:.2g}", fill=FAINT, font=_font(11))
    draw.text((x0 + 4, y1 - 16), f"-{limit:.2g}", fill=FAINT, font=_font(11))


def _faded(color: Color) -> Color:
    red, green, blue = (part + (255 - part) * 3 // 5 for part in color)
    return red, green, blue


def _tag(draw: ImageDraw.ImageDraw, place: tuple[float, float], text: str, color: Color) -> None:
    x, y = place
    width = draw.textlength(text, font=_font(14))
    draw.rounded_rectangle((x, y, x + width + 14, y + 22), radius=5, fill=(255, 255, 255), outline=color)
    draw.text((x + 7, y + 2), text, fill=color, font=_font(14))


@lru_cache
def _font(size: int) -> Any:
    return ImageFont.load_default(size)
