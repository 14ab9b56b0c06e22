"""A `tokenizer.json` of Gemma's kind, as transformers writes it, read as a SentencePiece model.

Gemma's tokenizer is byte-pair encoding over the whole text, blanks written as ▁, unknown letters as bytes. transformers
lists its merges in order; SentencePiece has a score for each piece and derives the merges. The two compute the same if
the list has every merge that the vocabulary allows, ordered by the piece that it makes. That is checked here; a file
that says anything else is refused by what it says. One tie remains: of two places where the same piece can be made from
different halves, SentencePiece takes the left one, transformers the one whose halves are listed first.

Source: transformers 5 (`tokenization_gemma.py`), tokenizers 0.22.
"""

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import sentencepiece

from turbopi.support.errors import TokenizerError
from turbopi.support.reading import MAX_JSON_BYTES, one_line, read_bytes, read_json, shown
from turbopi.support.text import kind_of

TOKENIZER_JSON, TOKENIZER_CONFIG = "tokenizer.json", "tokenizer_config.json"
_MAX_BYTES = 64 * 2**20  # PaliGemma's has 17 MB
_MAX_PIECES = 2**20
_BLANK = "▁"
_BYTES = tuple(f"<0x{byte:02X}>" for byte in range(256))
_CLASSES = ("GemmaTokenizer", "GemmaTokenizerFast", "TokenizersBackend", "PreTrainedTokenizerFast", None)
_NORMAL, _UNKNOWN, _USER_DEFINED, _UNUSED, _BYTE = 1, 2, 4, 5, 6  # SentencePiece's types


