"""What makes actions of an answer, and decides when it is over."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from turbopi.config import Pi0FastConfig
from turbopi.models.family import AnswerReader, Pieces
from turbopi.models.pi0.decoding import EOS
from turbopi.models.pi0_fast.action_tokens import BEGINNING, END, FastTokenizer, codes_of, owners_actions
from turbopi.support.errors import ActionError, TokenizerError
from turbopi.support.text import kind_of


@dataclass(frozen=True)
class Reader:
    """By the rules of the config's owner, with the checkpoint's own tokenizers. Both owners drop what is behind `|`."""

    config: Pi0FastConfig
    pieces: Pieces
    tokenizer: FastTokenizer
    ends: tuple[int, ...]

    def over(self, ids: Sequence[int]) -> bool:
        """LeRobot reads to the first `|`; openpi to the first one behind "Action: ", and its model stops at EOS."""
        if self.config.owner == "lerobot" or ids[-1] == EOS:
            return True
        _, found, behind = self.pieces.decode(list(ids)).partition(BEGINNING)
        return bool(found) and END in behind

    def actions(self, ids: Sequence[int]) -> NDArray[np.float32]:
        config = self.config
        size, rules = (config.action_horizon, config.action_dim), (config.skipped_ids, config.checks_prefix)
        if config.broken_answers == "owners":
            read = owners_actions(ids, config.owner, self.pieces, self.tokenizer, *size, skip=rules[0], prefix=rules[1])
            return read.astype(np.float32)
        try:
            codes = codes_of(ids, config.owner, self.pieces, *rules)
            return self.tokenizer.actions(self.tokenizer.text(codes), *size).astype(np.float32)
        except ActionError as error:
            raise ActionError(
                f"the model's answer can't be read: {error}. Nothing is sent to the robot. An answer in training's own "
                "situations is whole: look at the prompt, the cameras and the state; what the owner's code makes of "
                'such answers: {"broken_answers": "owners"} in a .json for config='
            ) from error


@dataclass(frozen=True)
class Unread:
    """Answers as long as they may be, whatever they say: for measurements, and random weights, which say nothing.

    The actions are numbers in [-1, 1) that depend on the ids.
    """

    config: Pi0FastConfig
    ends: tuple[int, ...] = ()

    def over(self, ids: Sequence[int]) -> bool:
        return False

    def actions(self, ids: Sequence[int]) -> NDArray[np.float32]:
        size = (self.config.action_horizon, self.config.action_dim)
        return np.resize(np.asarray(ids) * 0.6180339887 % 1 * 2 - 1, size).astype(np.float32)


def reader(config: Pi0FastConfig, pieces: Pieces, folder: Path | None) -> AnswerReader:
    """folder: of the action tokenizer. Raises TokenizerError for tokenizers that answers can't be read with."""
    if config.broken_answers == "unread":
        return Unread(config)
    assert folder is not None
    lacking = [name for name in ("id_to_piece", "encode", "decode", "vocab_size") if not hasattr(pieces, name)]
    if lacking:
        raise TokenizerError(
            f"the tokenizer, {kind_of(pieces)}, has no {', '.join(lacking)}: answers are read with "
            "PaliGemma's, as a SentencePiece model or a tokenizer.json"
        )
    end = pieces.encode(END)
    if len(end) != 1:
        raise TokenizerError(f"the tokenizer has no piece {END!r}, at which answers end: is it PaliGemma's?")
    ends = (end[0],) if config.owner == "lerobot" else (end[0], EOS)
    return Reader(config, pieces, FastTokenizer.from_folder(folder), ends)
