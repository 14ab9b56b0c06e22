"""What denoising needs to know of an observation: the prefix's keys and values in every layer."""

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor

from turbopi.models.observation import Observation, SeenObservation, past_of


@dataclass(frozen=True)
class PrefixLayout:
    """Which of the padded prefix's slots (256 a camera, past states if there is such memory, the prompt) are computed.

    `columns` None: all of them, and `mask` says which may be attended to. Otherwise only the slots that some batch
    row needs, and `mask` is None if every row needs them all: always so for B = 1. This compaction is exact,
    because a masked slot takes no position and nothing attends to it.
    """

    pad_mask: Tensor  # bool[B, S_padded]  valid slots
    positions: Tensor  # int64[B, S_padded]  RoPE positions: count of valid slots so far, minus 1
    columns: Tensor | None  # int64[S]  the slots that are computed
    mask: Tensor | None  # bool[B, S]  which of the computed slots are valid; None: all
    causal: Tensor | None = None  # bool[B, S]  which of them no slot before them sees; None: all see each other

    @classmethod
    def of(cls, observation: Observation, tokens_per_image: int, *, compact: bool) -> "PrefixLayout":
        """The layout of an observation; reading the masks waits for the device."""
        state_mask = past_of(observation).state_mask
        states = () if state_mask is None else (state_mask,)
        images = observation.image_mask.repeat_interleave(tokens_per_image, dim=1)
        pad_mask = torch.cat((images, *states, observation.token_mask), dim=1)
        positions = pad_mask.cumsum(1) - 1
        causal = None
        if isinstance(observation, SeenObservation) and observation.causal is not None:
            causal = F.pad(observation.causal, (pad_mask.shape[1] - observation.causal.shape[1], 0))
        if not compact:
            return cls(pad_mask, positions, None, pad_mask, causal)
        columns = pad_mask.any(0).nonzero().squeeze(1)
        mask = pad_mask[:, columns]
        causal = None if causal is None else causal[:, columns]
        return cls(pad_mask, positions, columns, None if bool(mask.all()) else mask, causal)

    @property
    def attended(self) -> Tensor | None:
        """bool[B, 1, 1 or S, S]: the slots that a slot attends to; None: all."""
        valid = None if self.mask is None else self.mask[:, None, None, :]
        if self.causal is None:
            return valid
        block = self.causal.cumsum(1)  # a causal slot begins one; a slot sees its own and those before
        seen = block[:, None, None, :] <= block[:, None, :, None]
        return seen if valid is None else seen & valid

    @property
    def computed_positions(self) -> Tensor:
        """int64[B, S]: positions of the computed slots."""
        return self.positions if self.columns is None else self.positions[:, self.columns]

    def to_padded(self, x: Tensor, dim: int) -> Tensor:
        """Put the computed slots of x, along `dim`, back into the padded prefix; slots not computed are 0."""
        if self.columns is None:
            return x
        padded = x.new_zeros((*x.shape[:dim], self.pad_mask.shape[1], *x.shape[dim + 1 :]))
        return padded.index_copy_(dim, self.columns, x)


@dataclass(frozen=True)
class EmbeddedPrefix:
    """An observation as it enters the language model."""

    embs: Tensor  # [B, S, D]  the layout's slots
    layout: PrefixLayout
    lengths: Tensor  # int64[B]  valid prefix tokens
    state: Tensor  # float32[B, action_dim]
    tagged: "EmbeddedPrefix | None" = None  # the same images with the prompt of `PromptGuidance`


@dataclass(frozen=True)
class KVCache:
    """Keys (after RoPE) and values of the prefix. The suffix never appends: it computes its own in every step."""

    k: Tensor  # [layer, B, G, S, K]
    v: Tensor  # [layer, B, G, S, K]
    mask: Tensor | None  # bool[B, S]; None: every slot is valid
    lengths: Tensor  # int64[B]  valid prefix tokens; the suffix's positions go on from here
    state: Tensor  # float32[B, action_dim]  Pi0's suffix starts with it; Pi0.5 ignores it
    tagged: "KVCache | None" = None  # of the prompt of `PromptGuidance`

    def row(self, row: int) -> "KVCache":
        """One observation's alone, masked as before."""
        one = slice(row, row + 1)
        mask = None if self.mask is None else self.mask[one]
        tagged = None if self.tagged is None else self.tagged.row(row)
        return KVCache(self.k[:, one], self.v[:, one], mask, self.lengths[one], self.state[one], tagged)
