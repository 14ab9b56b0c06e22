"""Pi0-FAST's reference against what openpi's and LeRobot's own code computed, down to the actions."""

import json
import lzma
import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sentencepiece
import torch
from safetensors.torch import load
from torch import Tensor

from turbopi.checkpoint.base import put
from turbopi.checkpoint.openpi_jax import JaxSource
from turbopi.checkpoint.openpi_lora import LoraScale
from turbopi.config import GemmaConfig, ModelConfig, VisionConfig
from turbopi.models.pi0.vision import normalize_images
from turbopi.models.pi0_fast.action_tokens import FastTokenizer, Owner, codes_of, owners_actions
from turbopi.models.pi0_fast.reference import LEROBOT, OPENPI, FastInputs, Pi0FastModel, Trace
from turbopi.preprocess.images import fitted
from turbopi.support.errors import ActionError, TokenizerError

GOLDEN = Path(__file__).parent / "golden_pi0_fast"
RUNS = {"base": 2, "broken": 5, "no_prefix": 2, "quantiles_empty_camera": 2, "openpi": 2}
EOS = 1
OPENPI_IMAGES = ("observation/image", "observation/wrist_image")
ALL = [(name, run) for name, runs in RUNS.items() for run in range(runs)]


@cache
def pieces() -> Any:
    return sentencepiece.SentencePieceProcessor(str(GOLDEN / "hub/tokenizer.model"))


class Case:
    def __init__(self, name: str) -> None:
        self.folder = GOLDEN / name
        self.owner: Owner = "openpi" if name == "openpi" else "lerobot"
        self.described = json.loads((self.folder / "case.json").read_text())
        self.inputs = dict(np.load(self.folder / "inputs.npz"))
        self.expected = dict(np.load(self.folder / "expected.npz"))
        self.steps = self.described["config"]["max_decoding_steps"]
        folder = "fast" if self.owner == "openpi" else "fast-action-tokenizer"
        self.tokenizer = FastTokenizer.from_folder(GOLDEN / "hub" / folder)
        self.end = [pieces().piece_to_id("|")]

    @property
    def prefix_is_checked(self) -> bool:
        return bool(self.described["config"].get("validate_action_token_prefix", True))

    def model(self) -> Pi0FastModel:
        if self.owner == "openpi":
            source = JaxSource(self.folder / "checkpoint/params", LoraScale())
            state = {name: torch.empty(shape) for name, shape in source.shapes.items()}
            for piece in source.pieces(torch.device("cpu")):
                put(state[piece.name], piece)
        else:
            stored = load(lzma.decompress((self.folder / "model.safetensors.xz").read_bytes()))
            state = {_canonical(name): tensor for name, tensor in stored.items() if "embed_tokens" not in name}
        vision = _depth(state, "vision"), state["vision.post_layernorm.weight"].shape[0]
        mlp = state["vision.layers.0.mlp.fc1.weight"].shape[0]
        vocab, width = state["vlm.embed_tokens.weight"].shape
        gemma = GemmaConfig(
            width, state["vlm.layers.0.mlp.up_proj.weight"].shape[0], depth=_depth(state, "vlm"), head_dim=16
        )
        config = ModelConfig(
            vision=VisionConfig(vision[1], vision[0], mlp, self.described["vision_heads"]),
            vlm=gemma,
            expert=gemma,
            vocab_size=vocab,
        )
        return Pi0FastModel.from_state(config, OPENPI if self.owner == "openpi" else LEROBOT, state)

    def prepared(self, run: int) -> FastInputs:
        of = f"{self.described['runs'][run]['observation']}/"
        if self.owner == "openpi":
            names, tokens = [of + name for name in OPENPI_IMAGES], "tokenized_prompt"
        else:
            config = json.loads((self.folder / "checkpoint/config.json").read_text())
            names = [of + name for name, one in config["input_features"].items() if one["type"] == "VISUAL"]
            tokens = "tokens"
        resize: Any = self.owner
        images = [torch.from_numpy(fitted(self.inputs[name], 224, resize)) for name in names if name in self.inputs]
        images = [normalize_images(image) for image in images]
        mask = self.expected[f"{run}/image_mask"]
        images += [torch.full_like(images[0], -1.0)] * (len(mask) - len(images))
        token_mask = self.expected[f"{run}/{tokens.removesuffix('s')}_mask"]
        rows = (torch.from_numpy(array)[None] for array in (mask, self.expected[f"{run}/{tokens}"], token_mask))
        return FastInputs(torch.stack(images)[None], *rows)

    def generated(self, run: int, stop: list[int], trace: Trace | None = None) -> list[int]:
        return self.model().generate(self.prepared(run), self.steps, stop, trace=trace)[0]


def _depth(state: dict[str, Tensor], stack: str) -> int:
    return 1 + max(int(found[1]) for name in state if (found := re.match(rf"{stack}\.layers\.(\d+)", name)))


