"""FAST's action tokens: from the ids that the language model wrote to a chunk of normalised actions.

ids -> codes (the last ids of PaliGemma's vocabulary, counted backwards) -> a string by byte-level BPE -> one
coefficient a character -> inverse cosine transform along time. Source: FAST (arXiv 2501.09747) and its processor's
files; the Python file among these is never executed.
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from turbopi.config import Owner
from turbopi.models.family import Pieces
from turbopi.support.errors import ActionError, TokenizerError
from turbopi.support.reading import Fields, read_json, shown

BEGINNING, END = "Action: ", "|"
SETTINGS = "processor_config.json"
_LAYOUTS = ("bpe_tokenizer/tokenizer.json", "tokenizer.json")  # of transformers 5; as published
_REPLACEMENT = "\N{REPLACEMENT CHARACTER}"


@dataclass(frozen=True)
class FastTokenizer:
    """The action tokenizer of a folder: processor_config.json and tokenizer.json.

    pieces     bytes of each code of the BPE vocabulary
    scale      coefficients were multiplied by it before they were rounded
    min_token  the coefficient of character 0
    """

    pieces: dict[int, bytes]
    scale: float
    min_token: int

    @classmethod
    def from_folder(cls, folder: Path) -> "FastTokenizer":
        """Raises TokenizerError for a folder without the two files, damaged ones, and other ways to decode."""
        found = next((folder / name for name in _LAYOUTS if (folder / name).is_file()), None)
        settings = folder / SETTINGS
        if found is None or not settings.is_file():
            raise TokenizerError(
                f"{folder} is no FAST action tokenizer: it needs {SETTINGS}, and {' or '.join(_LAYOUTS)}"
            )
        fields = Fields(read_json(settings, TokenizerError), settings, TokenizerError)
        scale, min_token = fields.number("scale"), fields.integer("min_token", -(2**20), 2**20)
        try:
            content = json.loads(found.read_text(encoding="utf-8"))
            added = {token["content"]: token["id"] for token in content.get("added_tokens") or []}
            pieces = {int(code): _bytes_of(piece) for piece, code in (content["model"]["vocab"] | added).items()}
            decoder, beside = content["decoder"]["type"], found.with_name("tokenizer_config.json")
            cleans = beside.is_file() and json.loads(beside.read_text("utf-8")).get("clean_up_tokenization_spaces")
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise TokenizerError(f"{found}: no vocabulary of byte-level BPE ({error!r})") from error
        if decoder != "ByteLevel":
            raise TokenizerError(f"{found}: the decoder is {shown(decoder)}; expected 'ByteLevel'")
        if cleans:  # blanks before punctuation: each is a coefficient
            raise TokenizerError(
                f"{beside}: clean_up_tokenization_spaces drops coefficients of actions; set it to false"
            )
        return cls(pieces, scale, min_token)

    def text(self, codes: Sequence[int]) -> str:
        """The string that codes stand for; unknown ones stand for nothing, bytes that are no UTF-8 for U+FFFD.

        Raises ActionError for a code below 0.
        """
        if any(code < 0 for code in codes):
            raise ActionError(f"it has the code {min(codes)}: codes are 0 or more")
        return b"".join(self.pieces.get(code, b"") for code in codes).decode("utf-8", errors="replace")

    def actions(self, text: str, horizon: int, dim: int) -> NDArray[np.float64]:
        """float64[H, d] of a string of H * d characters. Raises ActionError for another length, or a cut character."""
        if _REPLACEMENT in text:
            raise ActionError("it has a cut character, which would be an action of thousands")
        if len(text) != horizon * dim:
            raise ActionError(
                f"it has {len(text)} coefficients, and {horizon} actions of {dim} values have {horizon * dim}"
            )
        return self.transformed(text, horizon, dim)

    def transformed(self, text: str, horizon: int, dim: int) -> NDArray[np.float64]:
        """LeRobot's own reading: a longer string is cut, a shorter one filled up with coefficients of 0."""
        coefficients = np.zeros(horizon * dim)
        found = [ord(character) + self.min_token for character in text[: horizon * dim]]
        coefficients[: len(found)] = found
        return _inverse_cosine_transform(coefficients.reshape(horizon, dim) / self.scale)


# byte-level BPE's character for each byte: printable ones are themselves, the others follow from 256 on
_PRINTABLE = [*range(ord("!"), ord("~") + 1), *range(0xA1, 0xAC + 1), *range(0xAE, 0xFF + 1)]
_OTHERS = [byte for byte in range(256) if byte not in _PRINTABLE]
_BYTE_OF = {chr(byte): byte for byte in _PRINTABLE} | {chr(256 + at): byte for at, byte in enumerate(_OTHERS)}


def _bytes_of(piece: str) -> bytes:
    """A piece with any other character stands for its own UTF-8, as in the `tokenizers` library."""
    if all(character in _BYTE_OF for character in piece):
        return bytes(_BYTE_OF[character] for character in piece)
    return piece.encode("utf-8")


def _inverse_cosine_transform(coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """The orthonormal inverse of DCT-II along axis 0."""
    count = coefficients.shape[0]
    frequency, time = np.arange(count)[:, None], np.arange(count)[None, :]
    basis = np.sqrt(2 / count) * np.cos(np.pi * frequency * (2 * time + 1) / (2 * count))
    basis[0] /= np.sqrt(2)
    return np.asarray(basis.T @ coefficients)


def codes_of(ids: Sequence[int], owner: Owner, pieces: Pieces, skip: int = 128, prefix: bool = True) -> list[int]:
    """The FAST codes of what the model wrote, by its owner's rules; negative ones are ids of no action token.

    skip    ids at the end of the vocabulary that no code uses (fast_skip_tokens)
    prefix  LeRobot's validate_action_token_prefix

    Raises ActionError for an answer without the words "Action: " in front.
    """
    top = pieces.vocab_size() - 1 - skip
    if owner == "openpi":
        text = pieces.decode(list(ids))
        if BEGINNING not in text:
            raise ActionError(f"it doesn't say {BEGINNING!r}, but {text[:80]!r}")
        between = text.split(BEGINNING)[1].split(END)[0].strip()
        return [top - number for number in pieces.encode(between)]
    words = [pieces.id_to_piece(number) for number in ids]
    if prefix and words[:2] != ["Action", ":"]:
        raise ActionError(f"it begins with {words[:2]}, not with 'Action', ':'")
    end = words.index(END) if END in words else len(words)
    kept: list[int] = []
    at = 0
    while at < end:
        if words[at : at + 3] == ["Action", ":", "\N{LOWER ONE EIGHTH BLOCK}"]:
            at += 3
        else:
            kept.append(top - ids[at])
            at += 1
    return kept


def owners_actions(
    ids: Sequence[int],
    owner: Owner,
    pieces: Pieces,
    tokenizer: FastTokenizer,
    horizon: int,
    dim: int,
    *,
    skip: int = 128,
    prefix: bool = True,
) -> NDArray[np.float64]:
    """What the owner's own code makes of any answer, float64[H, d], right or broken: never for a robot by default.

    Zeros are normalised zeros: the mean pose of an absolute robot. Raises ActionError where LeRobot raises.
    """
    if owner == "openpi":
        try:
            return tokenizer.actions(tokenizer.text(codes_of(ids, owner, pieces, skip)), horizon, dim)
        except ActionError:
            return np.zeros((horizon, dim))
    codes = codes_of(ids, owner, pieces, skip, prefix)
    if any(code < 0 for code in codes):
        return np.zeros((horizon, dim))
    return tokenizer.transformed(tokenizer.text(codes), horizon, dim)
