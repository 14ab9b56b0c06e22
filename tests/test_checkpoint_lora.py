"""LoRA adapters of openpi's JAX fine-tunes, against what openpi's forward pass computes with them unmerged."""

from pathlib import Path

import numpy as np
import pytest
from checkpoint_helpers import GOLDEN, Tree, jax_copy, read_tree, write_json

from turbopi.checkpoint import Checkpoint, open_checkpoint
from turbopi.support.errors import CheckpointError, ConfigError

LLM = "PaliGemma/llm/layers/"
LAYER = 1  # of 3
RANKS = {"": 16, "_1": 32}  # openpi's gemma_2b_lora and gemma_300m_lora
STACKS = {"": "vlm", "_1": "expert"}


def with_adapters(tree: Tree, ranks: dict[str, int]) -> Tree:
    """Adapters in openpi's shapes beside every Gemma matrix of the given stacks."""
    rng = np.random.default_rng(0)
    tree = dict(tree)
    for suffix, rank in ranks.items():
        for module in (f"attn/q_einsum{suffix}/", f"attn/kv_einsum{suffix}/", f"attn/attn_vec_einsum{suffix}/"):
            add(tree, rng, LLM + module + "w", LLM + module, rank)
        for name in (f"mlp{suffix}/gating_einsum", f"mlp{suffix}/linear"):
            add(tree, rng, LLM + name, LLM + name + "_", rank)
    return tree


def add(tree: Tree, rng: np.random.Generator, weight: str, stem: str, rank: int) -> None:
    shape = tree[weight].shape
    tree[stem + "lora_a"] = rng.normal(0, 0.1, (*shape[:-1], rank)).astype(np.float32)
    tree[stem + "lora_b"] = rng.normal(0, 0.1, (*shape[:-2], rank, shape[-1])).astype(np.float32)


@pytest.fixture(scope="module")
def tree() -> Tree:
    return with_adapters(read_tree(GOLDEN / "pi05" / "jax" / "params"), RANKS)


