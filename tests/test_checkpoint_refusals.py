"""What isn't a checkpoint that Turbo-Pi reads, and checkpoints with something wrong: each says what, and what to do."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from checkpoint_helpers import (
    GOLDEN,
    LIBERO,
    Tree,
    edit_tensors,
    jax_copy,
    read_tree,
    torch_copy,
    write_json,
    write_tree,
)
from safetensors.torch import load_file

from turbopi.checkpoint import convert, open_checkpoint
from turbopi.models.pi0.reference import FloatPrecision
from turbopi.preprocess.tokenizer import load_tokenizer
from turbopi.support.errors import CheckpointError, ConfigError, TokenizerError
from turbopi.support.reading import read_json

V = "paligemma_with_expert.paligemma.model.vision_tower.vision_model."


@pytest.fixture
def tree() -> Tree:
    return read_tree(GOLDEN / "pi05" / "jax" / "params")


@pytest.mark.parametrize(
    ("address", "advice"),
    [
        ("gs://openpi-assets/checkpoints/pi05_libero", "gsutil -m cp -r gs://openpi-assets/checkpoints/pi05_libero"),
        ("s3://bucket/pi05", "aws s3 cp --recursive s3://bucket/pi05"),
        ("hf://lerobot/pi05_base", "hf download lerobot/pi05_base --local-dir"),
        ("https://example.com/pi05", "a download of the whole folder"),
    ],
)
def test_addresses_are_refused_with_how_to_fetch_them(address: str, advice: str) -> None:
    for path in (address, Path(address)):  # a Path loses one slash
        with pytest.raises(CheckpointError, match="is an address; Turbo-Pi reads local folders") as caught:
            open_checkpoint(path)
        assert advice in str(caught.value)


def test_an_address_that_openpi_has_fetched_is_told_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path))
    folder = tmp_path / "openpi-assets" / "checkpoints" / "pi05_droid"
    folder.mkdir(parents=True)
    with pytest.raises(CheckpointError, match=f"openpi has fetched it already: give {folder}$"):
        open_checkpoint("gs://openpi-assets/checkpoints/pi05_droid")


def test_a_hub_name_is_recognised() -> None:
    with pytest.raises(
        CheckpointError, match=r"no folder lerobot/pi05_base.*hf download lerobot/pi05_base --local-dir"
    ):
        open_checkpoint("lerobot/pi05_base")
    with pytest.raises(CheckpointError, match=r"no folder \.\./pi05_base$"):  # no name on the hub
        open_checkpoint("../pi05_base")


def test_what_one_has_no_permission_for_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of a download that isn't complete, and no file that nobody has named."""
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(CheckpointError, match=f"{tmp_path} can't be read: you have no permission$"):
        open_checkpoint(tmp_path)
    monkeypatch.undo()

    def denied(path: object) -> object:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr("turbopi.support.reading.files.os.stat", denied)
    with pytest.raises(CheckpointError, match=r"config\.json can't be read: Permission denied$"):
        read_json(tmp_path / "config.json", hint="; is the download complete?")


def test_paths_that_hold_no_checkpoint_say_what_is_there(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"there is no folder .*/nowhere$"):
        open_checkpoint(tmp_path / "nowhere")
    with pytest.raises(
        CheckpointError, match=r"/small_policy; the one that comes with Turbo-Pi is (.*/small_policy)$"
    ) as no:
        open_checkpoint(tmp_path / "small_policy")
    assert open_checkpoint(str(no.value).rpartition(" is ")[2]).config.robot == "libero"
    with pytest.raises(CheckpointError, match=r"holds no checkpoint: expected model.safetensors .* but it has nothing"):
        open_checkpoint(tmp_path)
    (tmp_path / "notes.txt").touch()
    (tmp_path / "logs").mkdir()
    with pytest.raises(CheckpointError, match=r"but it has logs/, notes.txt"):
        open_checkpoint(tmp_path)
    with pytest.raises(
        CheckpointError, match=f"notes.txt is a file; give the checkpoint's folder, probably {tmp_path}"
    ):
        open_checkpoint(tmp_path / "notes.txt")


