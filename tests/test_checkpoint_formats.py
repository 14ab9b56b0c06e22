"""Reading weights: the same numbers from every layout, in the right places and dtypes."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import ml_dtypes
import numpy as np
import pytest
import torch
from checkpoint_helpers import GOLDEN, LIBERO, edit_tensors, jax_copy, lerobot_copy, read_tree, torch_copy, write_json
from safetensors.torch import load_file, save_file

from turbopi.checkpoint import Checkpoint, inspect_checkpoint, open_checkpoint
from turbopi.config import PRESETS, PolicyConfig
from turbopi.models import parameter_shapes
from turbopi.models.pi0.reference import Pi0Model, parameter_dtype
from turbopi.support.errors import CheckpointError, ConfigError

P = "paligemma_with_expert.paligemma."
TIED = (P + "lm_head.weight", P + "model.language_model.embed_tokens.weight")


@pytest.fixture(scope="module")
def pi05() -> Checkpoint:
    return open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero")


def state_of(checkpoint: Checkpoint, precision: str = "f32") -> dict[str, torch.Tensor]:
    return checkpoint.load("cpu", precision).state  # type: ignore[arg-type]


def assert_same(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> None:
    assert a.keys() == b.keys()
    assert all(torch.equal(a[name], b[name]) for name in a)


def test_both_openpi_layouts_give_equal_tensors(tmp_path: Path, pi05: Checkpoint) -> None:
    stored_in_torch = open_checkpoint(torch_copy(tmp_path / "copy"))
    assert stored_in_torch.format == "openpi_torch"
    assert pi05.format == "openpi_jax"
    assert_same(state_of(stored_in_torch), state_of(pi05))
    assert stored_in_torch.config.model == pi05.config.model


def test_openpi_files_are_read_value_by_value(tmp_path: Path) -> None:
    state = state_of(open_checkpoint(torch_copy(tmp_path / "copy")))
    stored = load_file(GOLDEN / "pi05" / "torch" / "model.safetensors")
    pairs = {
        "vlm.embed_tokens.weight": TIED[0],
        "vision.layers.1.mlp.fc2.bias": P + "model.vision_tower.vision_model.encoder.layers.1.mlp.fc2.bias",
        "vision.patch_embedding.weight": P + "model.vision_tower.vision_model.embeddings.patch_embedding.weight",
        "projector.weight": P + "model.multi_modal_projector.linear.weight",
        "vlm.layers.2.self_attn.o_proj.weight": P + "model.language_model.layers.2.self_attn.o_proj.weight",
        "expert.norm.dense.bias": "paligemma_with_expert.gemma_expert.model.norm.dense.bias",
        "time_mlp_in.weight": "time_mlp_in.weight",
    }
    for ours, theirs in pairs.items():
        assert torch.equal(state[ours], stored[theirs].float()), ours


@pytest.mark.parametrize("precision", ["f32", "bf16"])
@pytest.mark.parametrize("kind", ["pi05", "pi0"])
def test_loaded_weights_are_the_models_own_parameters(kind: str, precision: str) -> None:
    checkpoint = open_checkpoint(GOLDEN / kind / "jax", {"pi05": "pi05_libero", "pi0": "pi0_aloha"}[kind])
    loaded = checkpoint.load("cpu", precision)  # type: ignore[arg-type]
    assert {name: tuple(t.shape) for name, t in loaded.state.items()} == parameter_shapes(checkpoint.config.model)
    assert all(t.dtype == parameter_dtype(name, precision) for name, t in loaded.state.items())  # type: ignore[arg-type]
    assert loaded.bytes == sum(t.nbytes for t in loaded.state.values())
    Pi0Model.from_state(checkpoint.config.planned_model, loaded.state)


def test_bf16_rounds_to_nearest_even_and_keeps_float32_parameters_unrounded() -> None:
    checkpoint = open_checkpoint(GOLDEN / "pi0" / "jax", "pi0_aloha")  # weights that bfloat16 can't hold
    exact, rounded = state_of(checkpoint), state_of(checkpoint, "bf16")
    for name, tensor in rounded.items():
        assert torch.equal(tensor, exact[name].to(tensor.dtype)), name
    assert rounded["action_in_proj.weight"].dtype == torch.float32
    assert torch.equal(rounded["action_in_proj.weight"], exact["action_in_proj.weight"])
    assert not torch.equal(rounded["projector.weight"].float(), exact["projector.weight"])


def test_sizes_come_from_the_tensors(pi05: Checkpoint) -> None:
    sizes = json.loads((GOLDEN / "model.json").read_text())
    info = pi05.info()["sizes"]
    assert info["vlm"] == sizes["vlm"]
    assert info["expert"] == sizes["expert"]
    vision = {key: value for key, value in sizes["vision"].items() if key != "layer_norm_eps"}
    assert info["vision"] == vision
    assert (info["vocab_size"], info["action_dim"]) == (sizes["vocab_size"], sizes["action_dim"])


def test_a_tree_with_and_without_the_value_level_is_the_same(tmp_path: Path, pi05: Checkpoint) -> None:
    tree = read_tree(GOLDEN / "pi05" / "jax" / "params")
    for value in (True, False):
        folder = jax_copy(tmp_path / str(value), tree, value=value)
        assert_same(state_of(open_checkpoint(folder, "pi05_libero")), state_of(pi05))


def test_chunked_and_bfloat16_trees_are_read(tmp_path: Path, pi05: Checkpoint) -> None:
    tree = read_tree(GOLDEN / "pi05" / "jax" / "params")  # exactly representable in bfloat16
    tree = {path: array.astype(ml_dtypes.bfloat16) if "mlp" in path else array for path, array in tree.items()}
    chunks = {
        "PaliGemma/llm/layers/mlp/gating_einsum": [2, 1, 50, 40],
        "PaliGemma/llm/embedder/input_embedding": [100, 96],
    }
    checkpoint = open_checkpoint(jax_copy(tmp_path / "c", tree, chunks=chunks), "pi05_libero")
    assert_same(state_of(checkpoint), state_of(pi05))
    assert checkpoint.info()["stored_dtypes"] == ["BF16", "F32"]


def test_pieces_smaller_than_a_tensor_give_the_same_weights(
    tmp_path: Path, pi05: Checkpoint, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected, fingerprint = state_of(pi05), pi05.fingerprint()
    row_ranges = "turbopi.checkpoint.source.row_ranges.__defaults__"
    monkeypatch.setattr(row_ranges, (1000,))
    monkeypatch.setattr("turbopi.checkpoint.openpi_jax.PIECE_BYTES", 1000)
    for path, config in ((torch_copy(tmp_path / "copy"), "auto"), (GOLDEN / "pi05" / "jax", "pi05_libero")):
        checkpoint = open_checkpoint(path, config)
        pieces = list(checkpoint.source.pieces(torch.device("cpu")))
        assert sum(piece.name == "vlm.embed_tokens.weight" for piece in pieces) > 10
        assert_same(state_of(checkpoint), expected)
        assert checkpoint.fingerprint() == fingerprint


def test_the_fingerprint_is_of_the_numbers_and_not_of_the_format(tmp_path: Path, pi05: Checkpoint) -> None:
    folder = torch_copy(tmp_path / "copy")
    assert open_checkpoint(folder).fingerprint() == pi05.fingerprint()
    stored = load_file(folder / "model.safetensors")["time_mlp_in.bias"]
    stored[3] = -stored[3]
    edit_tensors(folder, time_mlp_in__bias=stored)
    assert open_checkpoint(folder).fingerprint() != pi05.fingerprint()


def test_params_itself_and_a_trailing_slash_are_understood(pi05: Checkpoint) -> None:
    for path in (f"{GOLDEN}/pi05/jax/params", f"{GOLDEN}/pi05/jax/params/"):
        assert open_checkpoint(path, "pi05_libero").path == pi05.path


def test_params_are_understood_by_any_name(tmp_path: Path, pi05: Checkpoint, monkeypatch: pytest.MonkeyPatch) -> None:
    assert pi05.path is not None
    (tmp_path / "weights").symlink_to(pi05.path / "params")
    assert open_checkpoint(tmp_path / "weights", "pi05_libero").asset_id == pi05.asset_id
    monkeypatch.chdir(pi05.path / "params")
    assert open_checkpoint(".", "pi05_libero").asset_id == pi05.asset_id


def test_shards_are_read_through_their_index(tmp_path: Path, pi05: Checkpoint) -> None:
    folder = torch_copy(tmp_path / "copy")
    tensors = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    names = sorted(tensors)
    files = {"a.safetensors": names[::2], "b.safetensors": names[1::2]}
    for file, part in files.items():
        save_file({name: tensors[name] for name in part}, folder / file)
    index = {"weight_map": {name: file for file, part in files.items() for name in part}}
    write_json(folder / "model.safetensors.index.json", index)
    assert_same(state_of(open_checkpoint(folder)), state_of(pi05))
    (folder / "b.safetensors").unlink()
    with pytest.raises(CheckpointError, match=r"lists files that aren't there: b\.safetensors"):
        open_checkpoint(folder)


@pytest.mark.parametrize("make", [torch_copy, lerobot_copy])
@pytest.mark.parametrize("shards_are_there", [True, False])
def test_the_single_file_is_read_and_not_the_shards_of_an_older_index(
    tmp_path: Path, make: Callable[[Path], Path], shards_are_there: bool
) -> None:
    """As openpi, LeRobot and transformers do."""
    folder = make(tmp_path / "copy")
    write_json(folder / "turbopi.json", {"vision_heads": 4} | ({"preset": "pi05_libero"} if make is torch_copy else {}))
    expected = open_checkpoint(folder)
    old = {name: tensor + 1 for name, tensor in load_file(folder / "model.safetensors").items()}
    if shards_are_there:
        save_file(old, folder / "old.safetensors")
    index = folder / "model.safetensors.index.json"
    write_json(index, {"weight_map": dict.fromkeys(old, "old.safetensors")})
    opened = open_checkpoint(folder)
    assert opened.fingerprint() == expected.fingerprint()
    assert [note for note in opened.source.notes if note not in expected.source.notes] == [
        f"two sources of weights: model.safetensors is read, as by {'openpi' if make is torch_copy else 'LeRobot'}, "
        f"and not {index}"
    ]
    write_json(index, {"weight_map": dict.fromkeys(old, "model.safetensors")})  # one source
    assert open_checkpoint(folder).source.notes == expected.source.notes


def test_of_two_formats_in_a_folder_openpis_choice_is_read(tmp_path: Path, pi05: Checkpoint) -> None:
    folder = torch_copy(tmp_path / "copy")
    shutil.copytree(GOLDEN / "pi05" / "jax" / "params", folder / "params")
    both = open_checkpoint(folder)
    assert both.format == "openpi_torch"
    assert both.source.notes == [
        f"two sources of weights: model.safetensors is read, as by openpi, and not {folder / 'params'}"
    ]
    (folder / "config.json").unlink()
    (folder / "model.safetensors").rename(folder / "one.safetensors")
    names = load_file(folder / "one.safetensors")
    write_json(folder / "model.safetensors.index.json", {"weight_map": dict.fromkeys(names, "one.safetensors")})
    both = open_checkpoint(folder)
    assert (both.format, len(both.source.notes)) == ("openpi_jax", 1)
    assert "params/ is read, as by openpi, and not" in both.source.notes[0]


def test_files_behind_links_are_part_of_a_trees_fingerprint(tmp_path: Path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(GOLDEN / "pi05" / "jax", folder)
    names = {file.name for file in open_checkpoint(folder, "pi05_libero").source.files}  # type: ignore[attr-defined]
    (linked,) = (entry for entry in (folder / "params").iterdir() if entry.is_dir() and entry.name.startswith("ocdbt"))
    linked.rename(tmp_path / "elsewhere")
    linked.symlink_to(tmp_path / "elsewhere")
    assert {file.name for file in open_checkpoint(folder, "pi05_libero").source.files} == names  # type: ignore[attr-defined]


def test_an_index_that_belongs_to_other_shards_is_refused(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "copy")
    (folder / "model.safetensors").rename(folder / "one.safetensors")
    save_file({"time_mlp_in.bias": torch.ones(32)}, folder / "two.safetensors")
    names = dict.fromkeys(load_file(folder / "one.safetensors"), "one.safetensors")
    write_json(
        folder / "model.safetensors.index.json", {"weight_map": names | {"action_in_proj.bias": "two.safetensors"}}
    )
    with pytest.raises(CheckpointError, match=r"lists action_in_proj.bias in two.safetensors, but the files hold some"):
        open_checkpoint(folder)


@pytest.mark.parametrize("prefix", ["module.", "_orig_mod.", "model.", "module._orig_mod.", "policy.model."])
@pytest.mark.parametrize("make", [torch_copy, lerobot_copy])
def test_a_prefix_of_all_names_is_left_out_with_a_note(
    tmp_path: Path, make: Callable[[Path], Path], prefix: str
) -> None:
    folder = make(tmp_path / "copy")
    write_json(folder / "turbopi.json", {"vision_heads": 4} | ({"preset": "pi05_libero"} if make is torch_copy else {}))
    fingerprint = open_checkpoint(folder).fingerprint()
    tensors = load_file(folder / "model.safetensors")
    save_file({prefix + name.removeprefix("model."): t.clone() for name, t in tensors.items()}, folder / "new")
    (folder / "new").replace(folder / "model.safetensors")
    opened = open_checkpoint(folder)
    assert opened.fingerprint() == fingerprint
    own = make is lerobot_copy and prefix == "model."
    note = f"all names in model.safetensors begin with {prefix}: read without it"
    assert (note in opened.source.notes) is not own


def test_a_prefix_of_some_names_is_an_error_that_shows_them(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "copy")
    tensors = load_file(folder / "model.safetensors")
    save_file({f"module.{name}": t.clone() for name, t in tensors.items()} | {"step": torch.ones(1)}, folder / "new")
    (folder / "new").replace(folder / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"first of each module: module.action_in_proj.bias, step$"):
        open_checkpoint(folder)
    ema = {f"{which}.{name}": t.clone() for name, t in tensors.items() for which in ("ema", "model")}
    save_file(ema, folder / "new")
    (folder / "new").replace(folder / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"ema.action_in_proj.bias, model.action_in_proj.bias"):
        open_checkpoint(folder)


@pytest.mark.parametrize("make", [torch_copy, lerobot_copy])
def test_names_of_transformers_before_4_52_are_read(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    folder = make(tmp_path / "copy")
    write_json(folder / "turbopi.json", {"vision_heads": 4} | ({"preset": "pi05_libero"} if make is torch_copy else {}))
    expected = open_checkpoint(folder)
    fingerprint = expected.fingerprint()
    old = {
        P + "model.vision_tower.": P + "vision_tower.",
        P + "model.multi_modal_projector.": P + "multi_modal_projector.",
        P + "model.language_model.": P + "language_model.model.",
        P + "lm_head.": P + "language_model.lm_head.",
    }
    tensors = {}
    for name, tensor in load_file(folder / "model.safetensors").items():
        for new, before in old.items():
            name = name.replace(new, before)
        tensors[name] = tensor
    assert not any(P + "model." in name for name in tensors)
    (folder / "model.safetensors").unlink()
    save_file(tensors, folder / "model.safetensors")
    opened = open_checkpoint(folder)
    assert opened.fingerprint() == fingerprint
    assert opened.source.notes == expected.source.notes


@pytest.mark.parametrize("present", [TIED[:1], TIED[1:], TIED], ids=["lm_head", "embed_tokens", "both"])
def test_the_tied_embedding_is_read_under_either_name(
    tmp_path: Path, pi05: Checkpoint, present: tuple[str, ...]
) -> None:
    folder = torch_copy(tmp_path / "copy")
    embedding = load_file(folder / "model.safetensors")[TIED[0]]
    changes = {name.replace(".", "__"): embedding.clone() if name in present else None for name in TIED}
    edit_tensors(folder, **changes)
    checkpoint = open_checkpoint(folder)
    assert_same(state_of(checkpoint), state_of(pi05))
    assert checkpoint.info()["parameters"]["vlm"] == pi05.info()["parameters"]["vlm"]  # not counted twice


def test_tied_tensors_that_differ_are_refused(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "copy")
    embedding = load_file(folder / "model.safetensors")[TIED[0]]
    edit_tensors(folder, **{TIED[1].replace(".", "__"): embedding + 1})
    with pytest.raises(CheckpointError, match="tied in the model but differ in the file"):
        open_checkpoint(folder)


def test_the_vision_tower_is_read_without_the_level_vision_model(tmp_path: Path, pi05: Checkpoint) -> None:
    folder = torch_copy(tmp_path / "copy")
    tensors = load_file(folder / "model.safetensors")
    (folder / "model.safetensors").unlink()
    renamed = {name.replace("vision_tower.vision_model.", "vision_tower."): tensor for name, tensor in tensors.items()}
    save_file(renamed, folder / "model.safetensors")
    assert_same(state_of(open_checkpoint(folder)), state_of(pi05))


def test_the_unused_head_may_be_absent(tmp_path: Path, pi05: Checkpoint) -> None:
    folder = torch_copy(tmp_path / "copy")
    edit_tensors(folder, paligemma_with_expert__gemma_expert__lm_head__weight=None)
    assert_same(state_of(open_checkpoint(folder)), state_of(pi05))


def test_jax_kernels_tell_the_vision_heads_and_torch_needs_them(tmp_path: Path, pi05: Checkpoint) -> None:
    assert pi05.config.planned_model.vision.num_heads == 4
    folder = torch_copy(tmp_path / "copy")
    (folder / "turbopi.json").unlink()
    with pytest.raises(ConfigError, match=r"64 wide, and no tensor tells its number of attention heads.*vision_heads"):
        open_checkpoint(folder, "pi05_libero")
    with pytest.raises(ConfigError, match="no tensor tells"):  # pi05_tiny is 128 wide: its 4 heads say nothing here
        open_checkpoint(folder, "pi05_tiny")
    known = PRESETS["pi05_libero"].with_model(vision=pi05.config.planned_model.vision)
    assert open_checkpoint(folder, known).config.planned_model.vision.num_heads == 4
    write_json(tmp_path / "five.json", {"preset": "pi05_libero", "vision_heads": 5})
    with pytest.raises(ConfigError, match=r"vision_heads is 5, but the vision tower .* is 64 wide"):
        open_checkpoint(folder, tmp_path / "five.json")
    with pytest.raises(ConfigError, match=r"vision_heads is 5, but .* stores 4 attention heads"):
        open_checkpoint(GOLDEN / "pi05" / "jax", tmp_path / "five.json")


def test_info_describes_a_checkpoint_in_plain_json(tmp_path: Path, pi05: Checkpoint) -> None:
    info = pi05.info()
    assert json.loads(json.dumps(info)) == info
    parts = {name: count for name, count in info["parameters"].items() if name != "total"}
    shapes = parameter_shapes(pi05.config.model)
    assert sum(parts.values()) == info["parameters"]["total"] == sum(int(np.prod(shape)) for shape in shapes.values())
    assert parts["vision"] == sum(int(np.prod(s)) for name, s in shapes.items() if name.startswith("vision."))
    assert info["stored_bytes"] == 4 * info["parameters"]["total"]
    state = info["norm_stats"]["state"]
    assert (state["dim"], state["statistics"]) == (8, ["mean", "std", "q01", "q99"])
    assert all(len(state["values"][name]) == 8 for name in state["statistics"])
    assert (info["robot"], info["action_horizon"], info["asset_id"]) == ("libero", 10, LIBERO)
    folder = torch_copy(tmp_path / "copy")
    (folder / "assets" / "paligemma_tokenizer.model").write_bytes(b"x")
    assert open_checkpoint(folder).info()["tokenizers"] == [str(folder / "assets" / "paligemma_tokenizer.model")]


def test_inspect_works_without_a_configuration_and_says_what_is_missing(pi05: Checkpoint) -> None:
    info = inspect_checkpoint(GOLDEN / "pi05" / "jax")
    assert "pi05_libero" in info["config_error"]
    assert info["kind"] == "pi05"
    assert info["assets"] == [LIBERO]
    assert info["parameters"] == pi05.info()["parameters"]
    assert inspect_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero") == pi05.info()


def test_a_policy_config_is_taken_at_its_word_except_for_sizes(pi05: Checkpoint) -> None:
    mine = PolicyConfig("mine", PRESETS["pi05_droid"].model, "libero", asset_id=LIBERO)
    config = open_checkpoint(GOLDEN / "pi05" / "jax", mine).config
    assert config.model.action_horizon == 15
    assert config.planned_model.vlm == pi05.config.planned_model.vlm
    assert config.name == "mine"


def test_a_copy_without_assets_names_the_folder_it_looked_in(tmp_path: Path) -> None:
    shutil.copytree(GOLDEN / "pi05" / "jax" / "params", tmp_path / "c" / "params")
    with pytest.raises(CheckpointError, match=f"norm stats are missing: no {tmp_path}/c/assets/{LIBERO}"):
        open_checkpoint(tmp_path / "c", "pi05_libero")