@pytest.fixture(scope="module")
def adapted(tree: Tree, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return jax_copy(tmp_path_factory.mktemp("lora") / "c", tree)


@pytest.fixture(scope="module")
def merged(adapted: Path) -> Checkpoint:
    return open_checkpoint(adapted, "pi05_libero")


def weight(checkpoint: Checkpoint, suffix: str, name: str) -> np.ndarray:
    """A merged matrix of layer LAYER, [out, in]."""
    state = checkpoint.load("cpu", "f32").state
    return state[f"{STACKS[suffix]}.layers.{LAYER}.{name}.weight"].double().numpy()


def layer(tree: Tree, path: str) -> np.ndarray:
    return tree[LLM + path][LAYER].astype(np.float64)


def assert_same(actual: np.ndarray, expected: np.ndarray) -> None:
    assert np.abs(actual - expected).max() < 1e-5 * np.abs(expected).max()


@pytest.mark.parametrize("suffix", ["", "_1"])
def test_queries_equal_openpis_einsums(tree: Tree, merged: Checkpoint, suffix: str) -> None:
    w, a, b = (layer(tree, f"attn/q_einsum{suffix}/{name}") for name in ("w", "lora_a", "lora_b"))
    x = np.random.default_rng(1).normal(size=(5, w.shape[1]))
    unmerged = np.einsum("td,ndh->tnh", x, w)
    unmerged += np.einsum("tnl,nlh->tnh", np.einsum("td,ndl->tnl", x, a), b)
    assert_same(x @ weight(merged, suffix, "self_attn.q_proj").T, unmerged.reshape(5, -1))


@pytest.mark.parametrize("suffix", ["", "_1"])
def test_keys_and_values_equal_openpis_einsums(tree: Tree, merged: Checkpoint, suffix: str) -> None:
    w, a, b = (layer(tree, f"attn/kv_einsum{suffix}/{name}") for name in ("w", "lora_a", "lora_b"))
    x = np.random.default_rng(1).normal(size=(5, w.shape[2]))
    unmerged = np.einsum("sd,ckdh->cskh", x, w)
    unmerged += np.einsum("cskl,cklh->cskh", np.einsum("sd,ckdl->cskl", x, a), b)
    for index, name in enumerate(("k", "v")):
        assert_same(x @ weight(merged, suffix, f"self_attn.{name}_proj").T, unmerged[index, :, 0])


@pytest.mark.parametrize("suffix", ["", "_1"])
def test_attention_outputs_sum_b_over_the_heads_as_openpis_einsum_does(
    tree: Tree, merged: Checkpoint, suffix: str
) -> None:
    w, a, b = (layer(tree, f"attn/attn_vec_einsum{suffix}/{name}") for name in ("w", "lora_a", "lora_b"))
    x = np.random.default_rng(1).normal(size=(5, *w.shape[:2]))
    unmerged = np.einsum("tnh,nhd->td", x, w)
    unmerged += np.einsum("tl,nld->td", np.einsum("tnh,nhl->tl", x, a), b)
    assert_same(x.reshape(5, -1) @ weight(merged, suffix, "self_attn.o_proj").T, unmerged)


@pytest.mark.parametrize("suffix", ["", "_1"])
def test_mlps_equal_openpis_products(tree: Tree, merged: Checkpoint, suffix: str) -> None:
    w, a, b = (layer(tree, f"mlp{suffix}/gating_einsum{name}") for name in ("", "_lora_a", "_lora_b"))
    x = np.random.default_rng(1).normal(size=(5, w.shape[1]))
    for index, name in enumerate(("gate", "up")):
        assert_same(x @ weight(merged, suffix, f"mlp.{name}_proj").T, x @ w[index] + x @ a[index] @ b[index])
    w, a, b = (layer(tree, f"mlp{suffix}/linear{name}") for name in ("", "_lora_a", "_lora_b"))
    x = np.random.default_rng(1).normal(size=(5, w.shape[0]))
    assert_same(x @ weight(merged, suffix, "mlp.down_proj").T, x @ w + x @ a @ b)


def test_what_was_merged_is_told_and_changes_the_fingerprint(merged: Checkpoint) -> None:
    (note,) = merged.info()["notes"]
    assert note == "10 LoRA adapters are merged at load (attention: vlm rank 16, factor 1; expert rank 32, factor 1)"
    base = open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero")
    assert merged.fingerprint() != base.fingerprint()
    assert merged.info()["parameters"] == base.info()["parameters"]


@pytest.mark.slow
def test_alpha_scales_attention_and_not_mlps(tree: Tree, adapted: Path, merged: Checkpoint, tmp_path: Path) -> None:
    base = open_checkpoint(GOLDEN / "pi05" / "jax", "pi05_libero")

    def delta(checkpoint: Checkpoint, suffix: str, name: str) -> np.ndarray:
        return weight(checkpoint, suffix, name) - weight(base, suffix, name)

    for rslora, expected in ((False, {"": 8 / 16, "_1": 32 / 32}), (True, {"": 8 / 4, "_1": 32 / 32**0.5})):
        settings = {"preset": "pi05_libero", "lora_alpha": {"vlm": 8, "expert": 32}, "lora_rslora": rslora}
        write_json(tmp_path / "c.json", settings)
        scaled = open_checkpoint(adapted, tmp_path / "c.json")
        for suffix, factor in expected.items():
            for name in ("self_attn.q_proj", "self_attn.v_proj", "self_attn.o_proj"):
                assert np.allclose(delta(scaled, suffix, name), factor * delta(merged, suffix, name), atol=1e-5), name
            assert np.array_equal(weight(scaled, suffix, "mlp.up_proj"), weight(merged, suffix, "mlp.up_proj"))


def test_a_rank_that_openpi_does_not_use_needs_its_alpha(tmp_path: Path) -> None:
    tree = with_adapters(read_tree(GOLDEN / "pi05" / "jax" / "params"), {"_1": 4})
    folder = jax_copy(tmp_path / "c", tree)
    with pytest.raises(
        ConfigError, match=r'expert LoRA adapters have rank 4.*no checkpoint records alpha.*"lora_alpha"'
    ):
        open_checkpoint(folder, "pi05_libero")
    write_json(folder / "turbopi.json", {"preset": "pi05_libero", "lora_alpha": 4})
    assert "expert rank 4, factor 1" in open_checkpoint(folder).info()["notes"][0]


def test_half_an_adapter_and_wrong_shapes_are_refused(tree: Tree, tmp_path: Path) -> None:
    half = {path: array for path, array in tree.items() if path != LLM + "mlp/linear_lora_b"}
    with pytest.raises(CheckpointError, match=r"mlp/linear_lora_a is incomplete: .*mlp/linear_lora_b is missing"):
        open_checkpoint(jax_copy(tmp_path / "half", half), "pi05_libero")
    wrong = tree | {LLM + "mlp/linear_lora_b": tree[LLM + "mlp/linear_lora_b"][:, :, :-1]}
    with pytest.raises(CheckpointError, match=r"adapter of .*mlp/linear \[3, 128, 96\] has shapes"):
        open_checkpoint(jax_copy(tmp_path / "wrong", wrong), "pi05_libero")


def test_alpha_for_a_format_without_adapters_is_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "c.json", {"preset": "pi05_libero", "vision_heads": 4, "lora_alpha": 16})
    with pytest.raises(ConfigError, match="lora_alpha and lora_rslora only apply to openpi's JAX checkpoints"):
        open_checkpoint(GOLDEN / "pi05" / "torch", tmp_path / "c.json")
