"""Files of measured tiles: written and read back, which ones hold on a GPU, and which tile an operation then takes."""

import json
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tile_helpers import ADA, KEY, OTHER, TILE, tile_document, tuned_tile

pytest.importorskip("triton", reason="Triton isn't installed")

from turbopi.backends import tuned_tiles
from turbopi.backends.fused import FusedBackend
from turbopi.backends.tuned_tiles import (
    BY_MODEL,
    Machine,
    TileFile,
    find_tiles,
    knobs_text,
    own_file,
    read_tile_file,
    tiles_of,
    tuned_off,
    write_tile_file,
)
from turbopi.kernels.portable import attention_tiles
from turbopi.kernels.portable.gemm import tiles as portable
from turbopi.kernels.portable.gemm.tiles import Tile
from turbopi.kernels.sm90.gemm import products
from turbopi.kernels.sm90.gemm import tiles as hopper_tiles
from turbopi.kernels.sm90.gemm.bf16 import Tile as HopperTile
from turbopi.kernels.tile_checks import why_not
from turbopi.kernels.tile_table import LIBRARY, NO_TILES, TileKey, TileTable
from turbopi.support.errors import ConfigError, OutputError
from turbopi.support.reading import plain_document

HOPPER = Machine("NVIDIA H200", (9, 0), 132, "580.95.05", "3.6.0")


@pytest.fixture
def shipped(tmp_path: Path) -> Path:
    folder = tmp_path / "shipped"
    folder.mkdir()
    return folder


def kept(tmp_path: Path, document: TileFile, machine: Machine = ADA) -> Path:
    file = own_file(machine.gpu, tmp_path)
    write_tile_file(document, file)
    return file


def test_a_file_is_read_back_as_it_was_written(tmp_path: Path) -> None:
    document = tile_document()
    file = kept(tmp_path, document)
    assert file.name == "nvidia-geforce-rtx-4090.json" and read_tile_file(file) == document
    assert [one.name for one in file.parent.iterdir()] == [file.name], "nothing else is left there"


def test_a_file_that_cannot_be_written_is_an_error_that_names_it(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match="file"):
        write_tile_file(tile_document(), tmp_path / "file" / "tiles.json")
    (tmp_path / "folder.json").mkdir()
    with pytest.raises(OutputError, match=r"folder\.json"):
        write_tile_file(tile_document(), tmp_path / "folder.json")


# ---- which files hold


def test_the_users_file_goes_before_the_shipped_one_and_that_before_the_cost_model(
    tmp_path: Path, shipped: Path
) -> None:
    other = TileKey("portable", "plain", "fp8", 640, 2560, 2048)
    theirs = tile_document(ADA, tuned_tile(tile=OTHER), tuned_tile(other, tile=OTHER), driver="1.0")
    write_tile_file(theirs, shipped / "rtx4090.json")
    only_shipped = find_tiles(ADA, cache=tmp_path, shipped=shipped)
    assert only_shipped.table.tiles == {KEY: OTHER, other: OTHER} and not only_shipped.unused
    assert only_shipped.about == "2 tiles of 2026-11-24 (shipped)"
    file = kept(tmp_path, tile_document())
    both = find_tiles(ADA, cache=tmp_path, shipped=shipped)
    assert both.table.tiles == {KEY: TILE, other: OTHER}
    assert both.about == f"1 tile of 2026-11-24 (measured here, {file}); 2 tiles of 2026-11-24 (shipped)"
    assert find_tiles(ADA, cache=tmp_path, shipped=shipped, own=False).table == only_shipped.table


def test_without_any_file_the_cost_model_chooses(tmp_path: Path) -> None:
    tiles = find_tiles(ADA, cache=tmp_path, shipped=tmp_path / "none")
    assert (len(tiles.table), tiles.about, tiles.unused) == (0, BY_MODEL, ())


def test_the_shipped_files_are_read_and_hold_for_their_own_gpus() -> None:
    assert tuned_tiles.SHIPPED.is_dir()
    for file in tuned_tiles.SHIPPED.glob("*.json"):
        read_tile_file(file)
    assert not find_tiles(Machine("No such GPU", (8, 9), 1, "1", "3.6.0"), cache=Path("/nonexistent")).table.tiles


