"""What a family of models gives beside its sizes (config.py) and its reference: what all other code asks about it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch

from turbopi.config import FloatPrecision, Kind


@dataclass(frozen=True)
class Family:
    """kind: its name in files and metadata; label: in sentences.

    reference        its model's class, plain PyTorch: every backend is judged against it. Built from a config on the
                     meta device, or by `from_state` around tensors. It has `prefix` (its halves: `embed`,
                     `keys_values`), `denoise` and `sample`, with the arguments of Pi0's; `trace` gets intermediates
    counts           where `planned` is false, (config, cameras, prompt tokens, horizon, steps, batch) -> stage:
                     (operations, numbers through memory), for the roofline
    parameter_dtype  (canonical name, precision, config) -> the dtype of a parameter

    The loop that the engine, the backends and the roofline plan by:

    planned          whether the engine has a plan for it, its kernels and its quantization; else backends run the
                     reference
    modulated        the time scales, shifts and gates the expert's norms (adaRMS); else it is mixed into the actions'
                     tokens
    state_token      the state is a token before the actions, which it doesn't see; else it is in the prompt, in the
                     prefix or nowhere

    Its checkpoints and prompts:

    marks            beginnings of names of weights that only this family has, the most telling one first
    state_in_prompt  whether LeRobot writes the state into the prompt; else the prompt is taken as it is
    state_in_prefix  the state is a token of the prefix
    prompt_tokens    LeRobot's longest prompt, unless a checkpoint says another
    paligemma        prompts are tokenised as PaliGemma's, with a beginning-of-sequence token; else by the checkpoint's
                     own tokenizer.json, without one
    """

    kind: Kind
    label: str
    reference: Any
    parameter_dtype: Callable[[str, FloatPrecision, Any], torch.dtype]
    modulated: bool
    state_token: bool
    marks: tuple[str, ...]
    state_in_prompt: bool
    prompt_tokens: int
    planned: bool = True
    state_in_prefix: bool = False
    paligemma: bool = True
    counts: Callable[[Any, int, int, int, int, int], dict[str, tuple[int, int]]] | None = None

    @property
    def reads_state(self) -> bool:
        """Whether weights read the state, so that its width is bounded; else the prompt alone does."""
        return self.state_token or self.state_in_prefix
