"""Prompts: openpi's strings and bins exactly, padding, where tokenizers are found, and our small one."""

import json
import logging
import runpy
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sentencepiece
from hypothesis import given
from hypothesis import strategies as st
from lerobot_cases import tokenizer_folder

import turbopi
from turbopi.config import preset
from turbopi.preprocess.tokenizer import (
    TINY_TOKENIZER,
    PromptTokenizer,
    clean_prompt,
    load_tokenizer,
    prompt_texts,
    state_bins,
)
from turbopi.support.errors import ObservationError, TokenizerError

FOLDER = Path(__file__).parent / "golden" / "preprocess"
PROMPTS: list[dict[str, Any]] = json.loads((FOLDER / "prompts.json").read_text())
BINS = np.load(FOLDER / "state_bins.npz")
SCRIPT = Path(__file__).parent.parent / "scripts" / "train_tokenizer.py"
TINY_VOCAB = preset("pi05_tiny").model.vocab_size


class ByteTokenizer:
    """The golden data's stand-in; remembers what it was asked."""

    def __init__(self) -> None:
        self.calls: list[list[Any]] = []

    def encode(self, text: str, add_bos: bool) -> Sequence[int]:
        self.calls.append([text, add_bos])
        return [2] * add_bos + [3 + byte % 509 for byte in text.encode()]