def test_the_tiles_that_ship_for_an_h200_are_of_todays_kernels() -> None:
    """Otherwise they lie unused: measure them again, with `turbopi tune --out`."""
    found = find_tiles(Machine("NVIDIA H200", (9, 0), 132, "any", "3.6.0"), cache=Path("/nonexistent"))
    assert sum(key.kernels == "hopper" for key in found.table) > 100


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"driver": "570.1"}, "measured with driver 570.1, and here it is 580.95.05"),
        ({"gpu": "NVIDIA L40"}, "measured on a GPU called NVIDIA L40, and here it is NVIDIA GeForce RTX 4090"),
        ({"multiprocessors": 64}, "measured on so many multiprocessors: 64, and here it is 128"),
        ({"compute_capability": "12.0"}, "measured on compute capability 12.0, and here it is 8.9"),
        ({"fingerprints": {"portable": "0" * 16}}, "tiles of the portable kernels aren't used"),
    ],
)
def test_a_file_of_another_gpu_driver_or_kernels_is_not_used_and_one_line_says_what_to_do(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    file = kept(tmp_path, tile_document(ADA, **changes))
    tiles = find_tiles(ADA, cache=tmp_path, shipped=tmp_path / "none")
    (line,) = tiles.unused
    assert not tiles.table.tiles and str(file) in line and said in line and line.endswith("`turbopi tune`")
    assert "\n" not in line


def test_tiles_of_kernels_that_have_not_changed_stay(tmp_path: Path) -> None:
    hopper = tuned_tile(
        TileKey("hopper", "plain", "fp8", 576, 2560, 2048),
        tile=products.to_knobs(HopperTile(1, 112)),
        usual=products.to_knobs(HopperTile(3, 64)),
    )
    document = tile_document(HOPPER, tuned_tile(), hopper)
    document.fingerprints["portable"] = "0" * 16
    kept(tmp_path, document, HOPPER)
    tiles = find_tiles(HOPPER, cache=tmp_path, shipped=tmp_path / "none")
    assert [key.kernels for key in tiles.table] == ["hopper"] and len(tiles.unused) == 1


@pytest.mark.parametrize(
    ("changed", "reported"),
    [
        ({"driver": "570.1"}, "with driver 570.1, and here it is 580.95.05"),
        ({"triton": "3.5.1"}, "with Triton 3.5.1, and here it is 3.6.0"),
        ({"triton": None}, "with Triton of an unknown version, and here it is 3.6.0"),
    ],
)
def test_the_users_file_of_another_driver_or_triton_is_named(
    tmp_path: Path, changed: dict[str, Any], reported: str
) -> None:
    kept(tmp_path, tile_document(**changed))
    tiles = find_tiles(ADA, cache=tmp_path, shipped=tmp_path / "none")
    assert not tiles.table.tiles and reported in tiles.unused[0]
    kept(tmp_path, tile_document())
    assert len(find_tiles(ADA, cache=tmp_path, shipped=tmp_path / "none").table) == 1


def test_a_folder_that_cannot_be_read_has_no_tiles(tmp_path: Path) -> None:
    (tmp_path / "tiles").write_text("")
    tiles = find_tiles(ADA, cache=tmp_path, shipped=tmp_path / "none")
    assert not tiles.table.tiles and not tiles.unused


def test_a_shipped_file_holds_for_every_driver_and_triton_but_not_for_other_kernels(
    tmp_path: Path, shipped: Path
) -> None:
    write_tile_file(tile_document(driver="1.0", triton="3.5"), shipped / "a.json")
    assert len(find_tiles(ADA, cache=tmp_path, shipped=shipped).table) == 1
    write_tile_file(tile_document(fingerprints={"portable": "0"}), shipped / "a.json")
    tiles = find_tiles(ADA, cache=tmp_path, shipped=shipped)
    assert not tiles.table.tiles and not tiles.unused  # the user can't mend it


def damaged(change: str) -> str:
    value: Any = plain_document(tile_document())
    if change == "truncated":
        return json.dumps(value)[:-20]
    if change == "another field":
        value["tiles"][0]["tile"] = {"rows": 64, "depth": 3}
    if change == "a huge tile":
        value["tiles"][0]["tile"] = TILE | {"columns": 4096}
    if change == "no size":
        value["tiles"][0]["rows"] = 0
    if change == "text for a number":
        value["tiles"][0]["tile"]["warps"] = "four"
    if change == "a list":
        return "[]"
    return json.dumps(value)


@pytest.mark.parametrize(
    "change", ["truncated", "another field", "a huge tile", "no size", "text for a number", "a list"]
)
def test_a_damaged_file_is_named_and_the_cost_model_chooses(tmp_path: Path, change: str) -> None:
    file = own_file(ADA.gpu, tmp_path)
    file.parent.mkdir(parents=True)
    file.write_text(damaged(change))
    tiles = find_tiles(ADA, cache=tmp_path, shipped=tmp_path / "none")
    assert not tiles.table.tiles and tiles.about == BY_MODEL
    (line,) = tiles.unused
    assert str(file) in line and line.endswith("measure them again with `turbopi tune`, or delete the file")


# ---- engines


def on_fake_gpu(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> torch.device:
    monkeypatch.setattr(Machine, "of", classmethod(lambda cls, device: ADA))
    monkeypatch.setattr(tuned_tiles, "cache_folder", lambda: tmp_path)
    return torch.device("cuda", 0)


def test_an_engine_says_in_the_log_which_file_it_does_not_use(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    device = on_fake_gpu(monkeypatch, tmp_path)
    kept(tmp_path, tile_document(driver="570.1"))
    assert not tiles_of(device).table.tiles
    assert [record.getMessage().count("turbopi tune") for record in caplog.records] == [1]


def test_the_variable_switches_measured_tiles_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = on_fake_gpu(monkeypatch, tmp_path)
    kept(tmp_path, tile_document())
    assert tiles_of(device).table.tiles == {KEY: TILE}
    monkeypatch.setenv("TURBOPI_TUNED", "off")
    assert tuned_off() and not tiles_of(device).table.tiles and "TURBOPI_TUNED" in tiles_of(device).about
    monkeypatch.setenv("TURBOPI_TUNED", "no")
    with pytest.raises(ConfigError, match=r"TURBOPI_TUNED is 'no'; expected 'auto' .* or 'off'"):
        tiles_of(device)


def test_an_engine_keeps_the_table_that_it_was_made_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    device = on_fake_gpu(monkeypatch, tmp_path)
    file = kept(tmp_path, tile_document())
    before = tiles_of(device).table
    write_tile_file(tile_document(ADA, tuned_tile(tile=OTHER)), file)
    assert before.tiles == {KEY: TILE} and tiles_of(device).table.tiles == {KEY: OTHER}
    with pytest.raises(TypeError):
        before.tiles[KEY]["rows"] = 1  # type: ignore[index]


def test_describe_tells_whose_tiles_run() -> None:
    assert FusedBackend._tiles.about == BY_MODEL and FusedBackend._tiles.table is NO_TILES


# ---- which tile


def test_a_measured_portable_tile_is_taken_for_its_rows_and_no_others() -> None:
    table = TileTable({KEY: TILE})
    assert portable.tuned_tile(table, "fp8", "plain", 560, 2560, 2048) == Tile(**TILE)
    for other in ((640, 2560, 2048), (560, 2048, 2048), (560, 2560, 4096)):
        assert portable.tuned_tile(table, "fp8", "plain", *other) is None
    assert portable.tuned_tile(table, "bf16", "plain", 560, 2560, 2048) is None
    assert portable.tuned_tile(table, "fp8", "gelu", 560, 2560, 2048) is None


def test_the_library_may_be_the_measured_choice() -> None:
    key = TileKey("portable", "geglu", "bf16", 576, 16384, 2048)
    assert portable.tuned_tile(TileTable({key: {LIBRARY: 1}}), "bf16", "geglu", 560, 16384, 2048) is None


def test_attention_takes_its_measured_tile_else_the_usual_one() -> None:
    tile = attention_tiles.AttentionTile(128, 64, 8, 2)
    table = TileTable({TileKey("portable", "prefix_attention", "bf16", 576, 8, 256): asdict(tile)})
    assert attention_tiles.chosen_tile(table, "prefix_attention", (9, 0), 560, 8, 256) == tile
    usual = attention_tiles.usual_tile("prefix_attention", (9, 0))
    assert attention_tiles.chosen_tile(table, "prefix_attention", (9, 0), 704, 8, 256) == usual != tile


def test_hoppers_products_take_measured_tiles_before_their_own_tables() -> None:
    shape = (512, 1152, 4304)
    tile = HopperTile(1, 96, cluster_m=2, cluster_n=2, splits=2, gather=True)
    key = TileKey("hopper", "residual", "bf16", *shape)
    table = TileTable({key: products.to_knobs(tile), replace(key, numbers="fp8"): products.to_knobs(tile)})
    assert products.chosen(NO_TILES, "residual", *shape) == hopper_tiles.RESIDUAL_TILES[shape] != tile
    assert products.chosen(table, "residual", *shape) == tile
    assert products.chosen_fp8(table, "residual", *shape, 132) == tile
    assert products.chosen_fp8(NO_TILES, "residual", 2048, 1152, 4352, 132) is None
    assert products.chosen_fp8(NO_TILES, "residual", 512, 1152, 4352, 132) is not None
    by_library = TileTable({TileKey("hopper", "bias", "bf16", 512, 3456, 1152): {LIBRARY: 1}})
    assert products.chosen(by_library, "bias", 512, 3456, 1152) is None
    in_parts = TileTable({TileKey("hopper", "parts", "bf16", 576, 2048, 16384): {LIBRARY: 4}})
    assert products.chosen(in_parts, "parts", 560, 2048, 16384) == 4


def test_a_choice_of_hoppers_products_is_kept_as_it_is() -> None:
    for choice in (None, 2, HopperTile(3, 128, 1, 2, overlap=True), HopperTile(2, 96, splits=2, gather=True, ring=6)):
        assert products.from_knobs(products.to_knobs(choice)) == choice


def test_every_hand_made_tile_is_one_that_a_file_may_hold() -> None:
    tables: list[tuple[Any, str, Any]] = [
        (hopper_tiles.VISION_TILES, "bias", "bf16"),
        (hopper_tiles.RESIDUAL_TILES, "residual", "bf16"),
        (hopper_tiles.RESIDUAL_TILES_FP8, "residual", "fp8"),
        (hopper_tiles.PARTS_TILES, "parts", "bf16"),
        (hopper_tiles.FEW_TILES, "plain", "bf16"),
        (hopper_tiles.FEW_GEGLU_TILES, "geglu", "bf16"),
    ]
    for table, operation, numbers in tables:
        for shape, tile in table.items():
            split = isinstance(tile, HopperTile) and operation == "bias" and tile.splits > 1
            key = TileKey("hopper", "partial" if split else operation, numbers, *shape)
            assert why_not(key, products.to_knobs(tile), (9, 0)) is None, (key, tile)


def test_a_tile_in_a_few_characters() -> None:
    assert knobs_text(TILE) == "64x64 w4 s6" and knobs_text(TILE | {"splits": 3}) == "64x64 w4 s6 /3"
    assert knobs_text({LIBRARY: 1}) == "cuBLAS" and knobs_text({LIBRARY: 4}) == "cuBLAS in 4"
    assert knobs_text(asdict(attention_tiles.AttentionTile(64, 32, 8, 2))) == "64x32 w8 s2"
    gathered = HopperTile(2, 96, cluster_m=2, cluster_n=2, splits=2, gather=True, ring=6)
    assert knobs_text(products.to_knobs(gathered)) == "128x96 c2x2 /2g r6"