def test_one_folder_too_high_is_told_the_right_one(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "pi05_droid" / "params").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"but folders that do \(pi05_droid\); give .*, such as .*/pi05_droid$"):
        open_checkpoint(tmp_path)


def test_two_folders_too_high_or_too_low_are_told_the_right_one(tmp_path: Path) -> None:
    run = tmp_path / "pi05_droid"
    for step in ("9000", "10000"):
        (run / "first_try" / step / "params").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"some further below; give one, such as .*/first_try/10000$"):
        open_checkpoint(run)
    asset = run / "first_try" / "9000" / "assets" / "droid"
    asset.mkdir(parents=True)
    for low in (asset, asset.parent):
        with pytest.raises(CheckpointError, match=r"but the folder above does; give .*/first_try/9000$"):
            open_checkpoint(low)


def test_a_training_run_names_its_steps(tmp_path: Path) -> None:
    for step in ("10000", "29999", "5000"):
        (tmp_path / step / "params").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"training steps \(5000, 10000, 29999\); give one .*, such as .*/29999"):
        open_checkpoint(tmp_path)


def test_an_interrupted_save_is_said_to_be_one_and_never_recommended(tmp_path: Path) -> None:
    for name in ("tmp_1000", "500", "2000.orbax-checkpoint-tmp-17", "tmp-checkpoint-7", ".ipynb_checkpoints"):
        (tmp_path / name / "params").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"training steps \(500\); give .*/500 \(.*tmp_1000: what an interrupted"):
        open_checkpoint(tmp_path)
    shutil.rmtree(tmp_path / "500")
    with pytest.raises(
        CheckpointError, match=r"holds 2000.*, tmp-checkpoint-7, tmp_1000, what an interrupted save left"
    ):
        open_checkpoint(tmp_path)
    step = tmp_path / "run" / "29999"
    (step / "params.orbax-checkpoint-tmp-3").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"holds params.orbax-checkpoint-tmp-3, what an interrupted save left"):
        open_checkpoint(step)
    (tmp_path / "run" / "20000" / "params").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"training steps \(20000\); give one of them, such as .*/20000$"):
        open_checkpoint(tmp_path / "run")
    assert any(
        "tmp_9 is what an interrupted" in note for note in open_checkpoint(torch_copy(tmp_path / "tmp_9")).source.notes
    )


def test_lerobots_steps_are_recommended(tmp_path: Path) -> None:
    for step in ("005000", "010000"):
        folder = tmp_path / "checkpoints" / step / "pretrained_model"
        folder.mkdir(parents=True)
        (folder / "model.safetensors").touch()
    with pytest.raises(CheckpointError, match=r"training steps \(005000, 010000\)"):
        open_checkpoint(tmp_path / "checkpoints")


def test_a_tree_one_folder_too_deep_is_named(tmp_path: Path) -> None:
    (tmp_path / "params" / "params").mkdir(parents=True)
    with pytest.raises(
        CheckpointError, match=r"params/params lies one folder too deep: move what is in it to .*/params,"
    ):
        open_checkpoint(tmp_path)