@pytest.fixture
def no_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """openpi's cache, empty."""
    monkeypatch.setenv("OPENPI_DATA_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache" / "big_vision" / "paligemma_tokenizer.model"


def tiny() -> PromptTokenizer:
    return load_tokenizer(TINY_TOKENIZER, vocab_size=TINY_VOCAB)


@pytest.mark.parametrize("case", PROMPTS, ids=lambda case: f"{case['state_dtype']}-{case['max_len']}")
def test_strings_calls_and_padding_are_openpis_exactly(case: dict[str, Any]) -> None:
    encoder = ByteTokenizer()
    state = None if case["state"] is None else np.array(case["state"], case["state_dtype"])
    tokens, mask = PromptTokenizer(encoder, vocab_size=512).tokenize(case["prompt"], state, max_tokens=case["max_len"])
    assert encoder.calls == case["encode_calls"]
    np.testing.assert_array_equal(tokens, np.array(case["byte_tokens"], np.int64), strict=True)
    np.testing.assert_array_equal(mask, np.array(case["byte_mask"], np.bool_), strict=True)


@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_state_bins_are_openpis_exactly(dtype: str) -> None:
    np.testing.assert_array_equal(state_bins(BINS[f"state_{dtype}"]), BINS[f"bins_{dtype}"])


def test_prompts_are_cleaned_but_keep_their_case() -> None:
    assert clean_prompt("  Pick_up\nthe RED_block \n") == "Pick up the RED block"
    assert prompt_texts(" a_b ", None) == [("a b", True), ("\n", False)]


def test_a_prompt_as_it_is_gets_a_newline_unless_it_has_one() -> None:
    assert prompt_texts(" a_b\nc ", None, as_is=True) == [(" a_b\nc \n", True)]
    assert prompt_texts("a_b\n", None, as_is=True) == [("a_b\n", True)]
    assert prompt_texts(" a_b ", np.zeros(1), as_is=True) == prompt_texts("a b", np.zeros(1))


def test_a_truncated_prompt_is_warned_about_once(caplog: pytest.LogCaptureFixture) -> None:
    prompts = PromptTokenizer(ByteTokenizer(), vocab_size=512)
    with caplog.at_level(logging.WARNING):
        for value in (0.1, 0.2):  # two steps of an episode: only the state differs
            tokens, mask = prompts.tokenize("fold the towel", np.array([value]), max_tokens=20)
            assert mask.all()
            assert (tokens > 0).all()
        prompts.tokenize("open the door, please", None, max_tokens=20)
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == 2
    length = len(prompts.encode("fold the towel", np.array([0.1])))
    assert f"takes {length} tokens but the model reads 20: the state, which is at the end, is cut" in messages[0]
    assert "its end is cut" in messages[1]


def test_a_prompt_that_just_fits_isnt_warned_about(caplog: pytest.LogCaptureFixture) -> None:
    prompts = PromptTokenizer(ByteTokenizer(), vocab_size=512)
    prompts.tokenize("abc", None, max_tokens=5)  # BOS, three bytes, newline
    assert not caplog.records


def test_ids_past_the_vocabulary_are_refused() -> None:
    with pytest.raises(TokenizerError, match="gave id 124, but the model's vocabulary has 100 entries"):
        PromptTokenizer(ByteTokenizer(), vocab_size=100).encode("y")


def test_prompts_that_arent_text_for_a_model_are_refused() -> None:
    with pytest.raises(ObservationError, match="isn't valid Unicode"):
        tiny().encode("\ud800")
    with pytest.raises(ObservationError, match="has 20001 characters; at most 20000"):
        tiny().encode("a" * 20_001)


# Where a tokenizer is found


def test_places_are_searched_in_order(tmp_path: Path, no_cache: Path) -> None:
    checkpoint = tmp_path / "checkpoint"
    candidate = tmp_path / "candidate.model"
    places = [no_cache, candidate, checkpoint / "assets" / "tokenizer.model", checkpoint / "tokenizer.model"]
    for place in places:  # from the last to the first
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(TINY_TOKENIZER.read_bytes())
        found = load_tokenizer(checkpoint_dir=checkpoint, candidates=[candidate], vocab_size=TINY_VOCAB)
        assert found.source == str(place)
    given = load_tokenizer(TINY_TOKENIZER, checkpoint_dir=checkpoint, vocab_size=TINY_VOCAB)
    assert given.source == str(TINY_TOKENIZER)
    assert load_tokenizer(checkpoint, vocab_size=TINY_VOCAB).source == str(checkpoint / "tokenizer.model")


def test_two_tokenizers_of_a_checkpoint_that_differ_are_warned_of(
    tmp_path: Path, no_cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "assets").mkdir()
    for file in (tmp_path / "tokenizer.model", tmp_path / "assets" / "tokenizer.model"):
        shutil.copyfile(TINY_TOKENIZER, file)
    load_tokenizer(checkpoint_dir=tmp_path, vocab_size=TINY_VOCAB)
    assert not caplog.text
    file.write_bytes(b"another")
    assert load_tokenizer(checkpoint_dir=tmp_path, vocab_size=TINY_VOCAB).source == str(tmp_path / "tokenizer.model")
    assert f"{tmp_path / 'tokenizer.model'} isn't compared" in caplog.text and f"{file} isn't a" in caplog.text


def test_without_a_tokenizer_the_error_says_where_to_get_it(tmp_path: Path, no_cache: Path) -> None:
    with pytest.raises(TokenizerError) as caught:
        load_tokenizer(checkpoint_dir=tmp_path, vocab_size=257_152)
    message = str(caught.value)
    assert f"curl -L -o '{no_cache}' https://storage.googleapis.com/big_vision/paligemma_tokenizer.model" in message
    assert "gs://big_vision/paligemma_tokenizer.model" in message
    assert str(tmp_path / "tokenizer.model") in message


def test_the_cache_is_in_the_home_folder_by_default(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("OPENPI_DATA_HOME", raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    expected = tmp_path / ".cache" / "openpi" / "big_vision" / "paligemma_tokenizer.model"
    with pytest.raises(TokenizerError, match=str(expected)):
        load_tokenizer(vocab_size=257_152)


def test_a_given_path_is_the_only_place(tmp_path: Path, no_cache: Path) -> None:
    no_cache.parent.mkdir(parents=True)
    no_cache.write_bytes(TINY_TOKENIZER.read_bytes())
    with pytest.raises(TokenizerError, match=r"there is no tokenizer at .*absent\.model"):
        load_tokenizer(tmp_path / "absent.model", vocab_size=TINY_VOCAB)
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        TokenizerError, match=r"empty holds no tokenizer\.model, paligemma_tokenizer\.model or tokenizer\.json"
    ):
        load_tokenizer(tmp_path / "empty", vocab_size=TINY_VOCAB)


@pytest.mark.parametrize("content", [b"", b"not a model", b"\x00" * 100])
def test_files_of_something_else_are_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "tokenizer.model"
    path.write_bytes(content)
    with pytest.raises(
        TokenizerError, match=r"tokenizer\.model (isn't a (readable )?SentencePiece model|begins with zeros)"
    ):
        load_tokenizer(path, vocab_size=TINY_VOCAB)


def test_a_tokenizer_larger_than_the_model_is_refused() -> None:
    with pytest.raises(TokenizerError, match="has 1024 pieces, but the model's vocabulary has 512 entries"):
        load_tokenizer(TINY_TOKENIZER, vocab_size=512)


def test_a_tokenizer_much_smaller_than_the_model_is_warned_about(caplog: pytest.LogCaptureFixture) -> None:
    load_tokenizer(TINY_TOKENIZER, vocab_size=257_152)
    assert "has 1024 pieces and the model 257152" in caplog.text


def test_objects_must_be_able_to_encode() -> None:
    with pytest.raises(TokenizerError, match=r"has no encode\(text, add_bos\) method"):
        load_tokenizer(object(), vocab_size=10)  # type: ignore[arg-type]
    assert load_tokenizer(ByteTokenizer(), vocab_size=512).encode("a") == [2, 100, 13]


# Our small tokenizer


def test_special_pieces_are_where_gemma_has_them() -> None:
    pieces = sentencepiece.SentencePieceProcessor(model_file=str(TINY_TOKENIZER))
    assert (pieces.pad_id(), pieces.eos_id(), pieces.bos_id(), pieces.unk_id()) == (0, 1, 2, 3)
    assert pieces.vocab_size() == TINY_VOCAB
    assert len(pieces.encode("\n")) == 1
    assert pieces.encode("", add_bos=True) == [2]


@pytest.mark.parametrize(
    "text", ["pick up", " two  blanks ", "Grüße, 你好 🤖", "tab\there", "12 -1 255;\nAction: ", "<s></s>"]
)
def test_text_survives_unchanged(text: str) -> None:
    pieces = sentencepiece.SentencePieceProcessor(model_file=str(TINY_TOKENIZER))
    ids = pieces.encode(text)
    assert pieces.decode(ids) == text
    assert not {0, 1, 2, 3} & set(ids)  # neither control pieces nor unknown ones


def test_every_state_number_costs_one_token_a_digit_and_a_blank() -> None:
    pieces = sentencepiece.SentencePieceProcessor(model_file=str(TINY_TOKENIZER))
    for number in range(-1, 256):
        assert len(pieces.encode(f" {number}")) <= 1 + len(str(number))


def test_a_libero_prompt_fits_in_sixty_tokens() -> None:
    prompt = "pick up the black bowl between the plate and the ramekin and place it on the plate"
    assert len(tiny().encode(prompt, np.full(8, 0.99))) < 60  # every number has three digits


def test_the_script_makes_the_same_file_each_time() -> None:
    script = runpy.run_path(str(SCRIPT))
    first = script["train"]()
    assert first == script["train"]()
    if sentencepiece.__version__ == "0.2.3":  # what the file in the repository was made with
        assert first == TINY_TOKENIZER.read_bytes()


def test_the_tiny_tokenizer_is_part_of_the_package() -> None:
    assert TINY_TOKENIZER.is_relative_to(Path(turbopi.__file__).parent)


def test_the_newline_behind_a_prompt_is_encoded_once() -> None:
    encoder = ByteTokenizer()
    prompts = PromptTokenizer(encoder, vocab_size=512)
    ids = [prompts.encode(prompt) for prompt in ("open", "close")]
    assert encoder.calls == [["open", True], ["\n", False], ["close", True]]
    assert ids == [[*encoder.encode(prompt, True), *encoder.encode("\n", False)] for prompt in ("open", "close")]


# transformers' tokenizer.json


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What transformers would save of our small tokenizer."""
    return tokenizer_folder.write(tmp_path_factory.mktemp("tokenizers") / "tokenizer")


@pytest.fixture(scope="module")
def from_json(folder: Path) -> PromptTokenizer:
    return load_tokenizer(folder / "tokenizer.json", vocab_size=TINY_VOCAB)


@given(st.text(st.sampled_from("▁ \n\t_aehkotéλ🙂<0x1>;:-9"), max_size=60) | st.text(max_size=30))
def test_a_tokenizer_json_gives_the_ids_of_the_model_that_it_came_from(from_json: PromptTokenizer, text: str) -> None:
    try:
        text.encode()
    except UnicodeEncodeError:
        return
    assert from_json.encoder.encode(text, add_bos=True) == tiny().encoder.encode(text, add_bos=True)


def test_text_that_names_a_special_piece_is_that_piece_as_in_transformers(from_json: PromptTokenizer) -> None:
    assert from_json.encoder.encode("<s>a", add_bos=False)[0] == 2 != tiny().encoder.encode("<s>a", add_bos=False)[0]


def test_the_folder_that_a_checkpoint_names_comes_before_other_places(
    folder: Path, tmp_path: Path, no_cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    no_cache.parent.mkdir(parents=True)
    no_cache.write_bytes(TINY_TOKENIZER.read_bytes())
    found = load_tokenizer(checkpoint_dir=tmp_path, named=folder, candidates=[TINY_TOKENIZER], vocab_size=TINY_VOCAB)
    assert found.source == str(folder / "tokenizer.json")
    given = load_tokenizer(TINY_TOKENIZER, named=folder, vocab_size=TINY_VOCAB)  # it wins, and has the same pieces
    assert given.source == str(TINY_TOKENIZER) and not caplog.text


def changed_folder(folder: Path, change: Any) -> Path:
    content = tokenizer_folder.tokenizer_json()
    change(content)
    folder.mkdir()
    (folder / "tokenizer.json").write_text(json.dumps(content))
    return folder


def swap_pieces(content: Any) -> None:
    vocab = content["model"]["vocab"]
    vocab["a"], vocab["b"] = vocab["b"], vocab["a"]


def test_a_given_tokenizer_with_other_pieces_than_the_checkpoints_is_warned_about(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = changed_folder(tmp_path / "other", swap_pieces)
    assert load_tokenizer(TINY_TOKENIZER, named=other, vocab_size=TINY_VOCAB).source == str(TINY_TOKENIZER)
    assert "isn't the checkpoint's own" in caplog.text and "is 'b' there and 'a' here" in caplog.text


def test_a_named_tokenizer_that_cannot_be_read_is_never_replaced_in_silence(
    tmp_path: Path, no_cache: Path, caplog: pytest.LogCaptureFixture
) -> None:
    no_cache.parent.mkdir(parents=True)
    no_cache.write_bytes(TINY_TOKENIZER.read_bytes())
    (tmp_path / "tokenizer").mkdir()
    with pytest.raises(TokenizerError, match=r"names the tokenizer in .*, which holds no tokenizer\.json or"):
        load_tokenizer(named=tmp_path / "tokenizer", vocab_size=TINY_VOCAB)
    with pytest.raises(TokenizerError, match="names the tokenizer in"):
        load_tokenizer(named=tmp_path / "tokenizer", candidates=[TINY_TOKENIZER], vocab_size=TINY_VOCAB)
    cached = load_tokenizer(no_cache, named=tmp_path / "tokenizer", vocab_size=TINY_VOCAB)
    assert cached.source == str(no_cache)  # given: it wins, wherever it lies
    (tmp_path / "tokenizer" / "tokenizer.json").write_text("{}")
    with pytest.raises(TokenizerError, match=r"tokenizer\.json: model is None; Turbo-Pi reads the byte-pair"):
        load_tokenizer(named=tmp_path / "tokenizer", vocab_size=TINY_VOCAB)
    load_tokenizer(TINY_TOKENIZER, named=tmp_path / "tokenizer", vocab_size=TINY_VOCAB)  # given: it wins
    assert "isn't compared with the checkpoint's own" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda c: c["model"].update(type="Unigram"), r"model\.type is Unigram"),
        (lambda c: c["model"].update(byte_fallback=False), r"model\.byte_fallback is False"),
        (lambda c: c["model"].update(merges=c["model"]["merges"][:-1]), "all merges that the vocabulary allows"),
        (lambda c: c["model"]["merges"].append(c["model"]["merges"][0]), "merges in the order of the pieces"),
        (lambda c: c["model"]["merges"].append(["a", "?!"]), "merges of the vocabulary's pieces"),
        (lambda c: c["model"]["merges"].append(3), r"model\.merges is a list with 3"),
        (lambda c: c["model"]["vocab"].update({"a": 5}), "pieces with an id each, from 0 on"),
        (lambda c: c.update(normalizer={"type": "NFKC"}), "normalizer is .*a ▁ for each blank"),
        (lambda c: c.update(pre_tokenizer={"type": "ByteLevel"}), "pre_tokenizer is .*splits at blanks"),
        (lambda c: c.update(post_processor=None), "a beginning-of-sequence piece before the text"),
        (lambda c: c["post_processor"]["single"].append(c["post_processor"]["single"][0]), "post_processor is"),
        (lambda c: c["added_tokens"][0].update(lstrip=True), "texts that are found as they are"),
        (lambda c: c["added_tokens"][0].update(id=7), "one piece for each id"),
    ],
)
def test_a_tokenizer_json_that_is_not_gemmas_is_refused_by_what_it_says(
    tmp_path: Path, change: Any, message: str
) -> None:
    with pytest.raises(TokenizerError, match=message):
        load_tokenizer(changed_folder(tmp_path / "odd", change), vocab_size=TINY_VOCAB)


@pytest.mark.parametrize(("key", "value"), [("tokenizer_class", "LlamaTokenizer"), ("add_bos_token", False)])
def test_what_stands_beside_a_tokenizer_json_counts(tmp_path: Path, key: str, value: object) -> None:
    folder = tokenizer_folder.write(tmp_path / "t")
    config = tokenizer_folder.tokenizer_config() | {key: value}
    (folder / "tokenizer_config.json").write_text(json.dumps(config))
    with pytest.raises(TokenizerError, match=f"tokenizer_config.json's {key} is"):
        load_tokenizer(folder, vocab_size=TINY_VOCAB)


def test_merges_written_as_text_are_the_same(folder: Path, tmp_path: Path, from_json: PromptTokenizer) -> None:
    text = changed_folder(
        tmp_path / "t", lambda c: c["model"].update(merges=[" ".join(m) for m in c["model"]["merges"]])
    )
    found = load_tokenizer(text, vocab_size=TINY_VOCAB)
    assert found.encode("pick up the black bowl") == from_json.encode("pick up the black bowl")
