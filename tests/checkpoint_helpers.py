"""Checkpoint folders for tests: copies of the golden ones in other shapes, and an Orbax tree reader and writer."""

import atexit
import json
import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import tensorstore as ts
import torch
from safetensors.torch import load_file, save_file

from turbopi.checkpoint import convert

STORED = Path(__file__).parent / "golden" / "checkpoints"
STATS = Path(__file__).parent / "golden" / "preprocess" / "norm_stats"
LIBERO = "physical-intelligence/libero"

Tree = dict[str, np.ndarray]


def _whole() -> Path:
    """The golden checkpoints with pi05's model.safetensors, which isn't stored: it is converted from pi05/jax.

    `test_pi05_from_jax_is_openpis_bfloat16_file` proves it equal to openpi's, tensor by tensor.
    """
    folder = Path(tempfile.mkdtemp(prefix="turbopi-golden-"))
    atexit.register(shutil.rmtree, folder)
    converted = convert(STORED / "pi05" / "jax", folder / "converted", precision="bf16", config="pi05_libero")
    for shared in ("model.json", "pi0"):
        (folder / shared).symlink_to(STORED / shared)
    (folder / "pi05").mkdir()
    (folder / "pi05" / "jax").symlink_to(STORED / "pi05" / "jax")
    shutil.copytree(STORED / "pi05" / "torch", folder / "pi05" / "torch")
    (converted / "model.safetensors").rename(folder / "pi05" / "torch" / "model.safetensors")
    shutil.rmtree(converted)
    return folder


GOLDEN = _whole()


# -- openpi's PyTorch layout -------------------------------------------------------------------------------------------


def torch_copy(folder: Path, **settings: Any) -> Path:
    """A writable copy of golden pi05/torch with a turbopi.json; settings=... are its values."""
    shutil.copytree(GOLDEN / "pi05" / "torch", folder)
    write_json(folder / "turbopi.json", {"preset": "pi05_libero", "vision_heads": 4} | settings)
    return folder


def edit_tensors(folder: Path, **changes: Any) -> dict[str, torch.Tensor]:
    """Rewrite model.safetensors with tensors added, replaced, or (None) removed; returns what was written."""
    file = folder / "model.safetensors"
    tensors = load_file(file) | {name.replace("__", "."): value for name, value in changes.items()}
    tensors = {name: value for name, value in tensors.items() if value is not None}
    file.unlink()
    save_file(tensors, file)
    return tensors


def write_json(file: Path, content: Any) -> None:
    file.write_text(json.dumps(content))


# -- openpi's JAX layout -----------------------------------------------------------------------------------------------


def read_tree(params: Path) -> Tree:
    """{path: array} of an Orbax tree, without `params` and `value`."""
    base = {"driver": "ocdbt", "base": params.resolve().as_uri() + "/"}
    keys = [key.decode() for key in ts.KvStore.open(base).result().list().result()]
    names = [key.removesuffix("/.zarray") for key in keys if key.endswith("/.zarray")]
    return {
        name.removeprefix("params.").removesuffix(".value").replace(".", "/"): ts.open(
            {"driver": "zarr", "kvstore": {**base, "path": name + "/"}}, open=True
        )
        .result()
        .read()
        .result()
        for name in names
    }


def write_tree(
    params: Path,
    tree: Mapping[str, np.ndarray],
    *,
    value: bool = False,
    root: str = "params.",
    chunks: Mapping[str, list[int]] | None = None,
    ocdbt: bool = True,
) -> Path:
    """Write an Orbax tree as Orbax does from one device: OCDBT, zarr, zstd; every array one chunk, `chunks` aside."""
    base: dict[str, Any] = {
        "driver": "ocdbt",
        "base": f"{params.resolve().as_uri()}/",
        "config": {"max_inline_value_bytes": 64},
    }
    if not ocdbt:  # a folder for each array
        base, root = {"driver": "file"}, f"{params.resolve()}/{root}"
    for path, array in tree.items():
        key = root + path.replace("/", ".") + (".value" if value else "")
        metadata = {
            "shape": list(array.shape),
            "chunks": (chunks or {}).get(path, list(array.shape)),
            "dtype": "bfloat16" if array.dtype.name == "bfloat16" else array.dtype.str,
            "compressor": {"id": "zstd", "level": 1},
        }
        spec = {"driver": "zarr", "kvstore": {**base, "path": key + "/"}, "metadata": metadata, "create": True}
        ts.open(spec).result().write(array).result()
    return params


def jax_copy(folder: Path, tree: Mapping[str, np.ndarray], kind: str = "pi05", **options: Any) -> Path:
    """A checkpoint folder of a tree, with golden statistics."""
    write_tree(folder / "params", tree, **options)
    shutil.copytree(GOLDEN / kind / "jax" / "assets", folder / "assets")
    return folder


