"""LoRA adapters of the peft library beside LeRobot's files: merged as peft computes them, or refused by name.

That the numbers are peft's is shown by test_lerobot_golden.py; here are the rule in plain words, and what goes wrong.
"""

import json
from pathlib import Path
from typing import Any

import pytest
import torch
from checkpoint_helpers import edit_json, write_json
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from lerobot_golden import GOLDEN, GoldenCase
from safetensors.torch import load_file, save_file

from turbopi.checkpoint import convert, inspect_checkpoint, open_checkpoint
from turbopi.support.errors import CheckpointError, ConfigError

ADAPTER, CONFIG = "adapter_model.safetensors", "adapter_config.json"
OUT, IN = "base_model.model.model.action_out_proj.", "base_model.model.model.action_in_proj."


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """An adapter, with its base model in ../base."""
    return GoldenCase(GOLDEN / "peft").assemble(tmp_path)


def edit_adapter(folder: Path, **changes: Any) -> None:
    tensors = load_file(folder / ADAPTER) | {name.replace("__", "."): value for name, value in changes.items()}
    (folder / ADAPTER).unlink()
    save_file({name: value for name, value in tensors.items() if value is not None}, folder / ADAPTER)


def only(folder: Path, **tensors: torch.Tensor) -> None:
    """Make the adapter one of action_out_proj alone, of tensors by the ends of their names."""
    edit_adapter(folder, **dict.fromkeys(load_file(folder / ADAPTER)), **{OUT + k: v for k, v in tensors.items()})


def weights(folder: Path) -> dict[str, torch.Tensor]:
    return open_checkpoint(folder).load("cpu", "f32").state


@pytest.mark.parametrize(
    ("config", "scale"),
    [
        ({}, 8 / 4),
        ({"lora_alpha": 6, "alpha_pattern": None, "rank_pattern": None}, 6 / 4),
        ({"use_rslora": True}, 8 / 2),
        ({"alpha_pattern": {"out_proj": 3, "action_out_proj": 5}}, 5 / 4),  # whole parts of a name
        ({"alpha_pattern": {r"action_.*": 2, "action_out_proj": 5}}, 2 / 4),  # the first that matches
        ({"r": 7, "rank_pattern": {r"model\.action_out_proj": 4}}, 8 / 4),
    ],
)
def test_the_product_is_scaled_by_alpha_over_rank(folder: Path, config: dict[str, Any], scale: float) -> None:
    a, b = torch.randn(4, 16), torch.randn(32, 4)
    only(folder, lora_A__weight=a, lora_B__weight=b)
    edit_json(folder / CONFIG, lambda content: content.update(config))
    base = load_file(folder.parent / "base" / "model.safetensors")["model.action_out_proj.weight"]
    merged = weights(folder)["action_out_proj.weight"]
    assert torch.allclose(merged, base + scale * (b @ a), atol=1e-6, rtol=1e-6)
    assert (merged - base).abs().max() > 0.1


def test_what_the_adapter_does_not_touch_is_the_bases(folder: Path) -> None:
    only(folder, lora_A__weight=torch.randn(4, 16), lora_B__weight=torch.randn(32, 4))
    base = load_file(folder.parent / "base" / "model.safetensors")
    for name, value in weights(folder).items():
        if name.startswith(("action_in", "time_")):
            assert torch.equal(value, base["model." + name])