def _canonical(name: str) -> str:
    name = name.removeprefix("model.paligemma_with_expert.paligemma.").removeprefix("model.")
    tower = "vision_tower.vision_model."
    for theirs, ours in (
        ("lm_head.", "vlm.embed_tokens."),
        ("language_model.", "vlm."),
        ("multi_modal_projector.linear.", "projector."),
        (f"{tower}embeddings.", "vision."),
        (f"{tower}encoder.", "vision."),
        (tower, "vision."),
    ):
        if name.startswith(theirs):
            return ours + name.removeprefix(theirs)
    raise KeyError(name)


@cache
def case(name: str) -> Case:
    return Case(name)


def relative(ours: np.ndarray, theirs: np.ndarray) -> float:
    return float(np.sqrt(np.square(ours - theirs).mean() / np.square(theirs).mean()))


@pytest.mark.parametrize(("name", "run"), ALL)
def test_the_answer_is_the_owners_id_for_id(name: str, run: int) -> None:
    one, trace = case(name), Trace()
    ids = one.generated(run, [EOS] if name == "openpi" else one.end, trace)
    theirs = {key.removeprefix(f"{run}/"): value for key, value in one.expected.items()}
    assert theirs["generated"].tolist() == ids + [0] * (one.steps - len(ids))
    positions = trace["decode_positions"][:, 0].tolist()
    assert positions == theirs["decode_positions"].tolist()[: len(ids)]  # openpi decodes its last one, too
    first = theirs["first_logits"]
    assert relative(trace["logits"][: len(first), 0].numpy(), first) <= 1e-5  # seen: 2e-6
    rows = "embedding_rows" if name == "openpi" else "prefix_rows"
    embeddings = theirs["embeddings" if name == "openpi" else "prefix_embeddings"]
    assert relative(trace["prefix_embeddings"][0, theirs[rows]].numpy(), embeddings) <= 1e-6
    if name != "openpi":
        assert (trace["prefix_positions"][0].numpy() == theirs["prefix_positions"]).all()
        assert (trace["prefix_pad"][0].numpy() == theirs["prefix_pad"]).all()


@pytest.mark.parametrize(("name", "run"), ALL)
def test_actions_are_the_owners_and_stopping_at_the_end_mark_changes_none(name: str, run: int) -> None:
    one = case(name)
    ids = one.generated(run, [EOS, *one.end])
    arguments = (one.owner, pieces(), one.tokenizer)
    if f"{run}/error" in one.expected:
        with pytest.raises(ActionError, match="begins with"):
            owners_actions(ids, *arguments, 8, 7)
        return
    theirs = one.expected[f"{run}/normalized_actions"]
    ours = owners_actions(ids, *arguments, *theirs.shape, prefix=one.prefix_is_checked)
    assert np.abs(ours - theirs).max() <= 1e-6 * max(1.0, np.abs(theirs).max())
    if f"{run}/fast_ids" in one.expected:
        codes = codes_of(ids, one.owner, pieces(), prefix=one.prefix_is_checked)
        assert codes == one.expected[f"{run}/fast_ids"].tolist()
        if f"{run}/fast_codepoints" in one.expected:
            assert [ord(c) for c in one.tokenizer.text(codes)] == one.expected[f"{run}/fast_codepoints"].tolist()


@pytest.mark.parametrize(
    ("name", "run", "text"),
    [
        ("broken", 0, "has 14 coefficients, and 8 actions of 7 values have 56"),
        ("broken", 1, "has 120 coefficients"),
        ("broken", 3, "cut character"),
        ("broken", 4, "has 0 coefficients"),
        ("no_prefix", 0, "begins with"),
        ("no_prefix", 1, "has the code -3"),
        ("openpi", 1, "coefficients, and 8 actions"),
    ],
)
def test_a_broken_answer_gives_no_actions(name: str, run: int, text: str) -> None:
    one = case(name)
    ids = one.generated(run, [EOS, *one.end])

    def actions() -> None:
        codes = codes_of(ids, one.owner, pieces(), prefix=one.prefix_is_checked)
        one.tokenizer.actions(one.tokenizer.text(codes), 8, 7)

    with pytest.raises(ActionError, match=text):
        actions()


def test_rows_of_a_batch_are_as_each_alone() -> None:
    one = case("base")
    first, second = (one.prepared(run) for run in (0, 1))
    both = FastInputs(
        *(torch.cat((getattr(first, name), getattr(second, name))) for name in FastInputs.__dataclass_fields__)
    )
    assert one.model().generate(both, one.steps, one.end) == [one.generated(run, one.end) for run in (0, 1)]


def test_both_layouts_of_the_action_tokenizer_are_read() -> None:
    assert FastTokenizer.from_folder(GOLDEN / "hub/fast") == FastTokenizer.from_folder(
        GOLDEN / "hub/fast-action-tokenizer"
    )


def test_a_folder_that_is_no_action_tokenizer_is_named(tmp_path: Path) -> None:
    with pytest.raises(TokenizerError, match=r"needs processor_config\.json"):
        FastTokenizer.from_folder(tmp_path)
    (tmp_path / "processor_config.json").write_text('{"scale": 10, "min_token": -354}')
    (tmp_path / "tokenizer.json").write_text('{"model": {}}')
    with pytest.raises(TokenizerError, match="no vocabulary"):
        FastTokenizer.from_folder(tmp_path)