def test_a_download_that_is_not_finished_says_so(tmp_path: Path) -> None:
    folder = tmp_path / "hub"
    (folder / ".cache" / "huggingface" / "download").mkdir(parents=True)
    (folder / ".cache" / "huggingface" / "download" / "model.safetensors.abc.incomplete").touch()
    with pytest.raises(CheckpointError, match=r"isn't finished: there is \.cache/.*\.incomplete"):
        open_checkpoint(folder)
    (tmp_path / "linked").mkdir()
    (tmp_path / "linked" / "model.safetensors").symlink_to("../../blobs/0123")
    with pytest.raises(
        CheckpointError, match=r"model.safetensors is a link to \.\./\.\./blobs/0123, which isn't there"
    ):
        open_checkpoint(tmp_path / "linked")
    (tmp_path / "shards").mkdir()
    (tmp_path / "shards" / "model-00001-of-00002.safetensors").touch()
    with pytest.raises(CheckpointError, match=r"holds model-00001-of-00002.safetensors, but neither .*index.json"):
        open_checkpoint(tmp_path / "shards")
    write_json(tmp_path / "shards" / "model.safetensors.index.json", {"weight_map": {"a": "b.safetensors"}})
    with pytest.raises(CheckpointError, match=r"aren't there: b.safetensors; .* none of its files are there"):
        open_checkpoint(tmp_path / "shards")
    (tmp_path / "save" / "params" / "ocdbt.process_0").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"has ocdbt.process_0, but no manifest.ocdbt, which Orbax writes last"):
        open_checkpoint(tmp_path / "save", "pi05_libero")


POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:0123\nsize 14470000\n"


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (POINTER, "is a Git-LFS pointer, not the file itself: `git lfs pull`"),
        (b"<!DOCTYPE html><html></html>", "is a web page, not the file itself"),
        (bytes(1000), "begins with zeros: a download set its space aside"),
    ],
)
def test_what_a_download_left_instead_of_a_file_is_named(tmp_path: Path, content: bytes, what: str) -> None:
    for name in ("model.safetensors", "config.json", "turbopi.json", f"assets/{LIBERO}/norm_stats.json"):
        folder = torch_copy(tmp_path / name.replace("/", "-"))
        (folder / name).unlink()
        (folder / name).write_bytes(content)
        with pytest.raises((CheckpointError, ConfigError), match=f"{name} {what}"):
            open_checkpoint(folder)
    (tmp_path / "tokenizer.model").write_bytes(content)
    with pytest.raises(TokenizerError, match=what):
        load_tokenizer(tmp_path / "tokenizer.model", vocab_size=10)
    folder = tmp_path / "jax"
    shutil.copytree(GOLDEN / "pi05" / "jax", folder)
    largest = max((folder / "params").rglob("*"), key=lambda file: file.stat().st_size)
    largest.write_bytes(content)
    with pytest.raises(CheckpointError, match=f"{largest.name} {what}"):
        open_checkpoint(folder, "pi05_libero").load("cpu", "f32")