def test_a_weight_of_many_pieces_is_merged_whole(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = weights(folder)
    monkeypatch.setattr("turbopi.checkpoint.torch_files.row_ranges", _rows_of_three)
    pieces = weights(folder)
    assert all(torch.allclose(pieces[name], whole[name], atol=1e-6) for name in whole)


def _rows_of_three(shape: Any, itemsize: int) -> Any:
    for start in range(0, shape[0], 3):
        yield start, min(start + 3, shape[0])


def test_the_merge_is_told_and_counts_in_the_fingerprint(folder: Path) -> None:
    checkpoint = open_checkpoint(folder)
    (note,) = (note for note in checkpoint.info()["notes"] if "LoRA" in note)
    assert note == f"LoRA adapters of 12 weights are merged into the weights of {folder.parent / 'base'}"
    before = checkpoint.fingerprint(trust_files=True)
    edit_json(folder / CONFIG, lambda content: content.update(lora_alpha=9))
    assert open_checkpoint(folder).fingerprint(trust_files=True) != before


def test_a_converted_adapter_is_a_whole_checkpoint(folder: Path, tmp_path: Path) -> None:
    converted = open_checkpoint(convert(folder, tmp_path / "converted", precision="f32"))
    assert converted.fingerprint() == open_checkpoint(folder).fingerprint()


# -- the base model ----------------------------------------------------------------------------------------------------


def settings_without_base(folder: Path) -> None:
    edit_json(folder / "turbopi.json", lambda content: content.pop("base_model"))


def test_a_base_that_isnt_here_is_asked_for(folder: Path) -> None:
    settings_without_base(folder)
    with pytest.raises(CheckpointError, match="holds an adapter without its base model") as reported:
        open_checkpoint(folder)
    message = str(reported.value)
    assert "adapter_config.json names its base model 'lerobot/base', which is no folder here" in message
    assert "hf download lerobot/base --local-dir DIR" in message
    assert '{"base_model": "/path/to/it"}' in message
    assert "merge_and_unload" in message
    edit_json(folder / CONFIG, lambda content: content.update(base_model_name_or_path=None))
    with pytest.raises(CheckpointError, match=r"adapter_config\.json names no base model"):
        open_checkpoint(folder)


@pytest.mark.parametrize("absolute", [True, False])
def test_a_base_that_the_adapter_names_is_found_as_lerobot_finds_it(
    folder: Path, absolute: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = weights(folder)
    settings_without_base(folder)
    monkeypatch.chdir(folder.parent)
    name = str(folder.parent / "base") if absolute else "base"
    edit_json(folder / CONFIG, lambda content: content.update(base_model_name_or_path=name))
    assert all(torch.equal(value, expected[name]) for name, value in weights(folder).items())


def test_a_start_that_left_the_base_alone_is_merged_like_any(folder: Path) -> None:
    expected = weights(folder)["action_in_proj.weight"]
    for start in (False, None, "gaussian", "Gaussian", "GAUSSIAN", "eva", "orthogonal"):
        edit_json(folder / CONFIG, lambda content: content.update(init_lora_weights=start))  # noqa: B023
        assert torch.equal(weights(folder)["action_in_proj.weight"], expected), start


def test_a_base_that_cannot_be_one_is_refused(folder: Path) -> None:
    write_json(folder / "turbopi.json", {"vision_heads": 2, "base_model": "nowhere"})
    with pytest.raises(CheckpointError, match=f"there is no folder {folder / 'nowhere'}"):
        open_checkpoint(folder)
    write_json(folder / "turbopi.json", {"vision_heads": 2, "base_model": "."})
    with pytest.raises(CheckpointError, match="which is an adapter itself: merge it first"):
        open_checkpoint(folder)


def test_only_adapters_have_a_base(folder: Path) -> None:
    base = folder.parent / "base"
    write_json(base / "turbopi.json", {"vision_heads": 2, "base_model": str(base)})
    with pytest.raises(ConfigError, match="base_model only applies to adapters"):
        open_checkpoint(base)


def test_inspect_shows_an_adapter_whose_config_is_wrong(folder: Path) -> None:
    edit_json(folder / "turbopi.json", lambda content: content.pop("vision_heads"))
    info = inspect_checkpoint(folder)
    assert "vision_heads" in info["config_error"]
    assert any("are merged into" in note for note in info["notes"])


def test_whole_weights_are_read_where_lerobot_reads_them(folder: Path) -> None:
    """A folder with both: config.json's use_peft decides."""
    base = folder.parent / "base" / "model.safetensors"
    (folder / "model.safetensors").write_bytes(base.read_bytes())
    assert not torch.equal(weights(folder)["action_out_proj.weight"], load_file(base)["model.action_out_proj.weight"])
    edit_json(folder / "config.json", lambda content: content.update(use_peft=False))
    settings_without_base(folder)
    assert torch.equal(weights(folder)["action_out_proj.weight"], load_file(base)["model.action_out_proj.weight"])
    notes = open_checkpoint(folder).info()["notes"]
    assert any("adapter_config.json isn't followed" in note for note in notes)


# -- what is refused ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"peft_type": "LOHA"}, r"peft_type is 'LOHA'; Turbo-Pi merges LORA.*merge_and_unload"),
        ({"peft_type": None}, "peft_type is None; expected a text"),
        ({"use_dora": True}, "asks for use_dora = True, which Turbo-Pi doesn't merge.*merge_and_unload"),
        ({"lora_bias": True}, "lora_bias = True"),
        ({"trainable_token_indices": [1, 2]}, r"trainable_token_indices = \[1, 2\]"),
        ({"layer_replication": [[0, 2]]}, r"layer_replication = \[\[0, 2\]\]"),
        ({"init_lora_weights": "pissa"}, "init_lora_weights = 'pissa'"),
        ({"init_lora_weights": ["a"]}, r"init_lora_weights = \['a'\]"),
        ({"init_lora_weights": "EVA"}, "init_lora_weights = 'EVA'"),  # which peft doesn't know, either
        ({"init_lora_weights": 1}, "init_lora_weights = 1"),
        ({"something_new": 3}, "something_new = 3"),
        ({"r": 0}, "r is 0; expected a whole number from 1"),
        ({"r": 4.0}, r"r is 4\.0; expected a whole number"),
        ({"lora_alpha": "8"}, "lora_alpha is '8'; expected a finite number"),
        ({"use_rslora": 1}, "use_rslora is 1; expected true or false"),
        ({"rank_pattern": [2]}, r"rank_pattern is \[2\]; expected an object"),
        ({"rank_pattern": {"q_proj": "2"}}, "q_proj is '2'; expected a finite number"),
        ({"alpha_pattern": {"(": 2}}, r"alpha_pattern has '\('"),
        ({"alpha_pattern": {r"((\w+)+)+!": 2}}, "alpha_pattern has .*, which may take for ever to match"),
        ({"rank_pattern": {".*.*.*.*x": 2}}, "rank_pattern has .*, which may take for ever to match"),
        ({"rank_pattern": {"a?" * 40: 2}}, "rank_pattern has .*, which may take for ever to match"),
        ({"rank_pattern": {"a" * 301: 2}}, "rank_pattern has .*, which may take for ever to match"),
        ({"rank_pattern": {"q_proj": 3}}, r"q_proj has rank 2, but .*adapter_config\.json says 3"),
        ({"r": 8}, r"has rank 4, but .* says 8; one of the files belongs to another adapter"),
    ],
)
def test_what_is_not_plain_lora_is_refused(folder: Path, config: dict[str, Any], message: str) -> None:
    edit_json(folder / CONFIG, lambda content: content.update(config))
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"lora_A__weight": None}, "is incomplete: the adapter of action_out_proj has one of its two matrices"),
        ({"lora_B__weight": None}, "is incomplete"),
        (
            {"lora_B__weight": torch.zeros(31, 4)},
            r"lora_B.weight \[31, 4\] doesn't fit model.action_out_proj.weight \[32",
        ),
        ({"lora_A__weight": torch.zeros(4)}, r"lora_A.weight \[4\] and .* doesn't fit"),
        ({"lora_A__weight": torch.tensor(1.0)}, r"lora_A.weight \[\] and .* doesn't fit"),
        ({"lora_magnitude_vector": torch.zeros(32)}, "lora_magnitude_vector isn't merged by Turbo-Pi"),
        (
            {"weight": torch.zeros(32, 16)},
            "action_out_proj.weight is the second change of model.action_out_proj.weight",
        ),
        ({"bias": torch.zeros(3)}, r"action_out_proj.bias \[3\] doesn't fit model.action_out_proj.bias \[32\]"),
        (
            {"critic": torch.zeros(3)},
            "action_out_proj.critic is for action_out_proj.critic, which the base model doesn't",
        ),
        ({"bias": torch.zeros(32, dtype=torch.int64)}, r"holds .*action_out_proj\.bias; expected float32, bfloat16"),
    ],
)
def test_adapters_that_do_not_fit_are_refused(folder: Path, changes: dict[str, Any], message: str) -> None:
    edit_adapter(folder, **{OUT.replace(".", "__") + name: value for name, value in changes.items()})
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)


