"""What a family of models gives beside its sizes (config.py) and its reference: what all other code asks about it."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from turbopi.config import FloatPrecision, Kind
from turbopi.quantization.plan import Tier
from turbopi.quantization.sites import Site


class Pieces(Protocol):
    """PaliGemma's tokenizer; `sentencepiece.SentencePieceProcessor` is one."""

    def id_to_piece(self, id: int) -> str: ...
    def encode(self, text: str) -> list[int]: ...
    def decode(self, ids: list[int]) -> str: ...
    def vocab_size(self) -> int: ...


class Ending(Protocol):
    """When an answer that is written id by id is over.

    ends  ids at which it may be; `over` decides
    """

    @property
    def ends(self) -> Sequence[int]: ...

    def over(self, ids: Sequence[int]) -> bool:
        """Whether an answer is over behind these ids, the last of which is one of `ends`."""


class AnswerReader(Ending, Protocol):
    """What makes actions of the ids that a model wrote. What follows an answer's end changes no action."""

    def actions(self, ids: Sequence[int]) -> NDArray[np.float32]:
        """float32[H, action_dim], normalised. Raises ActionError for a broken answer."""


@dataclass(frozen=True)
class Family:
    """kind: its name in files and metadata; label: in sentences.

    reference        its model's class, plain PyTorch: every backend is judged against it. Built from a config on the
                     meta device, or by `from_state` around tensors. It has `prefix` (its halves: `embed`,
                     `keys_values`), `denoise` and `sample`, with the arguments of Pi0's; `trace` gets intermediates
    counts           where `planned` is false, (config, cameras, prompt tokens, horizon, steps, batch) -> stage:
                     (operations, numbers through memory), for the roofline
    parameter_dtype  (canonical name, precision, config) -> the dtype of a parameter
    reader           (config, PaliGemma's tokenizer, the action tokenizer's folder) -> what makes actions of an answer:
                     the model writes its actions as tokens, one after the other. None: a flow makes them of noise

    The loop that the engine, the backends and the roofline plan by:

    planned          whether the engine has a plan for it and its kernels; else backends run the reference
    linears          (reference, site) -> that site's matrices, of which the first one's input is the activation: what
                     calibration and emulation round
    tiers            the precisions with a calibration that some backend runs it in
    modulated        the time scales, shifts and gates the expert's norms (adaRMS); else it is mixed into the actions'
                     tokens
    state_token      the state is a token before the actions, which it doesn't see; else it is in the prompt, in the
                     prefix or nowhere

    Its checkpoints and prompts:

    marks            beginnings of names of weights that only this family has, the most telling one first
    state_step       the step of LeRobot's that writes the state into the prompt; None: the prompt is taken as it is
    state_in_prefix  the state is a token of the prefix
    prompt_tokens    LeRobot's longest prompt, unless a checkpoint says another
    paligemma        prompts are tokenised as PaliGemma's, with a beginning-of-sequence token; else by the checkpoint's
                     own tokenizer.json, without one
    prompt           (config, prompt, the state's numbers) -> the text that is tokenised; None: by Pi0's rules
    """

    kind: Kind
    label: str
    reference: Any
    parameter_dtype: Callable[[str, FloatPrecision, Any], torch.dtype]
    modulated: bool
    state_token: bool
    marks: tuple[str, ...]
    state_step: str | None
    prompt_tokens: int
    planned: bool = True
    state_in_prefix: bool = False
    paligemma: bool = True
    counts: Callable[[Any, int, int, int, int, int], dict[str, tuple[int, int]]] | None = None
    prompt: Callable[[Any, str, str], str] | None = None
    reader: Callable[[Any, Pieces, Path | None], AnswerReader] | None = None
    linears: Callable[[Any, Site], Iterator[nn.Linear]] | None = None
    tiers: tuple[Tier, ...] = ()

    @property
    def state_in_prompt(self) -> bool:
        return self.state_step is not None

    @property
    def refuses_flow(self) -> str | None:
        """Why a call can't have what only a flow from noise to actions has; None if it can."""
        if self.reader is None:
            return None
        return (
            f"{self.label} writes its actions as tokens, one after the other: it has no noise, no denoising steps, no "
            "solver or time grid, and its chunks have the config's action horizon and can't be joined"
        )

    @property
    def reads_state(self) -> bool:
        """Whether weights read the state, so that its width is bounded; else the prompt alone does."""
        return self.state_token or self.state_in_prefix
