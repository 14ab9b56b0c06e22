"""Prompts to token ids: clean-up, the state as integers in the text, SentencePiece, padding.

Pi0.5 writes the normalised state into the prompt, one integer per dimension; Pi0 (and Pi0.5 trained without it) has the
task alone, followed by a newline that is encoded by itself. Source: openpi's `tokenizer.py`. LeRobot cleans nothing of
Pi0's: the newline only goes behind a task that has none (its `Pi0NewLineProcessor`).
"""

import logging
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import sentencepiece

from turbopi.checkpoint import Checkpoint
from turbopi.models import family_of
from turbopi.preprocess.hub_tokenizer import HubTokenizer
from turbopi.preprocess.tokenizer_json import TOKENIZER_JSON, TokenizerJson, differing_piece
from turbopi.support.errors import ObservationError, TokenizerError
from turbopi.support.files import openpi_cache
from turbopi.support.reading import read_bytes, shown

logger = logging.getLogger(__name__)

TINY_TOKENIZER = Path(__file__).parents[1] / "data" / "small_policy" / "tokenizer.model"  # 1024 pieces; ours
FILE_NAMES = ("tokenizer.model", "paligemma_tokenizer.model")
MAX_PROMPT_CHARACTERS = 20_000  # far past any model's tokens; keeps a hostile prompt from stalling the robot
_MAX_BYTES = 64 * 2**20  # of a SentencePiece model; PaliGemma's has 4 MB
_STATE_EDGES = np.linspace(-1, 1, 257)[:-1]
_DOWNLOAD = "https://storage.googleapis.com/big_vision/paligemma_tokenizer.model"


class Encoder(Protocol):
    """What a tokenizer must have; `sentencepiece.SentencePieceProcessor` does."""

    def encode(self, text: str, *, add_bos: bool) -> Sequence[int]: ...


def clean_prompt(prompt: str) -> str:
    """The prompt without surrounding blanks, with spaces for underscores and newlines; its case is kept."""
    return prompt.strip().replace("_", " ").replace("\n", " ")


def state_bins(state: np.ndarray) -> np.ndarray:
    """The integers that stand for a normalised state in the prompt: [d] to int64[d].

    256 equal bins over [-1, 1): below -1 gives -1, and 1 or more gives 255, as openpi.
    """
    return np.asarray(_STATE_EDGES.searchsorted(state, side="right") - 1)


Write = Callable[[str, str], str]  # (prompt, the state's numbers) -> the text of a family with rules of its own


def prompt_texts(
    prompt: str,
    state: np.ndarray | None,
    *,
    as_is: bool = False,
    labels: bool = False,
    write: Write | None = None,
) -> list[tuple[str, bool]]:
    """What is encoded, in order: (text, whether BOS goes before it). `as_is`, `labels`, `write`: see `encode`."""
    if write is not None:
        return [(write(prompt, _numbers(np.empty(0) if state is None else state)), True)]
    if as_is and state is None:
        return [(prompt if prompt.endswith("\n") else prompt + "\n", True)]
    cleaned = clean_prompt(prompt)
    if state is None:
        return [(f"Task: {cleaned};\nAction: ", True)] if labels else [(cleaned, True), ("\n", False)]
    return [(f"Task: {cleaned}, State: {_numbers(state)};\nAction: ", True)]


def _numbers(state: np.ndarray) -> str:
    return " ".join(map(str, state_bins(state).tolist()))


