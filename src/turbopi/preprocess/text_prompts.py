"""What a policy that writes text is given to continue, what its actions are conditioned on, and what ids say.

Source: LeRobot's open PR 4184 (f2c8867), `text_processor_pi052.py` and `inference/pi052_adapter.py`.
"""

import functools
import re
from collections.abc import Iterable, Sequence
from itertools import groupby

import numpy as np

from turbopi.config import TextConfig
from turbopi.models.family import Pieces
from turbopi.models.pi0.decoding import EOS
from turbopi.preprocess.tokenizer import PromptTokenizer
from turbopi.support.errors import TokenizerError
from turbopi.support.text import kind_of

_BYTE = re.compile("<0x[0-9A-F]{2}>")
_SPECIAL = (0, 1, 2, 3)  # padding, end, beginning and unknown, of PaliGemma's tokenizer


def action_text(subtask: str, numbers: str) -> str:
    """The prompt of actions that are made of a subtask alone."""
    return f"User: {subtask}, State: {numbers};\n"


def _filled(template: str, prompt: str, numbers: str) -> str:
    return template.replace("{state}", numbers).replace("{prompt}", prompt)


def text_ids(tokenizer: PromptTokenizer, text: TextConfig, prompt: str, state: np.ndarray) -> list[int]:
    """The ids that are continued. state: float[s], normalised. Raises ObservationError as `PromptTokenizer.encode`."""
    return tokenizer.encode(prompt, state, write=functools.partial(_filled, text.template))


def joint_ids(
    tokenizer: PromptTokenizer, text: TextConfig, prompt: str, state: np.ndarray, subtask: str
) -> tuple[list[int], list[bool]]:
    """The ids of a prompt and the subtask that answers it, and which of them are causal: the subtask's and its end."""
    before, whole = (
        tokenizer.encode(prompt, state, write=lambda *parts: f"{_filled(text.template, *parts)} {end}")  # noqa: B023
        for end in ("", subtask)
    )  # a piece of the blank alone isn't the subtask's, one with its first letters is
    pairs = enumerate(zip(before, whole, strict=False))
    shared = next((place for place, (one, other) in pairs if one != other), min(len(before), len(whole)))
    newline = tokenizer.encode("", write=lambda *_: "\n")[1:]
    ids = [*whole, EOS, *newline]
    return ids, [shared <= place <= len(whole) for place in range(len(ids))]


def text_of(tokenizer: PromptTokenizer, ids: Sequence[int]) -> str:
    """What ids say, without those that stand for no text, blanks around it, and several in a row."""
    encoder: Pieces = tokenizer.encoder  # type: ignore[assignment]  # checked below
    if not hasattr(encoder, "id_to_piece"):
        raise TokenizerError(
            f"the tokenizer, {kind_of(encoder)}, has no id_to_piece: text is read with PaliGemma's, as a "
            "SentencePiece model or a tokenizer.json"
        )
    pieces = [encoder.id_to_piece(one) for one in ids if one not in _SPECIAL and one < encoder.vocab_size()]
    text = "".join(_joined(run) if is_byte else "".join(run) for is_byte, run in groupby(pieces, _is_byte))
    return " ".join(text.replace("\N{LOWER ONE EIGHTH BLOCK}", " ").split())


def _is_byte(piece: str) -> bool:
    return _BYTE.fullmatch(piece) is not None


def _joined(run: Iterable[str]) -> str:
    """Bytes that aren't UTF-8 together are a replacement character each, as in transformers."""
    found = bytes(int(piece[3:5], 16) for piece in run)
    try:
        return found.decode()
    except UnicodeDecodeError:
        return "\N{REPLACEMENT CHARACTER}" * len(found)
