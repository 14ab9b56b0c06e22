"""The reference: Pi0-FAST in plain PyTorch, exact to its owners' greedy decoding.

    begin(observation, decoding)  images and prompt, once an observation, and the answer's first id
    step(decoding)                one more id
    generate(observation, …)      both, until the answer is over

It is Pi0's vision tower, projector and language model without the action expert; a token's logits are the final norm's
output times the embedding table, or times a head that was trained apart from it. openpi and LeRobot run it differently,
see `FastRules`. The loop: pi0/decoding.py, whose shapes these are, with C cameras and P prompt places.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from turbopi.config import Owner, Pi0FastConfig
from turbopi.models.family import AnswerReader
from turbopi.models.observation import Observation
from turbopi.models.pi0.decoding import BOS, Decoding, Writer
from turbopi.models.pi0.exact import exact_float32
from turbopi.models.pi0.gemma import Gemma
from turbopi.models.pi0.prefix import embed_images, embed_prompt
from turbopi.models.pi0.vision import VisionTower

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


class Pi0FastModel(Writer):
    """Build it on the meta device and load a checkpoint's tensors."""

    def __init__(self, config: Pi0FastConfig) -> None:
        super().__init__()
        self.config, self.rules = config, RULES[config.owner]
        self.vision = VisionTower(config.vision)
        self.projector = nn.Linear(config.vision.width, config.vlm.width)
        self.vlm = Gemma(config.vlm, eps=config.rms_norm_eps, vocab_size=config.vocab_size, adaptive=False)
        if not config.tied_head:
            self.lm_head = nn.Linear(config.vlm.width, config.vocab_size, bias=False)

    @property
    def head(self) -> Tensor:
        return self.vlm.embed_tokens.weight if self.config.tied_head else self.lm_head.weight

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
        rows, written = self.finish(decoding, reader, steps, keep=trace is not None, forced=forced)
        mark("denoise")
        if trace is not None:
            trace |= written
            trace["decode_positions"][0] -= self.rules.skipped
        return rows

    def allocate(self, observation: Observation, steps: int, ends: Sequence[int]) -> Decoding:
        """Buffers for observations of this shape, answers of at most `steps` tokens, and ids that end them."""
        b, c = observation.image_mask.shape
        prefix = c * self.config.vision.num_tokens + observation.tokens.shape[1] + self.rules.bos_after_prompt
        return self.buffers_for(b, prefix, steps, ends)

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
        if trace is not None:
            trace |= {"prefix_embs": x, "prefix_pad_mask": valid, "prefix_positions": valid.long().cumsum(1) - 1}
        self.read_prefix(decoding, x, valid, skipped=self.rules.skipped)
        if trace is not None:
            rows = valid.shape[1] - self.rules.bos_after_prompt
            for name, caches in (("kv_k", decoding.keys), ("kv_v", decoding.values)):
                trace[name] = torch.stack([one[:, :, :rows].transpose(1, 2) for one in caches])


def compacted(observation: Observation) -> Observation:
    """One observation without masked cameras and the prompt's padding: exact, as nothing sees these. Waits for the
    device.
    """
    cameras, tokens = observation.image_mask[0], observation.token_mask[0]
    kept: dict[str, Any] = {"images": observation.images[:, cameras], "image_mask": observation.image_mask[:, cameras]}
    kept |= {"tokens": observation.tokens[:, tokens], "token_mask": observation.token_mask[:, tokens]}
    return Observation(**kept, state=observation.state)
