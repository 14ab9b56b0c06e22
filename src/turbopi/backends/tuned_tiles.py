"""Files of measured tiles: which one an engine takes on this GPU, and why another isn't used.

`turbopi tune` writes one file a GPU into the cache; files of the same form for some GPUs ship in data/tiles. They are
read once, when an engine is made. A tile of the user's own file goes before a shipped one, and that before the kernels'
hand-made tables and cost model.
"""

import hashlib
import importlib
import json
import logging
import os
import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Annotated, Final

import torch
from msgspec import Meta, Struct

from turbopi.kernels.tile_table import LIBRARY, NO_TILES, Kernels, Knobs, Numbers, TileKey, TileTable
from turbopi.support.errors import ConfigError
from turbopi.support.files import cache_folder, make_folder, write_whole
from turbopi.support.provenance import driver_version
from turbopi.support.reading import plain_document, read_document
from turbopi.support.source_code import code_of

logger = logging.getLogger(__name__)

TUNED_VARIABLE: Final = "TURBOPI_TUNED"
PACKAGE: Final = Path(__file__).resolve().parents[1]
SHIPPED: Final = PACKAGE / "data" / "tiles"
COMMAND: Final = "`turbopi tune`"
# What the measured time of a tile depends on
SOURCES: Final[dict[Kernels, tuple[str, ...]]] = {
    "portable": (
        *("kernels/portable/gemm/*.py", "kernels/portable/a*.py", "kernels/portable/batch.py"),
        *("kernels/portable/norms.py", "kernels/portable/products.py", "kernels/dependent_launch.py"),
    ),
    "hopper": (
        *("kernels/sm90/gemm/*", "kernels/sm90/norms/*", "kernels/sm90/instructions.*"),
        *("kernels/portable/norms.py", "kernels/portable/activations.py", "kernels/portable/products.py"),
    ),
}
_Size = Annotated[int, Meta(ge=1)]
_Microseconds = Annotated[float, Meta(gt=0)]