class PromptTokenizer:
    """Turns prompts into a model's token ids.

    encoder     see `Encoder`
    vocab_size  of the model: an id past it is refused
    source      where the encoder came from, for people
    controls    ids of control pieces that a text may name, such as <eos>: LeRobot reads them so, openpi as letters
    """

    def __init__(self, encoder: Encoder, *, vocab_size: int, source: str = "given object") -> None:
        self.encoder, self.vocab_size, self.source = encoder, vocab_size, source
        self.controls: dict[str, int] = {}
        self._truncated_prompt: str | None = None  # warned about last
        self._newline: list[int] | None = None  # Pi0's, which is encoded by itself: always the same

    def encode(
        self,
        prompt: str,
        state: np.ndarray | None = None,
        *,
        as_is: bool = False,
        labels: bool = False,
        write: Write | None = None,
    ) -> list[int]:
        """All ids of `prompt`, neither padded nor truncated. `state` [d], normalised, goes into the text.

        as_is   a prompt without state keeps its blanks, underscores and newlines, as in LeRobot's Pi0
        labels  a prompt without state keeps "Task: " and "Action: ", as in LeRobot's Pi0.5
        write   in place of these rules (`Family.prompt`)

        Raises ObservationError for a prompt that can't be encoded, TokenizerError for ids past the vocabulary.
        """
        if len(prompt) > MAX_PROMPT_CHARACTERS:
            raise ObservationError(f"the prompt has {len(prompt)} characters; at most {MAX_PROMPT_CHARACTERS} are read")
        try:
            prompt.encode()
        except UnicodeEncodeError as error:
            raise ObservationError(f"the prompt isn't valid Unicode text: {error}") from error
        (text, bos), *newline = prompt_texts(prompt, state, as_is=as_is, labels=labels, write=write)
        ids = self._ids(text, bos)
        if newline:
            self._newline = self._newline or self._ids(*newline[0])
            ids += self._newline
        if ids and not 0 <= min(ids) <= max(ids) < self.vocab_size:
            wrong = next(token for token in ids if not 0 <= token < self.vocab_size)
            raise TokenizerError(
                f"the tokenizer ({self.source}) gave id {wrong}, but the model's vocabulary has {self.vocab_size} "
                f"entries; use the tokenizer that the model was trained with"
            )
        return ids

    def _ids(self, text: str, add_bos: bool) -> list[int]:
        between = re.split(f"({'|'.join(map(re.escape, self.controls))})", text) if self.controls else [text]
        ids = list(map(int, self.encoder.encode(between[0], add_bos=add_bos)))
        for control, behind in zip(between[1::2], between[2::2], strict=True):
            ids += [self.controls[control], *map(int, self.encoder.encode(behind, add_bos=False))]
        return ids

    def tokenize(
        self,
        prompt: str,
        state: np.ndarray | None = None,
        *,
        max_tokens: int,
        as_is: bool = False,
        labels: bool = False,
        write: Write | None = None,
        tagged: bool = False,
        cut: bool = True,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Ids int64[max_tokens], padded on the right with 0, and their mask bool[max_tokens].

        `as_is`, `labels`, `write`: see `encode`. A longer prompt loses its end, as in openpi, or what the encoder's
        `truncation_side` says; a warning is logged once for each. `tagged`, not `cut`: an ObservationError instead.
        """
        ids = self.encode(prompt, state, as_is=as_is, labels=labels, write=write)
        count = min(len(ids), max_tokens)
        if count < len(ids) and tagged:
            raise ObservationError(
                f"the prompt and guidance's tag take {len(ids)} tokens, but the model reads {max_tokens}: the tag, or "
                f"the state behind it, would be cut. Shorten the prompt: {prompt[:200]!r}"
            )
        if count < len(ids) and not cut:
            raise ObservationError(
                f"the prompt takes {len(ids)} tokens; expected at most {max_tokens}: it is never cut"
            )
        if count < len(ids):
            left = getattr(self.encoder, "truncation_side", "right") == "left"
            self._warn_truncated(prompt, len(ids), max_tokens, state is not None, left)
            ids = ids[-count:] if left else ids[:count]
        tokens = np.zeros(max_tokens, np.int64)
        tokens[:count] = ids
        mask = np.zeros(max_tokens, np.bool_)
        mask[:count] = True
        return tokens, mask

    def _warn_truncated(self, prompt: str, length: int, max_tokens: int, has_state: bool, left: bool) -> None:
        if prompt == self._truncated_prompt:  # once, not at every step of an episode
            return
        self._truncated_prompt = prompt
        lost = f"its {'beginning' if left else 'end'} is cut"
        if has_state and not left:
            lost = "the state, which is at the end, is cut"
        logger.warning(
            "the prompt takes %d tokens but the model reads %d: %s. Shorten the prompt: %r",
            length,
            max_tokens,
            lost,
            prompt[:200],
        )


def load_tokenizer(
    source: str | Path | Encoder | None = None,
    *,
    vocab_size: int,
    checkpoint_dir: str | Path | None = None,
    named: Path | None = None,
    candidates: Iterable[str | Path] = (),
    paligemma: bool = True,
) -> PromptTokenizer:
    """The tokenizer from the first of: `source`; `checkpoint_dir`; `named`; `candidates`; openpi's cache.

    source          a SentencePiece file, a tokenizer.json of Gemma's kind, a folder that holds one of them, or an
                    object with `encode(text, add_bos=...)`
    vocab_size      of the model
    checkpoint_dir  searched, with its assets/, for tokenizer.model and paligemma_tokenizer.model
    named           the folder of the tokenizer that a LeRobot checkpoint's processors name. One from another place is
                    compared with it: a warning is logged where they differ
    candidates      further files
    paligemma       False: of a family with tokenizers of its own: a tokenizer.json of any kind, from `source`, `named`
                    or `candidates` alone
    openpi's cache  $OPENPI_DATA_HOME/big_vision/paligemma_tokenizer.model; ~/.cache/openpi if that isn't set

    Raises TokenizerError if there is none (saying where to get it), if the first one can't be read, or if it has more
    pieces than the model. A given `source` is the only place looked at.
    """
    if source is not None and not isinstance(source, str | Path):
        if not callable(getattr(source, "encode", None)):
            raise TokenizerError(f"tokenizer {source!r} has no encode(text, add_bos) method")
        return PromptTokenizer(source, vocab_size=vocab_size, source=type(source).__name__)
    if not paligemma:
        return _own_tokenizer(source, vocab_size, [*([] if named is None else [named]), *map(Path, candidates)])
    own = [] if named is None else [named / TOKENIZER_JSON, named / FILE_NAMES[0]]  # in transformers' order
    places = _places(checkpoint_dir, [*own, *candidates])
    if source is None:
        there = [path for path in places if path.is_file()]
    else:
        there = [_given_file(Path(source).expanduser()), *(path for path in own if path.is_file())]
    nearest = places[: places.index(own[-1]) + 1] if own else []  # nothing behind the named folder takes its place
    if nearest and source is None and not any(path.is_file() for path in nearest):
        raise TokenizerError(
            f"the checkpoint names the tokenizer in {named}, which holds no {TOKENIZER_JSON} or {FILE_NAMES[0]}; "
            "is the download complete? Or give tokenizer="
        )
    if not there:
        raise TokenizerError(_not_found(places))
    found = _open(there[0], vocab_size)
    for other in there[1:]:
        if other != cached_tokenizer() and not other.samefile(there[0]):
            _compare(found, other)
    return found


def tokenizer_of(checkpoint: Checkpoint, given: str | Path | Encoder | None = None) -> PromptTokenizer:
    """A checkpoint's, unless another is `given`; random weights know no word, so any will do."""
    model, wordless = checkpoint.config.model, checkpoint.format == "random" and given is None
    found = load_tokenizer(
        TINY_TOKENIZER if wordless else given,
        checkpoint_dir=checkpoint.path,
        named=checkpoint.named_tokenizer,
        candidates=checkpoint.tokenizer_candidates,
        vocab_size=model.vocab_size,
        paligemma=wordless or family_of(model).paligemma,
    )
    if checkpoint.format == "lerobot" and isinstance(encoder := found.encoder, sentencepiece.SentencePieceProcessor):
        special = (encoder.pad_id(), encoder.bos_id(), encoder.eos_id(), encoder.unk_id())
        found.controls = {encoder.id_to_piece(place): place for place in special if place >= 0}
    return found


def _own_tokenizer(source: str | Path | None, vocab_size: int, places: Sequence[Path]) -> PromptTokenizer:
    looked = [one / TOKENIZER_JSON if one.suffix != ".json" else one for one in places if one.suffix != ".model"]
    if source is not None:
        given = Path(source).expanduser()
        looked = [given / TOKENIZER_JSON if given.is_dir() else given]
    file = next((one for one in looked if one.is_file()), None)
    if file is None:
        raise TokenizerError(
            f"no tokenizer found. Looked for {', '.join(map(str, looked))}. Fetch the one that the checkpoint was "
            "trained with: `hf download NAME tokenizer.json tokenizer_config.json`, where NAME is the tokenizer_name "
            "in the checkpoint's policy_preprocessor.json; or give tokenizer= its folder"
        )
    encoder = HubTokenizer(file)
    _check_size(file, encoder.size, vocab_size)
    return PromptTokenizer(encoder, vocab_size=vocab_size, source=str(file))


def _given_file(path: Path) -> Path:
    if path.is_file():
        return path
    if not path.is_dir():
        raise TokenizerError(f"there is no tokenizer at {path}")
    for inside in (*_in_folder(path), path / TOKENIZER_JSON):
        if inside.is_file():
            return inside
    raise TokenizerError(f"the folder {path} holds no {', '.join(FILE_NAMES)} or {TOKENIZER_JSON}")


def _in_folder(folder: Path) -> list[Path]:
    return [parent / name for parent in (folder, folder / "assets") for name in FILE_NAMES]


def _compare(used: PromptTokenizer, other: Path) -> None:
    """Log a warning if another of the checkpoint's tokenizers has other pieces, or can't be read."""
    try:
        encoder = _encoder(other)[0]
    except TokenizerError as error:
        logger.warning("the tokenizer %s isn't compared with the checkpoint's own: %s", used.source, error)
        return
    ours, theirs = _pieces(used.encoder), _pieces(encoder)
    place = differing_piece(ours, theirs)
    if place is not None:
        logger.warning(
            "the tokenizer %s isn't the checkpoint's own, %s: id %d is %r there and %r here. Prompts won't mean to the "
            "model what they say, unless it was trained with the first",
            used.source,
            other,
            place,
            theirs[place],
            ours[place],
        )


def _pieces(encoder: object) -> list[str]:
    if isinstance(encoder, TokenizerJson):
        return encoder.pieces[: encoder.size]
    assert isinstance(encoder, sentencepiece.SentencePieceProcessor)
    return [encoder.id_to_piece(place) for place in range(encoder.vocab_size())]


def cached_tokenizer() -> Path:
    """Where openpi keeps PaliGemma's, whether it is there or not."""
    return openpi_cache() / "big_vision" / "paligemma_tokenizer.model"


def _places(checkpoint_dir: str | Path | None, candidates: Iterable[str | Path]) -> list[Path]:
    cached = cached_tokenizer()
    in_checkpoint = [] if checkpoint_dir is None else _in_folder(Path(checkpoint_dir).expanduser())
    return list(dict.fromkeys([*in_checkpoint, *map(Path, candidates), cached]))


def _not_found(places: Sequence[Path]) -> str:
    target = places[-1]
    looked = "\n".join(f"  {path}" for path in places)
    return (
        f"no tokenizer found. Looked for:\n{looked}\n"
        f"Pi0 and Pi0.5 use PaliGemma's SentencePiece model. Get it (4 MB) where openpi looks for it, too:\n"
        f"  mkdir -p '{target.parent}'\n"
        f"  curl -L -o '{target}' {_DOWNLOAD}\n"
        f"or: gsutil cp gs://big_vision/paligemma_tokenizer.model '{target}'\n"
        f"Or pass its path as tokenizer=, or put it into the checkpoint's folder as {FILE_NAMES[0]} (on Hugging Face "
        f"it is tokenizer.model of google/paligemma-3b-pt-224)"
    )


def _open(path: Path, vocab_size: int) -> PromptTokenizer:
    encoder, pieces = _encoder(path)
    _check_size(path, pieces, vocab_size)
    return PromptTokenizer(encoder, vocab_size=vocab_size, source=str(path))


def _check_size(path: Path, pieces: int, vocab_size: int) -> None:
    if pieces > vocab_size:
        raise TokenizerError(
            f"{path} has {pieces} pieces, but the model's vocabulary has {vocab_size} entries; "
            f"use the tokenizer that the model was trained with"
        )
    if pieces < 0.9 * vocab_size:
        logger.warning(
            "the tokenizer %s has %d pieces and the model %d: prompts won't mean to a trained model what they say",
            path,
            pieces,
            vocab_size,
        )


def _encoder(path: Path) -> tuple[Encoder, int]:
    """A file's tokenizer and how many pieces its vocabulary has."""
    if path.suffix == ".json":
        found = TokenizerJson(path)
        return found, found.size
    try:
        content = read_bytes(path, TokenizerError, limit=_MAX_BYTES)
        processor = sentencepiece.SentencePieceProcessor(model_proto=content)
        pieces = processor.vocab_size()
        bos = processor.bos_id() if pieces else -1  # sentencepiece 0.2.0 dies of asking an empty model
    except (RuntimeError, UnicodeDecodeError) as error:  # the second: a message that quotes a damaged piece
        raise TokenizerError(f"{path} isn't a readable SentencePiece model: {shown(str(error))}") from error
    if pieces == 0:  # an empty file parses as an empty model
        raise TokenizerError(f"{path} isn't a SentencePiece model: it has no pieces")
    if bos < 0:
        raise TokenizerError(f"{path} has no beginning-of-sequence piece, which every prompt starts with")
    return processor, pieces
