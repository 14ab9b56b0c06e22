"""The reference: Pi0-FAST in plain PyTorch, exact to its owners' greedy decoding.

    prefill(inputs) -> Decoding        images and prompt, once an observation
    decode(decoding, steps) -> ids     one token after the other, until the stop

It is Pi0's vision tower, projector and language model without the action expert; a token's logits are the final norm's
output times the embedding table. openpi and LeRobot run it differently, see `FastRules`.

Shapes: B batch, C cameras, P prompt places, S prefix places, V vocabulary, D width.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from turbopi.config import ModelConfig
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.layers import gated_residual, rope_tables
from turbopi.models.pi0.prefix import embed_images, embed_prompt
from turbopi.models.pi0.vision import VisionTower

BOS = 2  # of PaliGemma's SentencePiece model

# Names of what a trace records: prefix_embeddings [B, S, D], prefix_pad bool[B, S], prefix_positions int[B, S],
# decode_positions int[N]: of the last prefix token and of each decoded one, logits [N, B, V], margins [N, B]
Trace = dict[str, Tensor]


@dataclass(frozen=True)
class FastRules:
    """What the two owners do differently.

    bos_after_prompt  LeRobot puts a BOS behind the padded prompt, and the first logits are its; openpi's are the last
                      prompt token's
    skipped           positions between the prompt and the first decoded token: openpi skips one
    """

    bos_after_prompt: bool
    skipped: int


LEROBOT = FastRules(bos_after_prompt=True, skipped=0)
OPENPI = FastRules(bos_after_prompt=False, skipped=1)


@dataclass(frozen=True)
class FastInputs:
    """What the network takes of B observations.

    images  (uint8 [0, 255] | float32 [-1, 1])[B, C, 224, 224, 3], image_mask bool[B, C]
    tokens  int64[B, P], padded at the right, token_mask bool[B, P]
    """

    images: Tensor
    image_mask: Tensor
    tokens: Tensor
    token_mask: Tensor


@dataclass
class Decoding:
    """A prefix's keys and values [B, G, S, K] by layer, which grow by each decoded token, and what comes next.

    valid     bool[B, S]
    position  int64[B], of the next decoded token
    logits    float32[B, V], which it is chosen by
    """

    keys: list[Tensor]
    values: list[Tensor]
    valid: Tensor
    position: Tensor
    logits: Tensor


class Pi0FastModel(nn.Module):
    """`config`'s expert and action_dim are unused. Build it on the meta device and load a checkpoint's tensors."""

    def __init__(self, config: ModelConfig, rules: FastRules) -> None:
        super().__init__()
        self.config, self.rules = config, rules
        self.vision = VisionTower(config.vision)
        self.projector = nn.Linear(config.vision.width, config.vlm.width)
        self.vlm = Gemma(config, config.vlm, vocab_size=config.vocab_size, adaptive=False)

    @classmethod
    def from_state(cls, config: ModelConfig, rules: FastRules, state: dict[str, Tensor]) -> "Pi0FastModel":
        """The model around tensors of Pi0's canonical names that are already on their device; none is copied."""
        with torch.device("meta"):
            model = cls(config, rules)
        model.load_state_dict(state, strict=True, assign=True)
        return model.eval().requires_grad_(False)

    @torch.no_grad()
    @exact_float32()
    def generate(
        self, inputs: FastInputs, steps: int, stop: Sequence[int], *, trace: Trace | None = None
    ) -> list[list[int]]:
        """The ids that each row writes, greedily, to its first id of `stop`, with it, or `steps` of them.

        What an owner writes behind `|` is dropped when its answer is read, so stopping there changes no action.
        """
        decoding = self.prefill(inputs, trace=trace)
        rows: list[list[int]] = [[] for _ in range(inputs.tokens.shape[0])]
        positions, logits = [decoding.position - 1 - self.rules.skipped], []
        for step in range(steps):
            logits.append(decoding.logits)
            chosen = decoding.logits.argmax(-1)
            for row, number in zip(rows, chosen.tolist(), strict=True):
                if not row or row[-1] not in stop:
                    row.append(number)
            if step + 1 == steps or all(row[-1] in stop for row in rows):
                break
            positions.append(decoding.position)
            self.append(decoding, chosen)
        if trace is not None:
            best = torch.stack(logits).topk(2).values
            trace |= {"logits": torch.stack(logits), "margins": best[..., 0] - best[..., 1]}
            trace["decode_positions"] = torch.stack(positions)
        return rows

    @torch.no_grad()
    @exact_float32()
    def prefill(self, inputs: FastInputs, *, trace: Trace | None = None) -> Decoding:
        """Keys and values of images and prompt, which see each other wherever they are valid."""
        images, _ = embed_images(self.vision, self.projector, inputs.images)
        per_image = images.shape[1] // inputs.image_mask.shape[1]
        parts = [images, embed_prompt(self.vlm, inputs.tokens)]
        masks = [inputs.image_mask.repeat_interleave(per_image, dim=1), inputs.token_mask]
        if self.rules.bos_after_prompt:
            bos = inputs.tokens.new_full((inputs.tokens.shape[0], 1), BOS)
            parts.append(embed_prompt(self.vlm, bos))
            masks.append(torch.ones_like(bos, dtype=torch.bool))
        x, valid = torch.cat(parts, dim=1), torch.cat(masks, dim=1)
        positions = valid.long().cumsum(1) - 1
        if trace is not None:
            trace |= {"prefix_embeddings": x, "prefix_pad": valid, "prefix_positions": positions}
        keys, values, x = self._run(x, positions, valid[:, None, None, :], None)
        last = torch.arange(valid.shape[1], device=valid.device).where(valid, -1).amax(1)
        logits = self._logits(x[torch.arange(x.shape[0], device=x.device), last])
        return Decoding(keys, values, valid, valid.sum(1) + self.rules.skipped, logits)

    @torch.no_grad()
    @exact_float32()
    def append(self, decoding: Decoding, ids: Tensor) -> None:
        """Decode one more token: ids int64[B] are what was chosen by `decoding.logits`."""
        decoding.valid = torch.cat((decoding.valid, torch.ones_like(decoding.valid[:, :1])), dim=1)
        mask, positions = decoding.valid[:, None, None, :], decoding.position[:, None]
        decoding.keys, decoding.values, x = self._run(embed_prompt(self.vlm, ids[:, None]), positions, mask, decoding)
        decoding.position = decoding.position + 1
        decoding.logits = self._logits(x[:, -1])

    def _run(
        self, x: Tensor, positions: Tensor, mask: Tensor, before: Decoding | None
    ) -> tuple[list[Tensor], list[Tensor], Tensor]:
        """All layers over x [B, T, D] behind what came before -> keys and values by layer, the final norm's output."""
        rope = rope_tables(positions, self.config.vlm.head_dim, self.config.rope_base)
        keys, values = [], []
        for number, layer in enumerate(self.vlm.layers):
            normed, gate = layer.input_layernorm(x)
            k, v = layer.keys_values(normed, rope)
            if before is not None:
                k, v = torch.cat((before.keys[number], k), dim=2), torch.cat((before.values[number], v), dim=2)
            keys.append(k)
            values.append(v)
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, k, v, mask), gate))
        normed, _ = self.vlm.norm(x)
        return keys, values, normed

    def _logits(self, hidden: Tensor) -> Tensor:
        """[B, D] -> float32[B, V]"""
        weight = self.vlm.embed_tokens.weight
        return (hidden.to(weight.dtype) @ weight.T).float()