class TokenizerJson:
    """What `file` says, as an encoder. Raises TokenizerError for what isn't computed, naming it.

    pieces  by id, those added to the vocabulary among them; "" where there is none
    size    of the vocabulary, without those
    bos     the id that a prompt begins with
    """

    def __init__(self, file: Path) -> None:
        self._file = file
        content = read_json(file, TokenizerError, limit=_MAX_BYTES)
        model = self._part(content, "model")
        self._check(content, model)
        vocab, merges = self._vocab(model), self._merges(model)
        added = self._added(content)
        self.size, self.bos = len(vocab), self._bos(content)
        self.pieces = [""] * (1 + max(*vocab.values(), *added.values()) if added else len(vocab))
        for piece, place in (*vocab.items(), *added.items()):
            if self.pieces[place] not in ("", piece):
                self._refuse(f"id {place}", f"{self.pieces[place]!r} and {piece!r}", "one piece for each id")
            self.pieces[place] = piece
        whole = {piece for piece in added if _BLANK not in piece}  # found in the text before anything is merged
        scores = self._scores(vocab, merges, whole)
        try:
            self._processor = sentencepiece.SentencePieceProcessor(model_proto=_proto(self.pieces, scores, whole))
        except RuntimeError as error:
            raise TokenizerError(f"{file} can't be read as SentencePiece pieces: {one_line(error)}") from error

    def encode(self, text: str, *, add_bos: bool = False) -> list[int]:
        return [self.bos] * add_bos + list(map(int, self._processor.encode(text)))

    def decode(self, ids: list[int]) -> str:
        return str(self._processor.decode(ids))

    def id_to_piece(self, id: int) -> str:
        return self.pieces[id] if 0 <= id < len(self.pieces) else ""

    def vocab_size(self) -> int:
        return self.size

    def _refuse(self, key: str, value: object, expected: str) -> None:
        found = value if isinstance(value, str) else shown(value)
        raise TokenizerError(
            f"{self._file}: {key} is {found}; Turbo-Pi reads {expected}. Give tokenizer= a SentencePiece model with "
            "the same pieces"
        )

    def _part(self, content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
        value = content.get(key)
        if not isinstance(value, dict):
            self._refuse(key, value, "the byte-pair encoding that Gemma's tokenizer has there")
        return value or {}

    def _check(self, content: Mapping[str, Any], model: Mapping[str, Any]) -> None:
        """Nothing but Gemma's steps, in this file and in the tokenizer_config.json beside it."""
        expected: Sequence[tuple[str, tuple[object, ...]]] = (
            ("type", ("BPE",)),
            ("byte_fallback", (True,)),
            ("dropout", (None,)),
            ("ignore_merges", (False, None)),
            ("continuing_subword_prefix", (None, "")),
            ("end_of_word_suffix", (None, "")),
        )
        for key, values in expected:
            if model.get(key) not in values:
                self._refuse(f"model.{key}", model.get(key), f"Gemma's, {values[0]!r}")
        blanks = {"type": "Replace", "pattern": {"String": " "}, "content": _BLANK}
        if content.get("normalizer") != blanks:
            self._refuse("normalizer", content.get("normalizer"), f"Gemma's, a {_BLANK} for each blank")
        split = content.get("pre_tokenizer")  # at blanks, of which the normalizer has left none
        if split is not None and (not isinstance(split, dict) or split.get("pattern") != {"String": " "}):
            self._refuse("pre_tokenizer", split, "Gemma's, which splits at blanks")
        said = _beside(self._file.with_name(TOKENIZER_CONFIG))
        for key, choices in (
            ("tokenizer_class", _CLASSES),
            ("add_bos_token", (True, None)),
            ("add_eos_token", (False, None)),
        ):
            if said.get(key) not in choices:
                self._refuse(f"{TOKENIZER_CONFIG}'s {key}", said.get(key), f"Gemma's, {choices[0]!r}")

    def _vocab(self, model: Mapping[str, Any]) -> dict[str, int]:
        vocab = model.get("vocab")
        if not isinstance(vocab, dict) or not vocab or len(vocab) > _MAX_PIECES:
            self._refuse("model.vocab", vocab, "a vocabulary of pieces and their ids")
        assert isinstance(vocab, dict)
        ids = {place for place in vocab.values() if isinstance(place, int) and not isinstance(place, bool)}
        if ids != set(range(len(vocab))) or "" in vocab:
            self._refuse("model.vocab", f"of {len(vocab)} pieces", "pieces with an id each, from 0 on")
        return vocab

    def _merges(self, model: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Both ways in which they are written: ["a", "b"], and before tokenizers 0.20 "a b"."""
        merges = model.get("merges")
        if not isinstance(merges, list):
            self._refuse("model.merges", merges, "a list of pairs of pieces")
        pairs: list[tuple[str, str]] = []
        for merge in merges or []:
            pair = merge.split(" ") if isinstance(merge, str) else merge
            if not isinstance(pair, list) or len(pair) != 2 or not all(isinstance(half, str) for half in pair):
                self._refuse("model.merges", f"a list with {shown(merge)}", "pairs of pieces")
            pairs.append((pair[0], pair[1]))
        return pairs

    def _added(self, content: Mapping[str, Any]) -> dict[str, int]:
        added: dict[str, int] = {}
        for token in content.get("added_tokens") or []:
            text, place = (token.get("content"), token.get("id")) if isinstance(token, dict) else (None, None)
            if not isinstance(text, str) or not text or not isinstance(place, int) or not 0 <= place < _MAX_PIECES:
                self._refuse("added_tokens", f"a list with {shown(token)}", "texts with an id each")
            assert isinstance(text, str) and isinstance(place, int)
            if any(token.get(key) for key in ("single_word", "lstrip", "rstrip")):
                self._refuse("added_tokens", f"a list with {shown(token)}", "texts that are found as they are")
            added[text] = place
        return added

    def _bos(self, content: Mapping[str, Any]) -> int:
        """Of what is put around a text: one id before it, nothing behind."""
        around = content.get("post_processor")
        try:
            (begin, text), special = around["single"], around["special_tokens"]  # type: ignore[index]
            (place,) = special[begin["SpecialToken"]["id"]]["ids"]
            assert "Sequence" in text and isinstance(place, int)
        except (TypeError, KeyError, ValueError, AssertionError):
            self._refuse("post_processor", around, "Gemma's, a beginning-of-sequence piece before the text")
        return int(place)

    def _scores(self, vocab: Mapping[str, int], merges: list[tuple[str, str]], whole: set[str]) -> dict[str, float]:
        """The score that each piece is made with: the better, the earlier."""
        scores: dict[str, float] = {}
        last = ""
        for rank, (left, right) in enumerate(merges):
            piece = left + right
            if not {left, right, piece} <= vocab.keys():
                self._refuse("model.merges", f"a list with {(left, right)!r}", "merges of the vocabulary's pieces")
            if piece != last and piece in scores:
                self._refuse(
                    "model.merges", f"a list that makes {piece!r} in two places", "merges in the order of the pieces"
                )
            scores.setdefault(piece, -float(rank))
            last = piece
        listed, alone = set(merges), whole | set(_BYTES)
        for piece in vocab.keys() - alone:
            for left, right in _halves(piece):
                if left in vocab and right in vocab and not {left, right} & alone and (left, right) not in listed:
                    self._refuse(
                        "model.merges", f"a list without {(left, right)!r}", "all merges that the vocabulary allows"
                    )
        return scores


def differing_piece(one: Sequence[str], other: Sequence[str]) -> int | None:
    """The first id that both have with different pieces, or None. transformers writes the tab for <0x09>."""
    for place, (first, second) in enumerate(zip(one, other, strict=False)):
        if first != second and {first, second} != {"\t", _BYTES[9]}:
            return place
    return None


def _beside(file: Path) -> Mapping[str, Any]:
    """A tokenizer_config.json, if it is there. `read_json` refuses its model_max_length: 10³⁰ for no limit."""
    if not file.is_file():
        return {}
    try:
        said = json.loads(read_bytes(file, TokenizerError, limit=MAX_JSON_BYTES))
    except (ValueError, RecursionError) as error:
        raise TokenizerError(f"{file} isn't JSON: {one_line(error)}") from error
    if not isinstance(said, dict):
        raise TokenizerError(f"{file} is {kind_of(said)}; expected an object")
    return said


def _halves(piece: str) -> Iterator[tuple[str, str]]:
    return ((piece[:i], piece[i:]) for i in range(1, len(piece)))


# -- SentencePiece's file, a protocol buffer: sentencepiece_model.proto ------------------------------------------------


def _proto(pieces: Sequence[str], scores: Mapping[str, float], whole: set[str]) -> bytes:
    """`pieces` in their order. Behind them bytes without a piece and the unknown piece: their ids are too large."""
    known = set(pieces)
    rows = [(piece or f"<no piece {place}>", piece) for place, piece in enumerate(pieces)]
    rows += [(byte, byte) for byte in _BYTES if byte not in known]
    worst = -float(len(scores) * 64 + 1)
    out = bytearray()
    for name, piece in rows:
        kind = _BYTE if piece in _BYTES else _USER_DEFINED if piece in whole else _NORMAL if piece else _UNUSED
        out += _field(1, _piece(name, scores.get(piece, worst), kind))
    unknown = "<unknown>"
    while unknown in known:
        unknown += "'"
    out += _field(1, _piece(unknown, 0.0, _UNKNOWN))
    byte_pairs, byte_fallback = _number(3, 2), _number(35, 1)
    out += _field(2, byte_pairs + byte_fallback)
    out += _field(3, _field(1, b"identity") + _number(3, 0) + _number(4, 0) + _number(5, 1))  # blanks as ▁, no others
    return bytes(out)


def _piece(text: str, score: float, kind: int) -> bytes:
    return _field(1, text.encode()) + _varint(2 << 3 | 5) + struct.pack("<f", score) + _number(3, kind)


def _field(number: int, content: bytes) -> bytes:
    return _varint(number << 3 | 2) + _varint(len(content)) + content


def _number(number: int, value: int) -> bytes:
    return _varint(number << 3) + _varint(value)


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])