def tree_of(state: Mapping[str, torch.Tensor], heads: int, vision_heads: int) -> Tree:
    """The JAX tree of canonical parameters: the mapping of the reader, written the other way round."""
    arrays = {name: tensor.float().numpy() for name, tensor in state.items()}
    img, block = "PaliGemma/img/", "PaliGemma/img/Transformer/encoderblock/"

    def stack(template: str) -> np.ndarray:
        depth = sum(
            name.startswith(template.split("{i}")[0]) and name.endswith(template.split("{i}")[1]) for name in arrays
        )
        return np.stack([arrays[template.format(i=i)] for i in range(depth)])

    tree: Tree = {
        img + "embedding/kernel": arrays["vision.patch_embedding.weight"].transpose(2, 3, 1, 0),
        img + "embedding/bias": arrays["vision.patch_embedding.bias"],
        img + "pos_embedding": arrays["vision.position_embedding.weight"][None],
        img + "Transformer/encoder_norm/scale": arrays["vision.post_layernorm.weight"],
        img + "Transformer/encoder_norm/bias": arrays["vision.post_layernorm.bias"],
        img + "head/kernel": arrays["projector.weight"].T,
        img + "head/bias": arrays["projector.bias"],
        "PaliGemma/llm/embedder/input_embedding": arrays["vlm.embed_tokens.weight"],
    }
    for n in (0, 1):
        tree[f"{block}LayerNorm_{n}/scale"] = stack(f"vision.layers.{{i}}.layer_norm{n + 1}.weight")
        tree[f"{block}LayerNorm_{n}/bias"] = stack(f"vision.layers.{{i}}.layer_norm{n + 1}.bias")
        tree[f"{block}MlpBlock_0/Dense_{n}/kernel"] = stack(f"vision.layers.{{i}}.mlp.fc{n + 1}.weight").swapaxes(1, 2)
        tree[f"{block}MlpBlock_0/Dense_{n}/bias"] = stack(f"vision.layers.{{i}}.mlp.fc{n + 1}.bias")
    for theirs, ours in (("query", "q"), ("key", "k"), ("value", "v"), ("out", "out")):
        weight = stack(f"vision.layers.{{i}}.self_attn.{ours}_proj.weight").swapaxes(1, 2)  # [L, in, out]
        bias = stack(f"vision.layers.{{i}}.self_attn.{ours}_proj.bias")
        depth, width = bias.shape
        head_dim = width // vision_heads
        shape = (vision_heads, head_dim, width) if ours == "out" else (width, vision_heads, head_dim)
        tree[f"{block}MultiHeadDotProductAttention_0/{theirs}/kernel"] = weight.reshape(depth, *shape)
        tree[f"{block}MultiHeadDotProductAttention_0/{theirs}/bias"] = (
            bias if ours == "out" else bias.reshape(depth, vision_heads, head_dim)
        )
    for name in ("vlm", "expert"):
        tree |= _gemma_tree(name, "" if name == "vlm" else "_1", arrays, stack, heads)
    for name in arrays:
        if name.startswith(("action_", "time_", "state_")):
            module, leaf = name.split(".")
            tree[f"{module}/{'kernel' if leaf == 'weight' else 'bias'}"] = arrays[name].T
    return {path: np.ascontiguousarray(array) for path, array in tree.items()}


def _gemma_tree(name: str, suffix: str, arrays: Tree, stack: Any, heads: int) -> Tree:
    llm = "PaliGemma/llm/layers/"

    def layers(what: str) -> Any:
        return stack(f"{name}.layers.{{i}}.{what}.weight")

    q, k, v, o = (layers(f"self_attn.{letter}_proj") for letter in "qkvo")
    depth, rows, width = q.shape
    head_dim = rows // heads
    tree: Tree = {
        f"{llm}attn/q_einsum{suffix}/w": q.reshape(depth, heads, head_dim, width).swapaxes(2, 3),
        f"{llm}attn/kv_einsum{suffix}/w": np.stack((k, v), axis=1).swapaxes(2, 3)[:, :, None],
        f"{llm}attn/attn_vec_einsum{suffix}/w": o.swapaxes(1, 2).reshape(depth, heads, head_dim, width),
        f"{llm}mlp{suffix}/gating_einsum": np.stack((layers("mlp.gate_proj"), layers("mlp.up_proj")), 1).swapaxes(2, 3),
        f"{llm}mlp{suffix}/linear": layers("mlp.down_proj").swapaxes(1, 2),
    }
    for theirs, ours in (("pre_attention_norm", "input_layernorm"), ("pre_ffw_norm", "post_attention_layernorm")):
        if f"{name}.layers.0.{ours}.weight" in arrays:
            tree[f"{llm}{theirs}{suffix}/scale"] = layers(ours)
        else:
            tree[f"{llm}{theirs}{suffix}/Dense_0/kernel"] = layers(f"{ours}.dense").swapaxes(1, 2)
            tree[f"{llm}{theirs}{suffix}/Dense_0/bias"] = stack(f"{name}.layers.{{i}}.{ours}.dense.bias")
    norm = f"PaliGemma/llm/final_norm{suffix}/"
    if f"{name}.norm.weight" in arrays:
        tree[norm + "scale"] = arrays[f"{name}.norm.weight"]
    else:
        tree[norm + "Dense_0/kernel"] = arrays[f"{name}.norm.dense.weight"].T
        tree[norm + "Dense_0/bias"] = arrays[f"{name}.norm.dense.bias"]
    return tree


