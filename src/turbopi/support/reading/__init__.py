"""Reading files that others wrote: JSON and NumPy arrays.

A file may be damaged, made by another program, or hostile. Whatever is wrong with it becomes one line: an error of the
caller's class that names the file, the key, the value and what was expected. Before anything is built from a file, its
size, its depth and the sizes that it claims are checked, so that it costs neither gigabytes nor minutes.

    content = read_json(file)                        an object, or CheckpointError
    fields = Fields(content, file)                   its values, one by one, checked
    horizon = fields.integer("action_horizon", 1, 1024)
    line = read_document(file, Line)                 all of them at once, as a kind of document (documents.py)
    arrays = read_npz(file)                          name -> array
    noise = read_npy(file)

An .npz is checked by its CRC-32, so damage to its numbers is found. Neither an .npy nor a JSON file has a checksum: a
flipped digit in one that still reads well stays unnoticed.
"""

import importlib
from typing import TYPE_CHECKING

from turbopi.support.reading.fields import Fields, is_finite, is_integer
from turbopi.support.reading.files import file_inside, files_below, listing, one_line, open_file, read_bytes, shown
from turbopi.support.reading.json import MAX_JSON_BYTES, MAX_JSON_DEPTH, parse_json, read_json

if TYPE_CHECKING:
    from turbopi.support.reading.arrays import MAX_ARRAY_BYTES, Npz, read_npy, read_npz
    from turbopi.support.reading.documents import as_document, plain_document, read_document

__all__ = [
    "MAX_ARRAY_BYTES",
    "MAX_JSON_BYTES",
    "MAX_JSON_DEPTH",
    "Fields",
    "Npz",
    "as_document",
    "file_inside",
    "files_below",
    "is_finite",
    "is_integer",
    "listing",
    "one_line",
    "open_file",
    "parse_json",
    "plain_document",
    "read_bytes",
    "read_document",
    "read_json",
    "read_npy",
    "read_npz",
    "shown",
]

_MODULES = {  # imported when asked for: `turbopi --help` needs no NumPy, a robot's client no msgspec
    **dict.fromkeys(("MAX_ARRAY_BYTES", "Npz", "read_npy", "read_npz"), "arrays"),
    **dict.fromkeys(("as_document", "plain_document", "read_document"), "documents"),
}


def __getattr__(name: str) -> object:
    if name not in _MODULES:
        raise AttributeError(f"module 'turbopi.support.reading' has no attribute {name!r}")
    found: object = getattr(importlib.import_module(f"turbopi.support.reading.{_MODULES[name]}"), name)
    return found
