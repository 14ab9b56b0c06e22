"""Damaged checkpoints: each is refused in one line, costs neither gigabytes nor minutes, and never gives other numbers
where something could tell.
"""

import json
import random
import shutil
from pathlib import Path
from typing import Any

import pytest
import tensorstore as ts
import torch
from checkpoint_helpers import GOLDEN, edit_json, edit_tensors, torch_copy, write_json

from turbopi.checkpoint import open_checkpoint
from turbopi.checkpoint.names import to_openpi
from turbopi.support.errors import CheckpointError, ConfigError


@pytest.mark.parametrize("stack", ["paligemma_with_expert.gemma_expert.model.", "vision"])
@pytest.mark.parametrize("layer", ["300000", "9" * 5000, "256"])
def test_a_layers_number_is_not_believed(tmp_path: Path, stack: str, layer: str) -> None:
    """Names of 300,000 layers' parameters would take gigabytes."""
    folder = torch_copy(tmp_path / "c")
    prefix = to_openpi("vision.layers.") if stack == "vision" else stack + "layers."
    edit_tensors(folder, **{f"{prefix}{layer}.mlp.down_proj.weight": torch.zeros(1)})
    with pytest.raises(CheckpointError, match=r"is of layer \d{3,40}; at most 256 layers are read") as caught:
        open_checkpoint(folder)
    assert len(str(caught.value)) < 1000


def _damaged_tree(folder: Path, **edits: Any) -> Path:
    """Golden pi05/jax with edited descriptions of one array; None: one chunk of it is gone."""
    shutil.copytree(GOLDEN / "pi05" / "jax", folder)
    store = ts.KvStore.open({"driver": "ocdbt", "base": (folder / "params").as_uri() + "/"}).result()
    key = "params.action_in_proj.kernel.value/"
    for name, value in edits.items():
        if name == "chunk":
            store.write(key + "0.0", value).result()
        else:
            described = json.loads(store.read(key + ".zarray").result().value)
            store.write(key + ".zarray", json.dumps(described | {name: value}).encode()).result()
    return folder


@pytest.mark.parametrize(
    ("edits", "message"),
    [
        ({"chunk": None}, "action_in_proj/kernel has 0 of its 1 chunks; the download is incomplete"),
        ({"shape": [10**18, 64]}, r"action_in_proj/kernel: shape is \[1000000000000000000, 64\]; expected at most 8"),
        ({"shape": [2**31, 2**31]}, "more than a terabyte"),
        ({"shape": [-1, 64]}, "action_in_proj/kernel: shape is"),
        ({"shape": "32"}, "action_in_proj/kernel: shape is '32'; expected a list"),
        ({"shape": [True, 64]}, "action_in_proj/kernel: shape is"),
        ({"chunks": [10**9, 10**9]}, "chunks of"),
        ({"chunks": None}, "chunks is None; expected a list"),
        ({"dtype": "<i4"}, "stored as <i4; expected one of float32"),
        ({"dtype": None}, "stored as None"),
        ({"dtype": ["<f4"]}, "stored as"),
        ({"compressor": {"id": "none"}}, "action_in_proj/kernel can't be"),
        ({"compressor": None}, "action_in_proj/kernel can't be read"),
        ({"chunk": b""}, "action_in_proj/kernel can't be read"),
        ({"chunk": b"\0" * 1000}, "action_in_proj/kernel can't be read"),
    ],
)
def test_a_tree_whose_description_and_chunks_do_not_fit_is_refused(
    tmp_path: Path, edits: dict[str, Any], message: str
) -> None:
    folder = _damaged_tree(tmp_path / "c", **edits)
    with pytest.raises(CheckpointError, match=message) as caught:
        open_checkpoint(folder, "pi05_libero").load("cpu", "f32")
    assert "\n" not in str(caught.value)


def test_chunks_that_older_orbax_left_out_are_zeros_and_said_to_be(tmp_path: Path) -> None:
    folder = _damaged_tree(tmp_path / "c", fill_value=0.0, chunk=None)
    with pytest.raises(CheckpointError, match="has 0 of its 1 chunks"):  # _METADATA says that all are written
        open_checkpoint(folder, "pi05_libero")
    edit_json(folder / "params" / "_METADATA", lambda content: content.pop("store_array_data_equal_to_fill_value"))
    checkpoint = open_checkpoint(folder, "pi05_libero")
    assert checkpoint.source.notes == [
        "1 of 1 chunks of action_in_proj/kernel aren't stored: read as zeros, as Orbax does"
    ]
    assert not checkpoint.load("cpu", "f32").state["action_in_proj.weight"].any()


@pytest.mark.slow
def test_every_damaged_byte_of_an_orbax_index_is_found(tmp_path: Path) -> None:
    """Manifests and index nodes have a CRC-32C: no byte that is read may change what they say."""
    folder = tmp_path / "c"
    shutil.copytree(GOLDEN / "pi05" / "jax", folder)
    shapes = open_checkpoint(folder, "pi05_libero").source.shapes
    rng, refused = random.Random(0), 0
    nodes = [file for file in folder.glob("params/**/*") if file.is_file() and file.stat().st_size < 100_000]
    for file in nodes:
        good = file.read_bytes()
        for place in rng.sample(range(len(good)), 12):
            file.write_bytes(good[:place] + bytes([good[place] ^ 1 << rng.randrange(8)]) + good[place + 1 :])
            try:
                assert open_checkpoint(folder, "pi05_libero").source.shapes == shapes  # not a file that is read
            except CheckpointError:
                refused += 1
        file.write_bytes(good)
    assert refused >= 24  # params/manifest.ocdbt and its node


def test_damaged_numbers_of_an_orbax_tree_are_refused_or_found_by_their_hash(tmp_path: Path) -> None:
    """No checksum protects them. What is decoded differently is told by weights_sha256, and only by it."""
    folder = tmp_path / "c"
    shutil.copytree(GOLDEN / "pi05" / "jax", folder)
    sha256 = open_checkpoint(folder, "pi05_libero").fingerprint()
    write_json(folder / "turbopi.json", {"preset": "pi05_libero", "weights_sha256": sha256})
    open_checkpoint(folder).load("cpu", "f32")
    data = [file for file in folder.glob("params/**/*") if file.is_file() and file.stat().st_size > 100_000]
    rng, refused = random.Random(1), {"decoding": 0, "hash": 0}
    for number in range(10):
        file = data[number % len(data)]
        good = file.read_bytes()
        place = rng.randrange(len(good))
        file.write_bytes(good[:place] + bytes([good[place] ^ 1 << rng.randrange(8)]) + good[place + 1 :])
        with pytest.raises(CheckpointError) as caught:
            open_checkpoint(folder).load("cpu", "f32")
        refused["hash" if "they are damaged, or others" in str(caught.value) else "decoding"] += 1
        file.write_bytes(good)
    assert refused["hash"] and sum(refused.values()) == 10


def test_weights_of_another_hash_are_refused_at_loading_in_every_format(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c", weights_sha256="0" * 64)
    checkpoint = open_checkpoint(folder)
    with pytest.raises(CheckpointError, match=r"turbopi.json says that the weights' SHA-256 is 0{64}, but it is"):
        checkpoint.load("cpu", "bf16")
    write_json(folder / "turbopi.json", {"preset": "pi05_libero", "vision_heads": 4, "weights_sha256": "0" * 63})
    with pytest.raises(ConfigError, match=r"weights_sha256 is .*; expected 64 digits"):
        open_checkpoint(folder)
