"""Text that a Pi0.5 writes: its prefix of images and prompt, and behind it one id after the other (decoding.py)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from turbopi.config import TextConfig
from turbopi.models.observation import Observation, SeenObservation
from turbopi.models.pi0.decoding import EOS, Writer
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.prefix import camera_slots
from turbopi.models.pi0.reference import Pi0Model

_FAST_CODES = 1024  # of physical-intelligence/fast, and of tokenizers that are fitted from it
_LOCATIONS = (256_000, 257_024)  # PaliGemma's <loc0000> to <loc1023>


@dataclass(frozen=True)
class _ToEos:
    ends: tuple[int, ...] = (EOS,)

    def over(self, ids: Sequence[int]) -> bool:
        return True


TO_EOS = _ToEos()


def never_written(text: TextConfig, vocab_size: int) -> tuple[tuple[int, int], ...]:
    """Ranges of ids that LeRobot's pi052 never chooses: FAST's action tokens up to the locations, and these."""
    if text.skipped_ids is None:
        return ()
    first = vocab_size - text.skipped_ids - _FAST_CODES
    actions = ((first, _LOCATIONS[0]),) if 0 < first < _LOCATIONS[0] else ()
    return (*actions, _LOCATIONS)


class TextWriter(Writer):
    """Writes with a model's own language model, which it shares.

    head  float32 or bfloat16 [V, D]; None: the embedding table is the head
    """

    def __init__(self, model: Pi0Model, text: TextConfig, head: Tensor | None) -> None:
        super().__init__()
        self.config, self.model, self.vlm = model.config, model, model.vlm
        self.never = never_written(text, model.config.vocab_size)
        self._head = head

    @property
    def head(self) -> Tensor:
        return self.vlm.embed_tokens.weight if self._head is None else self._head

    @torch.no_grad()
    @exact_float32()
    def see(self, observation: Observation) -> SeenObservation:
        """An observation with its images embedded: for the text, and for the actions behind it."""
        here = observation.to(self.model.device)
        return SeenObservation.of(observation, self.model.embed_cameras(here, camera_slots(here, compact=True)))

    @torch.no_grad()
    @exact_float32()
    def write(self, observation: Observation, most: int, *, keep: bool = False) -> tuple[list[int], dict[str, Tensor]]:
        """The ids behind one observation's prompt, to EOS, which is the last one, or `most` of them.

        keep  as `Writer.finish`
        """
        embedded = self.model.embed(observation.to(self.model.device))
        b, s = embedded.embs.shape[:2]
        assert b == 1 and embedded.layout.causal is None
        decoding = self.buffers_for(b, s, most, TO_EOS.ends)
        self.read_prefix(decoding, embedded.embs, torch.ones(b, s, dtype=torch.bool, device=embedded.embs.device))
        rows, kept = self.finish(decoding, TO_EOS, most, keep=keep)
        return rows[0], kept