def test_names_of_another_kind_are_refused(folder: Path) -> None:
    edit_adapter(folder, transformer__lora_A=torch.zeros(2, 2))
    with pytest.raises(CheckpointError, match=r"holds transformer\.lora_A; expected .* below base_model\.model"):
        open_checkpoint(folder)


def test_a_missing_or_damaged_file_is_named(folder: Path) -> None:
    (folder / ADAPTER).write_bytes((folder / ADAPTER).read_bytes()[:500])
    with pytest.raises(CheckpointError, match=f"{ADAPTER} can't be read as safetensors"):
        open_checkpoint(folder)
    (folder / ADAPTER).unlink()
    with pytest.raises(CheckpointError, match=f"{ADAPTER} can't be read"):
        open_checkpoint(folder)
    (folder / CONFIG).write_text("{")
    with pytest.raises(CheckpointError, match=f"{CONFIG} isn't JSON"):
        open_checkpoint(folder)


def test_an_adapter_without_a_policys_description_is_refused(folder: Path) -> None:
    (folder / "config.json").unlink()
    with pytest.raises(CheckpointError, match=r"without LeRobot's config\.json and processors.*merge_and_unload"):
        open_checkpoint(folder)


def test_adapters_of_heads_change_nothing(folder: Path) -> None:
    before = weights(folder)
    heads = ("paligemma_with_expert.paligemma.lm_head", "paligemma_with_expert.gemma_expert.lm_head")
    added = {}
    for head, width in zip(heads, (24, 16), strict=True):
        added[f"base_model.model.model.{head}.lora_A.weight"] = torch.ones(4, width)
        added[f"base_model.model.model.{head}.lora_B.weight"] = torch.ones(1024, 4)
    edit_adapter(folder, **added)
    assert all(torch.equal(value, before[name]) for name, value in weights(folder).items())


