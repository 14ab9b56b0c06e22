"""The reference: Pi0-FAST in plain PyTorch, exact to its owners' greedy decoding.

    begin(observation, decoding)  images and prompt, once an observation, and the answer's first id
    step(decoding)                one more id
    generate(observation, …)      both, until the answer is over

It is Pi0's vision tower, projector and language model without the action expert; a token's logits are the final norm's
output times the embedding table. openpi and LeRobot run it differently, see `FastRules`.

Keys, values and all else that a step reads or writes are buffers of a fixed size, counters among them, so that a step
can be captured once and replayed. It never waits for the device.

Shapes: B batch, C cameras, P prompt places, S prefix places, N tokens of an answer at most, V vocabulary, D width, G
key/value heads, K head_dim.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from turbopi.config import Owner, Pi0FastConfig
from turbopi.models.family import AnswerReader
from turbopi.models.observation import Observation
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.layers import gated_residual, rope_tables
from turbopi.models.pi0.prefix import embed_images, embed_prompt
from turbopi.models.pi0.vision import VisionTower

BOS = 2  # of PaliGemma's SentencePiece model

# Names of what a trace records: prefix_embs [B, S, D], prefix_pad_mask bool[B, S], prefix_positions int[B, S],
# kv_k, kv_v [L, B, C * 256 + P, G, K], decode_positions int[N]: of the last prefix token and of each decoded one,
# logits [N, B, V]
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


RULES: dict[Owner, FastRules] = {
    "lerobot": FastRules(bos_after_prompt=True, skipped=0),
    "openpi": FastRules(bos_after_prompt=False, skipped=1),
}


@dataclass(frozen=True)
class Decoding:
    """An answer as it grows, in place.

    keys, values  [B, G, S + N, K] by layer
    valid         bool[B, S + N]   what a token may attend to
    ids           int64[B, N]      written so far: `count` int64[1] of them
    chosen        int64[B]         the last one
    place         int64[1]         of its keys and values; `position` int64[B]: for RoPE
    logits        float32[B, V]    by which it was chosen
    ends, ended   int64[E], bool[B]  whether one of `ends` was written
    """

    keys: tuple[Tensor, ...]
    values: tuple[Tensor, ...]
    valid: Tensor
    ids: Tensor
    count: Tensor
    chosen: Tensor
    place: Tensor
    position: Tensor
    logits: Tensor
    ends: Tensor
    ended: Tensor

    def rows(self, reader: AnswerReader, most: int) -> list[list[int]] | None:
        """The answers, each to its end or `most` ids; None while one isn't over. Waits for the device."""
        written = self.ids[:, : min(int(self.count), most)].tolist()
        rows = [_to_its_end(row, reader) for row in written]
        if len(written[0]) < most and any(row is None for row in rows):
            return None
        return [ids if row is None else row for row, ids in zip(rows, written, strict=True)]


def _to_its_end(ids: list[int], reader: AnswerReader) -> list[int] | None:
    for at, one in enumerate(ids, 1):
        if one in reader.ends and reader.over(ids[:at]):
            return ids[:at]
    return None


