"""RLinf's layout of the same weights, made of a golden checkpoint as RLinf's converter makes it."""

import re
import shutil
from pathlib import Path

import pytest
import torch
from checkpoint_helpers import GOLDEN, edit_tensors, torch_copy, write_json
from safetensors.torch import save_file
from torch import Tensor

from turbopi.checkpoint import open_checkpoint
from turbopi.support.errors import CheckpointError

SETTINGS = {"vision_heads": 4}
NORMS = {"input_layernorm": "pre_attention_norms", "post_attention_layernorm": "pre_ffw_norms"}
KINDS = {"weight": "scale", "dense.weight": "ada_modulation.weight", "dense.bias": "ada_modulation.bias"}


def rlinf(state: dict[str, Tensor]) -> dict[str, Tensor]:
    """Canonical parameters in RLinf's layout."""
    made: dict[str, Tensor] = {}
    for name, value in state.items():
        if (found := re.fullmatch(r"vision\.layers\.(\d+)\.(.+)", name)) is not None:
            layer, rest = f"img.encoder.layers.{found[1]}", found[2]
            if (joined := re.fullmatch(r"self_attn\.q_proj\.(weight|bias)", rest)) is not None:
                parts = [state[name.replace("q_proj", f"{x}_proj")] for x in "qkv"]
                made[f"{layer}.attn.in_proj_{joined[1]}"] = torch.cat(parts)
            elif not re.match(r"self_attn\.[kv]_proj", rest):
                made[f"{layer}.{rest.replace('layer_norm', 'norm').replace('self_attn', 'attn')}"] = value
        elif (found := re.fullmatch(r"(vlm|expert)\.norm\.(.+)", name)) is not None:
            made[f"llm.final_norms.{'ve'.index(found[1][0])}.{KINDS[found[2]]}"] = value
        elif (found := re.fullmatch(r"(vlm|expert)\.layers\.(\d+)\.(\w+)\.(.+)", name)) is not None:
            index, layer, module, rest = "ve".index(found[1][0]), f"llm.layers.{found[2]}", found[3], found[4]
            if module in NORMS:
                made[f"{layer}.{NORMS[module]}.{index}.{KINDS[rest]}"] = value
            elif module == "self_attn":
                projection, kind = rest.split(".")
                made[f"{layer}.attn.{projection}.{index}.{kind}"] = value
            elif rest.startswith("gate_proj"):
                up = state[name.replace("gate_proj", "up_proj")]
                made[f"{layer}.mlps.{index}.w_gating"] = torch.stack((value.T, up.T))
            elif rest.startswith("down_proj"):
                made[f"{layer}.mlps.{index}.w_linear"] = value.T.contiguous()
        else:
            for ours, theirs in (
                ("vision.patch_embedding", "img.stem"),
                ("vision.post_layernorm", "img.encoder.norm"),
                ("projector", "img.head"),
                ("vlm.embed_tokens", "llm.embedder.embedding"),
            ):
                name = name.replace(ours, theirs)
            made[name] = value
    made["img.pos_embedding"] = made.pop("vision.position_embedding.weight")[None]
    return made


def written(folder: Path, kind: str, prefix: str = "") -> tuple[Path, str]:
    """Such a folder, and the fingerprint of the golden weights."""
    config = {"preset": "pi05_libero" if kind == "pi05" else "pi0_aloha", **SETTINGS}
    (folder / "rlinf" / "physical-intelligence" / "behavior").mkdir(parents=True)
    write_json(folder / "config.json", config)
    plain = open_checkpoint(GOLDEN / kind / "jax", folder / "config.json")
    tensors = {f"{prefix}{name}": one for name, one in rlinf(plain.load("cpu", "f32").state).items()}
    save_file({name: one.contiguous() for name, one in tensors.items()}, folder / "rlinf" / "model.safetensors")
    (stats,) = (GOLDEN / kind / "jax" / "assets").rglob("norm_stats.json")
    shutil.copy(stats, folder / "rlinf" / "physical-intelligence" / "behavior")
    write_json(folder / "rlinf" / "turbopi.json", config | {"asset_id": "physical-intelligence/behavior"})
    return folder / "rlinf", plain.fingerprint()


@pytest.mark.parametrize(("kind", "prefix"), [("pi05", ""), ("pi0", "model.")])
def test_the_same_weights_are_read(tmp_path: Path, kind: str, prefix: str) -> None:
    folder, expected = written(tmp_path, kind, prefix)
    opened = open_checkpoint(folder)
    assert opened.fingerprint() == expected and opened.config.model.kind == kind
    assert "weights in RLinf's layout" in opened.source.notes
    assert opened.source.native_name("vlm.layers.0.mlp.up_proj.weight") == f"{prefix}llm.layers.0.mlps.0.w_gating"


def test_what_is_missing_too_much_or_misshapen_is_named(tmp_path: Path) -> None:
    folder, _ = written(tmp_path, "pi05")
    edit_tensors(folder, **{"llm.layers.1.attn.o_proj.1.weight": None, "pointnet.weight": torch.ones(2, 2)})
    message = r"missing expert\.layers\.1\.self_attn\.o_proj\.weight; not a part of the model: pointnet\.weight"
    with pytest.raises(CheckpointError, match=message):
        open_checkpoint(folder)
    edit_tensors(folder, **{"llm.layers.0.mlps.0.w_gating": torch.ones(8)})
    with pytest.raises(CheckpointError, match=r"w_gating has shape \[8\], which no Pi0 or Pi0\.5 has"):
        open_checkpoint(folder)


def test_a_critic_beside_openpis_weights_changes_nothing(tmp_path: Path) -> None:
    """What RLinf trains with openpi's own model has them, and its deterministic Euler steps read neither."""
    plain, folder = torch_copy(tmp_path / "plain"), torch_copy(tmp_path / "critic")
    edit_tensors(folder, **{"value_head.0.weight": torch.ones(4, 4), "noise_head.mlp.bias": torch.ones(4)})
    assert open_checkpoint(folder).fingerprint() == open_checkpoint(plain).fingerprint()