def test_an_adapter_that_blows_up_is_found_at_loading(folder: Path) -> None:
    b = load_file(folder / ADAPTER)[OUT + "lora_B.weight"]
    b[0, 0] = float("nan")
    edit_adapter(folder, **{OUT + "lora_B.weight": b})
    with pytest.raises(CheckpointError, match=r"16 of 512 values of model.action_out_proj.weight are NaN"):
        weights(folder)


def test_the_golden_adapter_is_as_lerobot_saves_it(folder: Path) -> None:
    assert json.loads((folder / "config.json").read_text())["use_peft"] is True
    assert json.loads((folder / CONFIG).read_text())["base_model_name_or_path"] == "lerobot/base"


@pytest.mark.slow
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_value_in_the_adapters_config_is_followed_or_refused(folder: Path, data: st.DataObject) -> None:
    plain = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text()
    nested = st.recursive(plain, lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner), max_leaves=4)
    original = (folder / CONFIG).read_text()
    content = json.loads(original)
    write_json(folder / CONFIG, content | {data.draw(st.sampled_from(sorted(content))): data.draw(nested)})
    message = ""
    try:
        open_checkpoint(folder)
    except CheckpointError as error:
        message = str(error)
    (folder / CONFIG).write_text(original)
    assert "\n" not in message