def test_half_of_a_file_as_zeros_is_refused_and_one_layer_is_a_note(tmp_path: Path) -> None:
    """Scales of norms (stored less 1), adaRMS layers and biases may be zero."""
    folder = torch_copy(tmp_path / "c")
    whole = load_file(folder / "model.safetensors")
    may_be = {name: torch.zeros_like(t) for name, t in whole.items() if "norm" in name or t.ndim < 2}
    edit_tensors(folder, **may_be)
    assert open_checkpoint(folder).source.notes == []
    layer = "paligemma_with_expert.gemma_expert.model.layers.1.mlp.down_proj.weight"
    row = torch.zeros_like(whole[layer])
    row[0, 0] = 1  # not all of it
    edit_tensors(folder, **{layer: row})
    assert open_checkpoint(folder).source.notes == []
    edit_tensors(folder, **{layer: torch.zeros_like(row)})
    (note,) = open_checkpoint(folder).source.notes
    assert note.startswith("1 of the model's ") and note.endswith(f"hold nothing but zeros: {layer}")
    half = sorted(whole)[len(whole) // 2 :]
    edit_tensors(folder, **{name: torch.zeros_like(whole[name]) for name in half})
    with pytest.raises(CheckpointError, match=r"hold nothing but zeros: .* and \d+ more .*The file is there in part"):
        open_checkpoint(folder)


def test_a_trainers_own_files_are_not_taken_for_weights(tmp_path: Path) -> None:
    for name in ("optimizer.pt", "metadata.pt", "rng_state.pth", "training_args.bin"):
        (tmp_path / name).touch()
    with pytest.raises(CheckpointError, match=r"holds no checkpoint: expected model.safetensors"):
        open_checkpoint(tmp_path)
    below = tmp_path / "actor" / "model_state_dict"
    below.mkdir(parents=True)
    (below / "full_weights.pt").touch()
    with pytest.raises(CheckpointError, match=r"but actor/model_state_dict/full_weights.pt: pickled weights can run.*"
                       r"w = torch.load\(\".*full_weights.pt\", weights_only=True\); .*save_file\("):  # fmt: skip
        open_checkpoint(tmp_path)
    (below / "full_weights.pt").rename(below / "__0_0.distcp")
    with pytest.raises(CheckpointError, match=r"dcp_to_torch .*model_state_dict whole.pt"):
        open_checkpoint(tmp_path)


def test_pickled_weights_and_unmerged_adapters_are_refused(tmp_path: Path) -> None:
    (tmp_path / "pytorch_model.bin").touch()
    with pytest.raises(CheckpointError, match=r"pytorch_model.bin: pickled weights can run code"):
        open_checkpoint(tmp_path)
    (tmp_path / "adapter_config.json").touch()
    with pytest.raises(CheckpointError, match=r"adapters of the peft library.*merge_and_unload"):
        open_checkpoint(tmp_path)


def test_pi0_fast_isnt_taken_for_another(tmp_path: Path, tree: Tree) -> None:
    fast = {path: array for path, array in tree.items() if path.startswith("PaliGemma/") and "_1" not in path}
    with pytest.raises(ConfigError, match=r"is for pi05, but .* holds pi0_fast weights; presets that fit: pi0_fast"):
        open_checkpoint(jax_copy(tmp_path / "c", fast), "pi05_libero")


def test_weights_of_neither_kind_or_of_both_are_refused(tmp_path: Path, tree: Tree) -> None:
    neither = {path: array for path, array in tree.items() if "time_mlp" not in path and "final_norm_1" not in path}
    with pytest.raises(CheckpointError, match=r"neither time_mlp_in \(Pi0.5\) nor state_proj \(Pi0\)"):
        open_checkpoint(jax_copy(tmp_path / "neither", neither), "pi05_libero")
    both = tree | {"state_proj/kernel": np.zeros((32, 32), np.float32)}
    with pytest.raises(CheckpointError, match="tensors of both"):
        open_checkpoint(jax_copy(tmp_path / "both", both), "pi05_libero")


def test_missing_left_over_and_misshapen_tensors_are_named_by_their_own_names(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    layer = V + "encoder.layers.1.layer_norm1."
    edit_tensors(
        folder,
        **{
            (layer + "weight").replace(".", "__"): None,
            (layer + "bias").replace(".", "__"): torch.zeros(65),
            "critic__weight": torch.zeros(2),
        },
    )
    with pytest.raises(CheckpointError) as caught:
        open_checkpoint(folder)
    text = str(caught.value)
    assert f"missing {layer}weight;" in text
    assert "not a part of the model: critic.weight;" in text
    assert f"{layer}bias is [65], expected [64]" in text


def test_many_missing_tensors_are_counted(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    names = [name for name in load_file(folder / "model.safetensors") if "language_model.layers.2." in name]
    edit_tensors(folder, **{name.replace(".", "__"): None for name in names})
    with pytest.raises(CheckpointError, match=rf"and {len(names) - 5} more \({len(names)} in all\)"):
        open_checkpoint(folder)


def test_the_jax_layout_names_its_paths(tmp_path: Path, tree: Tree) -> None:
    linear, extra = tree.pop("PaliGemma/llm/layers/mlp_1/linear"), np.zeros(3, np.float32)
    with pytest.raises(CheckpointError, match=r"missing PaliGemma/llm/layers/mlp_1/linear\[0\].*: critic/bias"):
        open_checkpoint(jax_copy(tmp_path / "c", tree | {"critic/bias": extra}), "pi05_libero")
    wrong = tree | {"PaliGemma/llm/layers/mlp_1/linear": linear[:, :, :-1]}
    with pytest.raises(CheckpointError, match=r"mlp_1/linear\[0\] is \[31, 64\], expected \[32, 64\]"):
        open_checkpoint(jax_copy(tmp_path / "d", wrong), "pi05_libero")


def test_a_tensor_that_sizes_come_from_is_missed_by_name(tmp_path: Path, tree: Tree) -> None:
    del tree["action_in_proj/kernel"]
    with pytest.raises(CheckpointError, match="tensors are missing: action_in_proj/kernel"):
        open_checkpoint(jax_copy(tmp_path / "c", tree), "pi05_libero")


@pytest.mark.parametrize(
    ("path", "shape", "message"),
    [
        ("PaliGemma/llm/layers/attn/kv_einsum/w", (3, 2, 2, 96, 16), "1 KV head"),
        ("PaliGemma/llm/layers/attn/q_einsum/w", (3,), "which no Pi0 or Pi0.5 has"),
        ("action_in_proj/kernel", (32,), "which no Pi0 or Pi0.5 has"),
        ("PaliGemma/img/pos_embedding", (1, 250, 64), "aren't a square grid"),
        ("PaliGemma/llm/layers/attn/q_einsum_1/w", (3, 4, 32, 16), "vlm and expert share one attention"),
    ],
)
def test_impossible_shapes_are_refused(
    tmp_path: Path, tree: Tree, path: str, shape: tuple[int, ...], message: str
) -> None:
    folder = jax_copy(tmp_path / "c", tree | {path: np.zeros(shape, np.float32)})
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder, "pi05_libero")


def test_adapters_of_a_training_library_get_a_hint(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    edit_tensors(folder, action_in_proj__lora_A__weight=torch.zeros(2, 32))
    with pytest.raises(CheckpointError, match="LoRA adapters: merge them there"):
        open_checkpoint(folder)


def test_quantised_weights_are_refused(tmp_path: Path, tree: Tree) -> None:
    folder = torch_copy(tmp_path / "c")
    edit_tensors(folder, time_mlp_in__bias=torch.zeros(32, dtype=torch.int8))
    with pytest.raises(CheckpointError, match=r"stored as I8 can't be read: time_mlp_in.bias"):
        open_checkpoint(folder)
    folder = jax_copy(tmp_path / "d", tree | {"time_mlp_in/bias": np.zeros(32, np.int8)})
    with pytest.raises(CheckpointError, match=r"time_mlp_in/bias is stored as \|i1; expected one of float32"):
        open_checkpoint(folder, "pi05_libero")


def test_a_parameter_stored_twice_is_refused(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    stored = load_file(folder / "model.safetensors")[V + "post_layernorm.bias"]
    edit_tensors(folder, **{(V.replace("vision_model.", "") + "post_layernorm.bias").replace(".", "__"): stored})
    with pytest.raises(CheckpointError, match="are the same parameter"):
        open_checkpoint(folder)


def test_truncated_files_ask_whether_the_download_is_complete(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    file = folder / "model.safetensors"
    file.write_bytes(file.read_bytes()[:-100])
    with pytest.raises(CheckpointError, match=r"can't be read as safetensors .*; is the download complete"):
        open_checkpoint(folder)
    (tmp_path / "j" / "params").mkdir(parents=True)
    with pytest.raises(CheckpointError, match=r"params has no manifest.ocdbt"):
        open_checkpoint(tmp_path / "j", "pi05_libero")
    (tmp_path / "j" / "params" / "manifest.ocdbt").write_bytes(b"nonsense")
    with pytest.raises(CheckpointError, match="can't be read as an OCDBT store"):
        open_checkpoint(tmp_path / "j", "pi05_libero")


def test_a_broken_shard_index_is_refused(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "c")
    (folder / "model.safetensors").unlink()
    write_json(folder / "model.safetensors.index.json", {"weights": {}})
    with pytest.raises(CheckpointError, match="isn't a safetensors index"):
        open_checkpoint(folder)


def test_a_tree_with_another_root_is_refused(tmp_path: Path) -> None:
    params = write_tree(tmp_path / "c" / "params", {"a": np.zeros(2, np.float32)}, root="opt_state.")
    with pytest.raises(CheckpointError, match=f"{params} holds opt_state.a; expected arrays below the root `params`"):
        open_checkpoint(tmp_path / "c", "pi05_libero")


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("precision", ["f32", "bf16"])
def test_a_value_that_is_no_number_is_found_at_loading(tmp_path: Path, value: float, precision: FloatPrecision) -> None:
    folder = torch_copy(tmp_path / "copy")
    weight = load_file(folder / "model.safetensors")["action_out_proj.weight"]
    weight[3, 5] = value
    edit_tensors(folder, action_out_proj__weight=weight)
    checkpoint = open_checkpoint(folder)
    found = (
        rf"/copy: 1 of {weight.numel()} values of action_out_proj.weight are NaN or infinite \(the first is {value}\)"
    )
    with pytest.raises(CheckpointError, match=found + ".*take an earlier checkpoint"):
        checkpoint.load("cpu", precision)
    with pytest.raises(CheckpointError, match=found):
        convert(folder, tmp_path / "converted", precision=precision)
    assert not (tmp_path / "converted").exists()


def test_infinities_that_cancel_are_found(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "copy")
    bias = torch.tensor([float("inf"), -float("inf")] + 30 * [0.0])
    edit_tensors(folder, action_out_proj__bias=bias)
    with pytest.raises(CheckpointError, match=r"2 of 32 values of action_out_proj.bias are NaN or infinite"):
        open_checkpoint(folder).load("cpu", "f32")


def test_what_a_precision_makes_infinite_is_found(tmp_path: Path) -> None:
    folder = torch_copy(tmp_path / "copy")
    name = "paligemma_with_expert.gemma_expert.model.layers.0.mlp.up_proj.weight"
    weight = load_file(folder / "model.safetensors")[name].float()
    weight[:, :2] = 3.4028e38
    edit_tensors(folder, **{name.replace(".", "__"): weight})
    loaded = open_checkpoint(folder).load("cpu", "f32").state["expert.layers.0.mlp.up_proj.weight"]
    assert loaded.isfinite().all() and not loaded.sum().isfinite()
    with pytest.raises(CheckpointError, match=rf"{2 * len(weight)} of {weight.numel()} values of {name}"):
        open_checkpoint(folder).load("cpu", "bf16")


def test_a_value_that_is_no_number_is_found_in_openpis_jax_format(tmp_path: Path, tree: Tree) -> None:
    tree["action_out_proj/kernel"] = tree["action_out_proj/kernel"].copy()
    tree["action_out_proj/kernel"][0, 0] = np.nan
    folder = jax_copy(tmp_path / "copy", tree)
    with pytest.raises(CheckpointError, match=r"values of .*action_out_proj.* are NaN or infinite"):
        open_checkpoint(folder, "pi05_libero").load("cpu", "f32")


@pytest.mark.parametrize(
    "name", ["../other.safetensors", "/etc/passwd", "sub/a.safetensors", "..", "a\\b.safetensors", "a.bin"]
)
def test_an_index_names_files_of_its_own_folder_alone(tmp_path: Path, name: str) -> None:
    folder = torch_copy(tmp_path / "copy")
    (folder / "model.safetensors").rename(tmp_path / "other.safetensors")
    write_json(folder / "model.safetensors.index.json", {"weight_map": {"time_mlp_in.bias": name}})
    with pytest.raises(CheckpointError, match=r"expected plain names of .safetensors files beside it") as reported:
        open_checkpoint(folder)
    assert name in str(reported.value)
