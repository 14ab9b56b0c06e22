"""Frames of a video at given times, with PyAV."""

from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from turbopi.support.errors import ConfigError, ObservationError
from turbopi.support.installation import install_command
from turbopi.support.reading import one_line

SEEK_SECONDS = 3.0  # a gap that is longer is jumped over, to the key frame before its end


def frames_at(file: Path, times: Sequence[float], fps: float) -> Iterator[np.ndarray]:
    """uint8[h, w, 3] RGB of the frame at each of these times, in seconds, which rise.

    A frame is the one at a time if it is within half a frame's time of it. Raises ObservationError if there is none, or
    if the video can't be read.
    """
    if find_spec("av") is None:
        raise ConfigError(f"{file} is a video, and PyAV isn't installed; install it with: {install_command('replay')}")
    import av

    near = 0.5 / fps
    try:
        with av.open(str(file)) as container:
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            if stream.time_base is None:
                raise ObservationError(f"{file} has no times")
            decoder = container.decode(stream)
            now = -float("inf")  # the time of the last frame
            for time in times:
                if time - now > SEEK_SECONDS:
                    container.seek(max(0, int((time - near) / stream.time_base)), stream=stream)
                    decoder = container.decode(stream)
                frame = next((one for one in decoder if one.time is not None and one.time > time - near), None)
                if frame is None or frame.time is None or frame.time > time + near:
                    found = "it ends before" if frame is None else f"the next one is at {frame.time:.4f} s"
                    raise ObservationError(
                        f"{file} has no frame at {time:.4f} s ({found}). The dataset says {fps:g} frames a second: do "
                        "its videos have another rate, or is this file incomplete?"
                    )
                now = frame.time
                yield frame.to_ndarray(format="rgb24")
    except (av.FFmpegError, IndexError, ValueError) as error:
        raise ObservationError(f"{file} isn't a readable video: {type(error).__name__} {one_line(error)}") from error
