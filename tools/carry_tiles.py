"""Keeps measured tiles whose machine code a change of the kernels' source has left as it was.

    PYTHONPATH=src:tools python -m carry_tiles REVISION [--check]

The files in src/turbopi/data/tiles say with which source their tiles were measured, and of another none is used. But
most changes leave most kernels alone. This compares each tile of Hopper's GEMMs as it is at REVISION, whose source the
files name, with what it is here: the CUDA source and constants of all its forms, and how they are launched; where these
differ, the machine code that they compile to. A tile of the same code, launched in the same way, is kept under today's
source; another is taken out and named: `turbopi tune --only-missing` measures it again. A GPU isn't needed, NVRTC is
where sources differ. Of new candidates it knows nothing: take the rows out for which there are some. The Triton kernels
around the GEMMs aren't compiled: where the code of their files has changed, nothing is kept.
With --check the files stay as they are; exit code 1 if a tile would be taken out.
"""

import argparse
import hashlib
import itertools
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace as replace_tile
from functools import partial
from pathlib import Path
from typing import Any

from msgspec.structs import replace

from turbopi.backends.tuned_tiles import PACKAGE, SHIPPED, SOURCES, TileFile, TunedTile, fingerprint, write_tile_file
from turbopi.kernels import nvrtc
from turbopi.kernels.sm90.gemm import bf16, fp8
from turbopi.kernels.sm90.gemm.bf16 import Epilogue, Tile
from turbopi.kernels.sm90.gemm.candidates import epilogue_with
from turbopi.kernels.sm90.gemm.products import ADDING_ROWS, from_knobs
from turbopi.support.errors import ConfigError
from turbopi.support.reading import read_document
from turbopi.support.source_code import code_of

ARCH = "sm_90a"
PARTS = 12  # of the sums of a row: any number gives a kernel of that form
ROOT = PACKAGE.parents[1]


def forms(one: TunedTile, tile: Tile) -> Iterator[tuple[str, dict[str, int]]]:
    """The source and the constants of each kernel that the engine may launch for an operation with its tile."""
    in_fp8, residual = one.numbers == "fp8", one.operation == "residual"
    copies = (0, PARTS) if residual else (0,)
    norms = (0, PARTS) if one.operation in ("bias", "gelu") and tile.splits == 1 else (0,)
    for epilogue, parts, copied in itertools.product(epilogues(one, tile), norms, copies):
        of_norm = replace_tile(tile, overlap=False) if parts else tile
        takes = bf16.parameters(fp8=in_fp8, residual=residual, normed=parts > 0, copied=copied > 0)
        source = bf16.source(tile.columns, takes, fp8=in_fp8)
        if not in_fp8:
            yield source, bf16.constants(of_norm, epilogue, residual, parts, copied)
            continue
        promote = fp8.promotion(of_norm, one.inner)
        for out_fp8 in (False, True) if one.operation in ("gelu", "geglu") else (False,):
            yield source, fp8.constants(of_norm, epilogue, out_fp8, promote, residual, parts, copied)


def epilogues(one: TunedTile, tile: Tile) -> list[Epilogue]:
    """Of many rows a whole product may be added to the residual stream, or leave as that of few."""
    found = [epilogue_with(one.operation, tile, one.numbers == "fp8", adds) for adds in (False, True)]
    if one.rows < ADDING_ROWS or found[1] != "added":
        return found[:1]
    return ["plain", "added"] if tile.overlap and found[0] == "parts" else found


