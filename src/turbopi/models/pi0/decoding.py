"""Greedy decoding behind a prefix: Pi0-FAST's actions and Pi0.5's text are written by this one loop.

    read_prefix(decoding, x, valid)  the prefix's keys and values, and the answer's first id
    step(decoding)                   one more id
    finish(decoding, …)              steps until the answer is over

Keys, values and all else that a step reads or writes are buffers of a fixed size, counters among them, so that a step
can be captured once and replayed. It never waits for the device.

Shapes: B batch, S prefix places, N tokens of an answer at most, V vocabulary, D width, G key/value heads, K head_dim.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from turbopi.models.family import Ending
from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.layers import gated_residual, rope_tables
from turbopi.models.pi0.prefix import embed_prompt

BOS, EOS = 2, 1  # of PaliGemma's SentencePiece model


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

    def rows(self, ending: Ending, most: int) -> list[list[int]] | None:
        """The answers, each to its end or `most` ids; None while one isn't over. Waits for the device."""
        written = self.ids[:, : min(int(self.count), most)].tolist()
        rows = [_to_its_end(row, ending) for row in written]
        if len(written[0]) < most and any(row is None for row in rows):
            return None
        return [ids if row is None else row for row, ids in zip(rows, written, strict=True)]


def _to_its_end(ids: list[int], ending: Ending) -> list[int] | None:
    for at, one in enumerate(ids, 1):
        if one in ending.ends and ending.over(ids[:at]):
            return ids[:at]
    return None


class Writer(nn.Module):
    """A language model that writes ids; a model's class derives from it.

    never  ranges of ids that are never written
    """

    config: Any
    vlm: Gemma
    never: tuple[tuple[int, int], ...] = ()

    @property
    def head(self) -> Tensor:
        """[V, D]: a logit is a row's product with the final norm's output."""
        return self.vlm.embed_tokens.weight

    def buffers_for(self, batch: int, prefix: int, steps: int, ends: Sequence[int]) -> Decoding:
        """For prefixes of so many places, answers of at most `steps` ids, and ids that end them."""
        of, weight = self.config.vlm, self.vlm.embed_tokens.weight
        device, shape = weight.device, (batch, of.num_kv_heads, prefix + steps, of.head_dim)

        def caches() -> tuple[Tensor, ...]:
            return tuple(torch.zeros(shape, dtype=weight.dtype, device=device) for _ in range(of.depth))

        def whole(*size: int) -> Tensor:
            return torch.zeros(size, dtype=torch.int64, device=device)

        return Decoding(
            caches(),
            caches(),
            valid=torch.zeros(batch, prefix + steps, dtype=torch.bool, device=device),
            ids=whole(batch, steps),
            count=whole(1),
            chosen=whole(batch),
            place=whole(1),
            position=whole(batch),
            logits=torch.zeros(batch, self.config.vocab_size, device=device),
            ends=torch.tensor(list(ends), dtype=torch.int64, device=device),
            ended=torch.zeros(batch, dtype=torch.bool, device=device),
        )

    def read_prefix(self, decoding: Decoding, x: Tensor, valid: Tensor, *, skipped: int = 0) -> None:
        """Keys and values of embeddings x [B, S, D], which see each other where bool[B, S] is true; the first id.

        skipped  positions between the prefix and the first id
        """
        positions, prefix, mask = valid.long().cumsum(1) - 1, valid.shape[1], valid[:, None, None, :]
        rope = rope_tables(positions, self.config.vlm.head_dim, self.config.rope_base)
        for layer, keys, values in zip(self.vlm.layers, decoding.keys, decoding.values, strict=True):
            normed, gate = layer.input_layernorm(x)
            k, v = layer.keys_values(normed, rope)
            keys[:, :, :prefix].copy_(k)
            values[:, :, :prefix].copy_(v)
            x = layer.feed_forward(gated_residual(x, layer.attend(normed, rope, k, v, mask), gate))
        decoding.valid.zero_()
        decoding.valid[:, :prefix].copy_(valid)
        decoding.count.zero_()
        decoding.ended.zero_()
        decoding.place.fill_(prefix)
        decoding.position.copy_(valid.sum(1) + skipped)
        last = torch.arange(prefix, device=x.device).where(valid, -1).amax(1)
        self._choose(decoding, x.gather(1, last[:, None, None].expand(-1, 1, x.shape[2])))

    def step(self, decoding: Decoding) -> None:
        """Run the last id and choose the next one. At most N - 1 times behind a prefix."""
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

    def finish(
        self,
        decoding: Decoding,
        ending: Ending,
        most: int,
        *,
        keep: bool = False,
        forced: Sequence[int] | None = None,
    ) -> tuple[list[list[int]], dict[str, Tensor]]:
        """The ids that each row writes behind its prefix, until its answer is over, or `most` of them.

        keep    with "logits" [N, B, V] and "decode_positions" int[N, B], that of the prefix's last token first
        forced  ids that take the places of those that were chosen, to compare logits
        """
        positions, logits, written = [decoding.position - 1], [decoding.logits.clone()], 1
        while True:
            over = written == most or (forced is None and bool(decoding.ended.any()))
            if over and (rows := decoding.rows(ending, most)) is not None:
                break
            if forced is not None:
                decoding.chosen.fill_(forced[written - 1])
            if keep:
                positions.append(decoding.position.clone())
            self.step(decoding)
            written += 1
            if keep:
                logits.append(decoding.logits.clone())
        return rows, {"logits": torch.stack(logits), "decode_positions": torch.stack(positions)} if keep else {}

    def _choose(self, decoding: Decoding, x: Tensor) -> None:
        """The next id, by the last layer's output [B, 1, D]."""
        weight = self.head
        hidden = self.vlm.norm(x)[0][:, 0].to(weight.dtype)
        decoding.logits.copy_(hidden @ weight.T)
        for first, behind in self.never:
            decoding.logits[:, first:behind] = -torch.inf
        decoding.chosen.copy_(decoding.logits.argmax(-1))
        decoding.ids.index_copy_(1, decoding.count, decoding.chosen[:, None])
        decoding.ended.logical_or_((decoding.chosen[:, None] == decoding.ends).any(1))
        decoding.count.add_(1)
