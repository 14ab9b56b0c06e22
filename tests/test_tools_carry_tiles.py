"""Measured tiles stay with a change of the source that leaves their machine code as it was, with no other."""

from pathlib import Path

import pytest
from msgspec.structs import replace

pytest.importorskip("triton", reason="Triton isn't installed")

from carry_tiles import carried, compiled, forms, other_sources
from machine_code import compiler

from turbopi.backends.tuned_tiles import PACKAGE, SHIPPED, TileFile, fingerprint, read_tile_file
from turbopi.kernels.sm90.gemm.bf16 import EPILOGUES, Tile
from turbopi.kernels.sm90.gemm.products import ADDING_ROWS, from_knobs

FILES = sorted(SHIPPED.glob("*.json"))


@pytest.fixture(params=FILES, ids=lambda file: file.stem)
def document(request: pytest.FixtureRequest) -> TileFile:
    return read_tile_file(request.param)


def test_every_shipped_tile_has_forms_that_can_be_compiled(document: TileFile) -> None:
    for one in document.tiles:
        tile = from_knobs(one.tile) if one.kernels == "hopper" else None
        if isinstance(tile, Tile):
            found = list(forms(one, tile))
            assert found and all(constants["TP_STAGES"] >= 2 for _, constants in found), one
            epilogues = {constants["TP_EPILOGUE"] for _, constants in found}
            assert len(epilogues - {EPILOGUES["added"]}) <= 1 and epilogues <= set(EPILOGUES.values())
            assert (EPILOGUES["added"] in epilogues) == (
                one.operation in ("partial", "parts") and one.rows >= ADDING_ROWS and tile.splits == 1
            )
            assert not any(constants["TP_PROMOTE"] and tile.overlap for _, constants in found)


def test_tiles_of_other_machine_code_are_taken_out_and_the_rest_is_todays(document: TileFile) -> None:
    stale = replace(document, fingerprints=document.fingerprints | {"hopper": "another"})
    before = {str(one.key): "code" for one in document.tiles if one.kernels == "hopper"}
    changed = next(iter(before))
    new, lost = carried(stale, before, before | {changed: "other code"})
    assert [str(one.key) for one in lost] == [changed]
    assert new.tiles == [one for one in document.tiles if str(one.key) != changed]
    assert new.fingerprints == document.fingerprints | {"hopper": fingerprint("hopper")}


def test_norms_that_have_changed_are_noticed(tmp_path: Path) -> None:
    assert other_sources(PACKAGE)
    assert other_sources(tmp_path) != other_sources(PACKAGE)


def test_what_a_tile_is_compiled_from_tells_its_forms_and_launch_without_a_compiler(document: TileFile) -> None:
    one = next(one for one in document.tiles if one.operation == "plain" and isinstance(from_knobs(one.tile), Tile))
    others = (replace(one, rows=one.rows + 6400), replace(one, tile=one.tile | {"ring": 3}))
    found = compiled([one], compiling=False)
    assert found == compiled([one], compiling=False)
    assert all(compiled([other], compiling=False).popitem()[1] != found[str(one.key)] for other in others)


@pytest.mark.skipif(compiler() is None, reason="no NVRTC here")
def test_code_differs_by_tile_and_not_by_run(document: TileFile) -> None:
    one = next(one for one in document.tiles if one.operation == "plain" and isinstance(from_knobs(one.tile), Tile))
    other = replace(one, rows=one.rows + 64, tile=one.tile | {"columns": one.tile["columns"] // 2 // 16 * 16})
    codes = compiled([one, other])
    assert len(set(codes.values())) == 2 and codes == compiled([one, other])