class Pi0FastModel(nn.Module):
    """Build it on the meta device and load a checkpoint's tensors."""

    def __init__(self, config: Pi0FastConfig) -> None:
        super().__init__()
        self.config, self.rules = config, RULES[config.owner]
        self.vision = VisionTower(config.vision)
        self.projector = nn.Linear(config.vision.width, config.vlm.width)
        self.vlm = Gemma(config.vlm, eps=config.rms_norm_eps, vocab_size=config.vocab_size, adaptive=False)

    @classmethod
    def from_state(cls, config: Pi0FastConfig, state: dict[str, Tensor]) -> "Pi0FastModel":
        """The model around tensors of Pi0's canonical names that are already on their device; none is copied."""
        with torch.device("meta"):
            model = cls(config)
        model.load_state_dict(state, strict=True, assign=True)
        return model.eval().requires_grad_(False)

    @property
    def device(self) -> torch.device:
        return self.projector.weight.device

    @torch.no_grad()
    @exact_float32()
    def generate(
        self,
        observation: Observation,
        reader: AnswerReader,
        steps: int,
        *,
        trace: Trace | None = None,
        forced: Sequence[int] | None = None,
        mark: Callable[[str], None] = lambda stage: None,
    ) -> list[list[int]]:
        """The ids that each row writes, greedily, until the reader says that it is over, or `steps` of them.

        forced  ids that take the places of those that were chosen, to compare logits
        mark    is called at the ends of "vision", "prefix" and "denoise"
        """
        decoding = self.allocate(observation, steps, reader.ends)
        embedded = self.embed_images(observation.images)
        mark("vision")
        self.begin(observation, decoding, embedded=embedded, trace=trace)
        mark("prefix")
        positions, logits = [decoding.position - 1 - self.rules.skipped], [decoding.logits.clone()]
        written = 1
        while True:
            over = written == steps or (forced is None and bool(decoding.ended.any()))
            if over and (rows := decoding.rows(reader, steps)) is not None:
                break
            if forced is not None:
                decoding.chosen.fill_(forced[written - 1])
            if trace is not None:
                positions.append(decoding.position.clone())
            self.step(decoding)
            written += 1
            if trace is not None:
                logits.append(decoding.logits.clone())
        mark("denoise")
        if trace is not None:
            trace |= {"logits": torch.stack(logits), "decode_positions": torch.stack(positions)}
        return rows

    def allocate(self, observation: Observation, steps: int, ends: Sequence[int]) -> Decoding:
        """Buffers for observations of this shape, answers of at most `steps` tokens, and ids that end them."""
        b, c = observation.image_mask.shape
        prefix = c * self.config.vision.num_tokens + observation.tokens.shape[1] + self.rules.bos_after_prompt
        of, device = self.config.vlm, self.device
        shape, dtype = (b, of.num_kv_heads, prefix + steps, of.head_dim), self.projector.weight.dtype

        def caches() -> tuple[Tensor, ...]:
            return tuple(torch.zeros(shape, dtype=dtype, device=device) for _ in range(of.depth))

        def whole(*size: int) -> Tensor:
            return torch.zeros(size, dtype=torch.int64, device=device)

        return Decoding(
            caches(),
            caches(),
            valid=torch.zeros(b, prefix + steps, dtype=torch.bool, device=device),
            ids=whole(b, steps),
            count=whole(1),
            chosen=whole(b),
            place=whole(1),
            position=whole(b),
            logits=torch.zeros(b, self.config.vocab_size, device=device),
            ends=torch.tensor(list(ends), dtype=torch.int64, device=device),
            ended=torch.zeros(b, dtype=torch.bool, device=device),
        )

    def embed_images(self, images: Tensor) -> Tensor:
        """(uint8 [0, 255] | float32 [-1, 1])[B, C, 224, 224, 3] -> [B, C * 256, D]"""
        return embed_images(self.vision, self.projector, images)[0]

    def begin(
        self,
        observation: Observation,
        decoding: Decoding,
        *,
        embedded: Tensor | None = None,
        trace: Trace | None = None,
    ) -> None:
        """Keys and values of images and prompt, which see each other wherever they are valid; and the first id.

        embedded  what `embed_images` made of the images
        """
        images = self.embed_images(observation.images) if embedded is None else embedded
        per_image = images.shape[1] // observation.image_mask.shape[1]
        parts = [images, embed_prompt(self.vlm, observation.tokens)]
        masks = [observation.image_mask.repeat_interleave(per_image, dim=1), observation.token_mask]
        if self.rules.bos_after_prompt:
            bos = torch.full_like(observation.tokens[:, :1], BOS)
            parts.append(embed_prompt(self.vlm, bos))
            masks.append(torch.ones_like(bos, dtype=torch.bool))
        x, valid = torch.cat(parts, dim=1), torch.cat(masks, dim=1)
        positions, prefix, mask = valid.long().cumsum(1) - 1, valid.shape[1], valid[:, None, None, :]
        if trace is not None:
            trace |= {"prefix_embs": x, "prefix_pad_mask": valid, "prefix_positions": positions}
        rope = rope_tables(positions, self.config.vlm.head_dim, self.config.rope_base)
        for layer, keys, values in zip(self.vlm.layers, decoding.keys, decoding.values, strict=True):
            normed, gate = layer.input_layernorm(x)
            k, v = layer.keys_values(normed, rope)
            keys[:, :, :prefix].copy_(k)
            values[:, :, :prefix].copy_(v)
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, k, v, mask), gate))
        if trace is not None:
            rows = prefix - self.rules.bos_after_prompt
            for name, caches in (("kv_k", decoding.keys), ("kv_v", decoding.values)):
                trace[name] = torch.stack([one[:, :, :rows].transpose(1, 2) for one in caches])
        decoding.valid.zero_()
        decoding.valid[:, :prefix].copy_(valid)
        decoding.count.zero_()
        decoding.ended.zero_()
        decoding.place.fill_(prefix)
        decoding.position.copy_(valid.sum(1) + self.rules.skipped)
        last = torch.arange(prefix, device=x.device).where(valid, -1).amax(1)
        self._choose(decoding, x.gather(1, last[:, None, None].expand(-1, 1, x.shape[2])))

    def step(self, decoding: Decoding) -> None:
        """Run the last id and choose the next one. At most N - 1 times after `begin`."""
        x = embed_prompt(self.vlm, decoding.chosen[:, None])
        decoding.valid.index_fill_(1, decoding.place, True)
        mask = decoding.valid[:, None, None, :]
        rope = rope_tables(decoding.position[:, None], self.config.vlm.head_dim, self.config.rope_base)
        for layer, keys, values in zip(self.vlm.layers, decoding.keys, decoding.values, strict=True):
            normed, gate = layer.input_layernorm(x)
            k, v = layer.keys_values(normed, rope)
            keys.index_copy_(2, decoding.place, k)
            values.index_copy_(2, decoding.place, v)
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, keys, values, mask), gate))
        decoding.place.add_(1)
        decoding.position.add_(1)
        self._choose(decoding, x)

    def _choose(self, decoding: Decoding, x: Tensor) -> None:
        """The next id, by the last layer's output [B, 1, D]."""
        weight = self.vlm.embed_tokens.weight
        hidden = self.vlm.norm(x)[0][:, 0].to(weight.dtype)
        decoding.logits.copy_(hidden @ weight.T)
        decoding.chosen.copy_(decoding.logits.argmax(-1))
        decoding.ids.index_copy_(1, decoding.count, decoding.chosen[:, None])
        decoding.ended.logical_or_((decoding.chosen[:, None] == decoding.ends).any(1))
        decoding.count.add_(1)


def compacted(observation: Observation) -> Observation:
    """One observation without masked cameras and the prompt's padding: exact, as nothing sees these. Waits for the
    device.
    """
    cameras, tokens = observation.image_mask[0], observation.token_mask[0]
    kept: dict[str, Any] = {"images": observation.images[:, cameras], "image_mask": observation.image_mask[:, cameras]}
    kept |= {"tokens": observation.tokens[:, tokens], "token_mask": observation.token_mask[:, tokens]}
    return Observation(**kept, state=observation.state)