def machine_code(one: TunedTile, *, compiling: bool = True) -> str:
    """A hash of the machine code of all forms and of how they are launched, or unless `compiling` of what they are
    compiled from; of the library's tiles, which have none here, the same for all.
    """
    tile, digest = from_knobs(one.tile), hashlib.sha256()
    if isinstance(tile, Tile):
        in_fp8 = one.numbers == "fp8"
        steps = -(-one.inner // (fp8.DEPTH if in_fp8 else bf16.DEPTH))
        launched = bf16.layout(tile, epilogues(one, tile)[-1], one.rows, one.columns, steps, None, None)
        digest.update(repr((launched, bf16.clusters(tile, math.prod(launched[1]), 1 << 20))).encode())
        for source, constants in forms(one, tile):
            of_form = nvrtc.compile_cubin(source, ARCH, constants) if compiling else repr((source, constants)).encode()
            digest.update(of_form)
    return digest.hexdigest()[:16]


def compiled(tiles: list[TunedTile], *, compiling: bool = True) -> dict[str, str]:
    """{a tile's key: its `machine_code`} of Hopper's GEMMs."""
    code = partial(machine_code, compiling=compiling)
    products = [one for one in tiles if one.kernels == "hopper"]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return {str(one.key): code for one, code in zip(products, pool.map(code, products), strict=True)}


def other_sources(package: Path) -> dict[str, str]:
    """The code that measured times depend on besides the products' own, by file."""
    files = (file for glob in SOURCES["hopper"] if "sm90" not in glob for file in package.glob(glob))
    return {file.relative_to(package).as_posix(): code_of(file) for file in files}


def carried(document: TileFile, before: dict[str, str], now: dict[str, str]) -> tuple[TileFile, list[TunedTile]]:
    """The document under today's source, and the tiles that it has no more."""
    lost = [one for one in document.tiles if str(one.key) in now and before[str(one.key)] != now[str(one.key)]]
    kept = [one for one in document.tiles if one not in lost]
    return replace(document, tiles=kept, fingerprints=document.fingerprints | {"hopper": fingerprint("hopper")}), lost


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("revision", help="whose source the tiles were measured with, as git names it")
    parser.add_argument("--check", action="store_true", help="change no file")
    parser.add_argument("--codes", type=Path, help=argparse.SUPPRESS)  # of this file's tiles, for the other revision
    parser.add_argument("--sources", action="store_true", help=argparse.SUPPRESS)  # what they are compiled from
    arguments = parser.parse_args()
    if arguments.codes is not None:
        document = read_document(arguments.codes, TileFile, ConfigError)
        print(
            json.dumps(
                {
                    "fingerprint": fingerprint("hopper"),
                    "codes": compiled(document.tiles, compiling=not arguments.sources),
                }
            )
        )
        return 0
    with tempfile.TemporaryDirectory() as folder:
        old = source_at(arguments.revision, Path(folder))
        if other_sources(old / "turbopi") != other_sources(PACKAGE):
            print("norms, activations or the library's products have changed, too: measure again")
            return 1
        return max(carry(file, old, arguments.revision, arguments.check) for file in sorted(SHIPPED.glob("*.json")))


def source_at(revision: str, folder: Path) -> Path:
    """Unpacks a revision's src there."""
    archive = subprocess.run(["git", "archive", revision, "src"], cwd=ROOT, check=True, stdout=subprocess.PIPE)
    subprocess.run(["tar", "x", "-C", folder], input=archive.stdout, check=True)
    return folder / "src"


def carry(file: Path, old: Path, revision: str, check: bool) -> int:
    """One file, measured with the source in `old`. Returns the exit code."""
    paths = os.pathsep.join((str(old), str(Path(__file__).parent)))

    def at_revision(*options: str) -> Any:
        command = [sys.executable, "-m", "carry_tiles", revision, "--codes", str(file), *options]
        answer = subprocess.run(command, env=os.environ | {"PYTHONPATH": paths}, check=True, stdout=subprocess.PIPE)
        return json.loads(answer.stdout)

    before, document = at_revision("--sources"), read_document(file, TileFile, ConfigError)
    if document.fingerprints.get("hopper") != before["fingerprint"]:
        print(f"{file.name}: its tiles were measured with another source than {revision}'s")
        return 1
    codes, now = before["codes"], compiled(document.tiles, compiling=False)
    same = codes == now
    if not same:
        codes, now = at_revision()["codes"], compiled(document.tiles)
    new, lost = carried(document, codes, now)
    for one in lost:
        print(f"{file.name}: {one.name}, {one.rows} rows, {one.numbers} has other machine code")
    how = "compiled from the same source" if same else "of the same machine code"
    print(f"{file.name}: {len(new.tiles)} tiles kept, {how}; {len(lost)} taken out")
    if not check:
        write_tile_file(new, file)
    return int(check and bool(lost))


if __name__ == "__main__":
    sys.exit(main())