class TunedTile(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The fastest tile of one operation. Sizes and tiles: see `kernels.tile_table`.

    Microseconds are of the operation with the norms around it; of the expert's in a batch of its whole layer.
    """

    name: str  # "prefix gate, up"
    kernels: Kernels
    operation: str
    numbers: Numbers
    rows: _Size
    columns: _Size
    inner: _Size
    tile: dict[str, int]
    microseconds: _Microseconds
    usual: dict[str, int] | None = None  # what runs without this file; None: the same
    usual_microseconds: _Microseconds

    @property
    def key(self) -> TileKey:
        return TileKey(self.kernels, self.operation, self.numbers, self.rows, self.columns, self.inner)


class TileFile(Struct, frozen=True, kw_only=True):
    """What `turbopi tune` writes. fingerprints: of the kernels' source, by kernels. triton: its version; older files
    have none.
    """

    gpu: str
    compute_capability: Annotated[str, Meta(pattern=r"^\d+\.\d+$")]
    multiprocessors: _Size
    driver: str
    triton: str | None = None
    turbopi: str
    date: str  # "2026-11-24", UTC
    fingerprints: dict[Kernels, str]
    tiles: list[TunedTile]


@dataclass(frozen=True)
class Machine:
    """The GPU that tiles are for."""

    gpu: str
    capability: tuple[int, int]
    multiprocessors: int
    driver: str
    triton: str

    @classmethod
    def of(cls, device: torch.device) -> "Machine":
        properties = torch.cuda.get_device_properties(device)
        capability = (properties.major, properties.minor)
        versions = driver_version(), triton_version()
        return cls(properties.name, capability, properties.multi_processor_count, *versions)

    @property
    def compute_capability(self) -> str:
        return f"{self.capability[0]}.{self.capability[1]}"


def triton_version() -> str:
    """As the module says, which comes in packages of several names; "none" where it isn't installed."""
    try:
        return str(importlib.import_module("triton").__version__)
    except ImportError:
        return "none"


@dataclass(frozen=True)
class Tiles:
    """What an engine is made with.

    about    in words, for `describe()` and `turbopi doctor`
    unused   a line for each file that isn't used: why, and what to do
    """

    table: TileTable
    about: str
    unused: tuple[str, ...] = ()


BY_MODEL: Final = "none measured here: the kernels' own tables and cost model choose"


def tuned_off() -> bool:
    """Whether TURBOPI_TUNED=off asks for no measured tiles. Unset or "auto": no. ConfigError for another value."""
    value = os.environ.get(TUNED_VARIABLE, "auto")
    if value not in ("auto", "off"):
        raise ConfigError(f"{TUNED_VARIABLE} is {value!r}; expected 'auto' (or unset) or 'off'")
    return value == "off"


def own_file(gpu: str, folder: Path | None = None) -> Path:
    """Where `turbopi tune` keeps the tiles of a GPU of that name."""
    slug = re.sub(r"[^a-z0-9]+", "-", gpu.lower()).strip("-")
    return (folder or cache_folder()) / "tiles" / f"{slug}.json"


def tiles_of(device: torch.device) -> Tiles:
    """The tiles of an engine on this device. A line of the log names each file that isn't used."""
    if device.type != "cuda":
        return Tiles(NO_TILES, BY_MODEL)
    if tuned_off():
        return Tiles(NO_TILES, f"measured ones are switched off by {TUNED_VARIABLE}; {BY_MODEL.partition(': ')[2]}")
    tiles = find_tiles(Machine.of(device))
    for line in tiles.unused:
        logger.warning("%s", line)
    return tiles


def find_tiles(machine: Machine, *, cache: Path | None = None, shipped: Path | None = None, own: bool = True) -> Tiles:
    """What the user's own file (unless not `own`) and the shipped ones have for this GPU.

    Damaged and stale files are named, not used.
    """
    table: dict[TileKey, Knobs] = {}
    used: list[str] = []
    unused: list[str] = []
    users = own_file(machine.gpu, cache)
    for file in (
        *sorted((shipped or SHIPPED).glob("*.json")),
        *((users,) if own else ()),
    ):  # the last one goes before the others
        ships = file != users
        if not os.path.isfile(file):  # nor is one in a folder that can't be read
            continue
        try:
            document = read_tile_file(file)
        except ConfigError as error:
            unused.append(f"tiles aren't used: {error}; measure them again with {COMMAND}, or delete the file")
            continue
        if ships and document.gpu != machine.gpu:
            continue
        found, why = usable(document, machine, ships=ships)
        if why is not None and not ships:  # of what ships, nothing is for the user to mend
            unused.append(f"{file}: {why}; measure again with {COMMAND}")
        if found:
            table |= {one.key: one.tile for one in found}
            origin = "shipped" if ships else f"measured here, {file}"
            used.append(f"{len(found)} tile{'s' * (len(found) > 1)} of {document.date} ({origin})")
    about = "; ".join(reversed(used)) or BY_MODEL
    return Tiles(TileTable(table), about, tuple(unused))


def usable(document: TileFile, machine: Machine, *, ships: bool = False) -> tuple[list[TunedTile], str | None]:
    """(the tiles that hold on this GPU, why others don't). A shipped file holds for every driver and Triton."""
    for what, theirs, ours in (
        ("on a GPU called", document.gpu, machine.gpu),
        ("on compute capability", document.compute_capability, machine.compute_capability),
        ("on so many multiprocessors:", document.multiprocessors, machine.multiprocessors),
        *(() if ships else (("with driver", document.driver, machine.driver),)),
        *(() if ships else (("with Triton", document.triton, machine.triton),)),
    ):
        if theirs != ours:
            theirs = "of an unknown version" if theirs is None else theirs
            return [], f"tiles aren't used, as they were measured {what} {theirs}, and here it is {ours}"
    current = {kernels for kernels, found in document.fingerprints.items() if found == fingerprint(kernels)}
    found = [one for one in document.tiles if one.kernels in current]
    stale = sorted({one.kernels for one in document.tiles} - current)
    if not stale:
        return found, None
    return found, f"tiles of the {' and '.join(stale)} kernels aren't used, as these have changed since"


@cache
def fingerprint(kernels: Kernels) -> str:
    """A hash of the code of these kernels, without comments."""
    files = sorted(file for glob in SOURCES[kernels] for file in PACKAGE.glob(glob) if file.suffix in (".py", ".cu"))
    text = "\0".join(f"{file.relative_to(PACKAGE).as_posix()}\0{code_of(file)}" for file in files)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def read_tile_file(file: Path) -> TileFile:
    """Raises ConfigError for another file, and for a tile that its GPU doesn't take.

    Tiles of kernels that have changed since aren't looked at: they aren't used.
    """
    document = read_document(file, TileFile, ConfigError)
    from turbopi.kernels.tile_checks import why_not

    major, minor = document.compute_capability.split(".")
    for i, one in enumerate(document.tiles):
        if document.fingerprints.get(one.kernels) != fingerprint(one.kernels):
            continue
        for field in ("tile", "usual"):
            knobs: Knobs = getattr(one, field) or one.tile
            if (why := why_not(one.key, knobs, (int(major), int(minor)))) is not None:
                raise ConfigError(f"{file}: tiles[{i}].{field} is {dict(knobs)}: {why}")
    return document


def write_tile_file(document: TileFile, file: Path) -> None:
    """Whole or not at all, a tile on a line. Raises OutputError if it can't be written."""
    make_folder(file)
    about = plain_document(document)
    tiles = ",\n".join(json.dumps(plain_document(tile), separators=(",", ":")) for tile in document.tiles)
    del about["tiles"]
    begin = json.dumps(about, indent=1).removesuffix("\n}")
    write_whole(file, f'{begin},\n "tiles": [\n{tiles}\n]\n}}\n')


def knobs_text(knobs: Knobs) -> str:
    """A tile in a few characters: "128x256 w8 s3" is rows x columns, warps, stages."""
    if LIBRARY in knobs:
        return "cuBLAS" if knobs[LIBRARY] == 1 else f"cuBLAS in {knobs[LIBRARY]}"
    rows = knobs["rows"] if "rows" in knobs else 64 * knobs["warpgroups"]
    text = [f"{rows}x{knobs.get('columns', knobs.get('keys'))}"]
    if "warps" in knobs:
        text += [f"w{knobs['warps']}", f"s{knobs['stages']}"]
    if knobs.get("cluster_m", 1) * knobs.get("cluster_n", 1) > 1:
        text.append(f"c{knobs['cluster_m']}x{knobs['cluster_n']}")
    if knobs.get("splits", 1) > 1:
        text.append(f"/{knobs['splits']}" + "g" * knobs.get("gather", 0))
    text += ["overlap"] * knobs.get("overlap", 0)
    if knobs.get("ring", 16) != 16:
        text.append(f"r{knobs['ring']}")
    return " ".join(text)