# -- LeRobot's layout --------------------------------------------------------------------------------------------------


def lerobot_copy(folder: Path, mode: str = "QUANTILES", **config: Any) -> Path:
    """Golden pi05 weights as LeRobot 0.6 would save them; config=... changes config.json."""
    folder.mkdir()
    tensors = load_file(GOLDEN / "pi05" / "torch" / "model.safetensors")
    save_file({f"model.{name}": tensor for name, tensor in tensors.items()}, folder / "model.safetensors")
    mapping = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    image = {"type": "VISUAL", "shape": [3, 256, 256]}
    state, action = {"type": "STATE", "shape": [8]}, {"type": "ACTION", "shape": [7]}
    inputs = {
        "observation.images.image": image,
        "observation.images.image2": image,
        "observation.state": state,
        "observation.images.empty_camera_0": {"type": "VISUAL", "shape": [3, 224, 224]},
    }
    described = {
        "type": "pi05",
        "n_obs_steps": 1,
        "input_features": inputs,
        "output_features": {"action": action},
        "chunk_size": 30,
        "n_action_steps": 10,
        "max_state_dim": 32,
        "max_action_dim": 32,
        "num_inference_steps": 7,
        "min_period": 0.004,
        "max_period": 4.0,
        "image_resolution": [224, 224],
        "empty_cameras": 1,
        "tokenizer_max_length": 180,
        "normalization_mapping": mapping,
        "use_relative_actions": False,
        "dtype": "bfloat16",
    }
    write_json(folder / "config.json", described | config)
    features = {name: feature for name, feature in inputs.items() if "empty" not in name} | {"action": action}
    normalizer = {"eps": 1e-8, "features": features, "norm_map": mapping}
    write_json(
        folder / "policy_preprocessor.json",
        {
            "name": "policy_preprocessor",
            "steps": [
                {"registry_name": "rename_observations_processor", "config": {"rename_map": {}}},
                {"registry_name": "to_batch_processor", "config": {}},
                {"registry_name": "normalizer_processor", "config": normalizer, "state_file": "pre_stats.safetensors"},
                {"registry_name": "pi05_prepare_state_tokenizer_processor_step", "config": {}},
                {
                    "registry_name": "tokenizer_processor",
                    "config": {"max_length": 180, "tokenizer_name": "google/paligemma-3b-pt-224"},
                },
                {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}},
            ],
        },
    )
    unnormalizer = {"eps": 1e-8, "features": {"action": action}, "norm_map": mapping}
    write_json(
        folder / "policy_postprocessor.json",
        {
            "name": "policy_postprocessor",
            "steps": [
                {"registry_name": "unnormalizer_processor", "config": unnormalizer, "state_file": "post.safetensors"},
                {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}},
            ],
        },
    )
    statistics = lerobot_statistics()
    save_file(statistics, folder / "pre_stats.safetensors")
    # the actions' statistics come from the postprocessor: let the other file have useless ones
    save_file({name: tensor for name, tensor in statistics.items() if "action" in name}, folder / "post.safetensors")
    save_file(
        statistics | {"action.mean": torch.zeros(7), "action.q01": torch.zeros(7)}, folder / "pre_stats.safetensors"
    )
    return folder


def lerobot_statistics() -> dict[str, torch.Tensor]:
    """The statistics of golden pi05 as LeRobot's flat float32 tensors, with made-up min, max, q10 and q90."""
    content = json.loads((GOLDEN / "pi05" / "torch" / "assets" / LIBERO / "norm_stats.json").read_text())["norm_stats"]
    found = {}
    for ours, theirs in (("state", "observation.state"), ("actions", "action")):
        for name, values in content[ours].items():
            found[f"{theirs}.{name}"] = torch.tensor(values, dtype=torch.float32)
        found[f"{theirs}.min"] = found[f"{theirs}.q01"] - 1
        found[f"{theirs}.max"] = found[f"{theirs}.q99"] + 1
        found[f"{theirs}.q10"] = found[f"{theirs}.q01"] + 0.01
        found[f"{theirs}.q90"] = found[f"{theirs}.q99"] + 0.01
        found[f"{theirs}.count"] = torch.tensor([1000.0])
    found["observation.images.image.mean"] = torch.zeros(3, 1, 1)
    return found


def edit_json(file: Path, change: Any) -> None:
    """Rewrite a JSON file after `change(content)`."""
    content = json.loads(file.read_text())
    change(content)
    write_json(file, content)
