"""A transformers tokenizer folder with the pieces of the small SentencePiece model: a stand-in for what LeRobot saves.

    PYTHONPATH=tools python -m lerobot_cases.tokenizer_folder FOLDER

The merges are derived from the pieces and their scores, as transformers converts Gemma's model. It needs neither.
"""

import json
import sys
from pathlib import Path
from typing import Any

from sentencepiece import SentencePieceProcessor

MODEL = Path(__file__).parents[2] / "src" / "turbopi" / "data" / "small_policy" / "tokenizer.model"
PAD, EOS, BOS, UNK = range(4)


def tokenizer_json() -> dict[str, Any]:
    """The content of a tokenizer.json."""
    model = SentencePieceProcessor(model_file=str(MODEL))
    pieces = [model.id_to_piece(place) for place in range(model.vocab_size())]
    vocab = {piece: place for place, piece in enumerate(pieces)}
    merges = [
        (-model.get_score(place), [piece[:i], piece[i:]])
        for place, piece in enumerate(pieces)
        for i in range(1, len(piece))
        if piece[:i] in vocab and piece[i:] in vocab
    ]
    merges.sort(key=lambda merge: merge[0])
    never = {"single_word": False, "lstrip": False, "rstrip": False, "normalized": False}
    begin = {"SpecialToken": {"id": pieces[BOS], "type_id": 0}}
    return {
        "version": "1.0",
        "truncation": None,
        "padding": None,
        "added_tokens": [
            {"id": place, "content": pieces[place], "special": True} | never for place in (PAD, EOS, BOS, UNK)
        ],
        "normalizer": {"type": "Replace", "pattern": {"String": " "}, "content": "▁"},
        "pre_tokenizer": None,
        "post_processor": {
            "type": "TemplateProcessing",
            "single": [begin, {"Sequence": {"id": "A", "type_id": 0}}],
            "pair": [{"Sequence": {"id": "A", "type_id": 0}}, {"Sequence": {"id": "B", "type_id": 1}}],
            "special_tokens": {pieces[BOS]: {"id": pieces[BOS], "ids": [BOS], "tokens": [pieces[BOS]]}},
        },
        "decoder": None,
        "model": {
            "type": "BPE",
            "dropout": None,
            "unk_token": pieces[UNK],
            "continuing_subword_prefix": None,
            "end_of_word_suffix": None,
            "fuse_unk": True,
            "byte_fallback": True,
            "ignore_merges": False,
            "vocab": vocab,
            "merges": [pair for _, pair in merges],
        },
    }


def tokenizer_config() -> dict[str, Any]:
    """Of a tokenizer_config.json, what transformers needs."""
    vocab = list(tokenizer_json()["model"]["vocab"])
    names = {"pad_token": PAD, "eos_token": EOS, "bos_token": BOS, "unk_token": UNK}
    return {name: vocab[place] for name, place in names.items()} | {
        "tokenizer_class": "PreTrainedTokenizerFast",
        "model_max_length": 10**30,
    }


def write(folder: Path) -> Path:
    """The two files in `folder`, which is made if it isn't there."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "tokenizer.json").write_text(json.dumps(tokenizer_json()))
    (folder / "tokenizer_config.json").write_text(json.dumps(tokenizer_config()))
    return folder


if __name__ == "__main__":
    write(Path(sys.argv[1]))
