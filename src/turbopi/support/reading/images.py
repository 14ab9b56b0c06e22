"""Images in files."""

import warnings
from pathlib import Path
from typing import IO

import numpy as np
from PIL import Image, UnidentifiedImageError

from turbopi.support.errors import ObservationError
from turbopi.support.reading.files import one_line, open_file

IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "PPM")  # of files: each is decoded by Pillow itself, in this process
MAX_PIXELS = 50_000_000  # of an image in a file
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA", "RGBX", "CMYK", "YCbCr")  # 8 bits a channel, or fewer


def read_image(file: str | Path) -> np.ndarray:
    """The image in a file, RGB uint8[h, w, 3]; transparency is dropped.

    Raises ObservationError for what is none of IMAGE_FORMATS (whatever its name; an EPS would be handed to
    Ghostscript), is damaged, has more than MAX_PIXELS, which is checked before anything is decoded, or has more than 8
    bits a channel, which Pillow would clip.
    """
    with open_file(file, ObservationError) as stream:
        return decode_image(stream, file)


def decode_image(
    stream: IO[bytes], name: object, *, most: int = MAX_PIXELS, formats: tuple[str, ...] = IMAGE_FORMATS
) -> np.ndarray:
    """The image in an open file, as `read_image`, of at most `most` pixels; `name` begins the messages."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # refused below
            image = Image.open(stream, formats=formats)
        if image.width * image.height > most:
            raise ObservationError(f"{name} has {image.width} x {image.height} pixels; at most {most} are read")
        if image.mode not in _MODES:
            raise ObservationError(f"{name} has pixels of mode {image.mode}; expected 8 bits a channel, such as RGB")
        return np.array(image.convert("RGB"))
    except ObservationError:
        raise
    except Exception as reason:  # damage makes Pillow's decoders raise a dozen classes
        what = "neither a readable image nor .npy" if formats is IMAGE_FORMATS else "no readable image"
        why = "damaged, or of another format" if isinstance(reason, UnidentifiedImageError) else one_line(reason)
        raise ObservationError(f"{name} is {what} ({why}). Images are read as {', '.join(formats)}") from reason
