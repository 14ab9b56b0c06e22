"""What reads the answers of a checkpoint whose model writes its actions as tokens."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from turbopi.checkpoint import Checkpoint
from turbopi.config import PolicyConfig
from turbopi.models import family_of
from turbopi.models.family import AnswerReader
from turbopi.models.pi0_fast.action_tokens import SETTINGS, FastTokenizer
from turbopi.preprocess.tokenizer import PromptTokenizer
from turbopi.support.errors import ActionError, TokenizerError

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class Unjudged:
    """As `reader`, but a broken answer is zeros: of made-up observations, which no robot has."""

    reader: AnswerReader
    config: PolicyConfig

    @property
    def ends(self) -> Sequence[int]:
        return self.reader.ends

    def over(self, ids: Sequence[int]) -> bool:
        return self.reader.over(ids)

    def actions(self, ids: Sequence[int]) -> NDArray[np.float32]:
        try:
            return self.reader.actions(ids)
        except ActionError:
            return np.zeros((self.config.model.action_horizon, self.config.model.action_dim), np.float32)


def reader_of(checkpoint: Checkpoint, tokenizer: PromptTokenizer) -> AnswerReader | None:
    """By the prompts' tokenizer and the first action tokenizer that is there; None: no model that writes tokens.

    Raises TokenizerError if there is none. One that lies in another place and differs is warned of.
    """
    model = checkpoint.config.model
    make = family_of(model).reader
    if make is None:
        return None
    there = action_tokenizers_of(checkpoint)
    found = make(model, tokenizer.encoder, there[0] if there else None)  # type: ignore[arg-type]  # which checks it
    for other in there[1:]:
        if FastTokenizer.from_folder(other) != FastTokenizer.from_folder(there[0]):
            logger.warning("the action tokenizer in %s isn't the one that is used, %s", other, there[0])
    return found


def action_tokenizers_of(checkpoint: Checkpoint) -> list[Path]:
    """The folders that have one, of a model that writes its actions as tokens, the one that is used first; else [].

    Raises TokenizerError if there is none.
    """
    if family_of(checkpoint.config.model).reader is None:
        return []
    there = [one for one in checkpoint.action_tokenizers if (one / SETTINGS).is_file()]
    if not there and checkpoint.format != "random":
        looked = "".join(f"{one}, " for one in checkpoint.action_tokenizers)
        raise TokenizerError(
            f"no action tokenizer found: looked in {looked}and for {checkpoint.action_tokenizer_name} in the Hub's "
            f"cache. Fetch it: `hf download {checkpoint.action_tokenizer_name}`; or say in a turbopi.json where it is: "
            '{"action_tokenizer": "/path/to/it"}'
        )
    return there
