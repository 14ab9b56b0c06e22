"""Fingerprints that are remembered: when they are used, and when they aren't."""

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from turbopi.checkpoint import base, convert, known_hashes, open_checkpoint
from turbopi.checkpoint.base import Checkpoint
from turbopi.checkpoint.source import Piece
from turbopi.policy.shipped import SMALL_POLICY

WEIGHTS = "model.safetensors"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkpoint whose files have been as they are for a minute, and an empty cache."""
    monkeypatch.setattr(known_hashes, "cache_folder", lambda: tmp_path / "cache" / "turbopi")
    copied = convert(SMALL_POLICY, tmp_path / "checkpoint", precision="bf16")
    settle(copied / WEIGHTS, 60)
    return copied


def settle(file: Path, seconds: float) -> None:
    then = time.time_ns() - int(seconds * 1e9)
    os.utime(file, ns=(then, then))


def opened(folder: Path) -> Checkpoint:
    return open_checkpoint(folder)


def hashes_of(folder: Path, monkeypatch: pytest.MonkeyPatch, *, trust_files: bool) -> tuple[str, bool]:
    """(the fingerprint, whether all weights were read for it)."""
    checkpoint, reads = opened(folder), [0]
    pieces = checkpoint.source.pieces

    def counted(device: torch.device) -> Iterator[Piece]:
        reads[0] += 1
        return pieces(device)

    monkeypatch.setattr(checkpoint.source, "pieces", counted)
    return checkpoint.fingerprint(trust_files=trust_files), reads[0] > 0


def test_files_that_were_hashed_once_are_not_read_again(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first, read = hashes_of(folder, monkeypatch, trust_files=True)
    assert read
    assert hashes_of(folder, monkeypatch, trust_files=True) == (first, False)


def test_who_does_not_trust_files_reads_them(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = opened(folder).fingerprint()
    assert hashes_of(folder, monkeypatch, trust_files=False) == (first, True)


def test_changed_weights_are_hashed_anew(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = opened(folder).fingerprint()
    content = bytearray((folder / WEIGHTS).read_bytes())
    content[-1] ^= 1
    (folder / WEIGHTS).write_bytes(content)
    settle(folder / WEIGHTS, 30)
    other, read = hashes_of(folder, monkeypatch, trust_files=True)
    assert read and other != first


def test_files_that_were_changed_just_now_are_not_remembered(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settle(folder / WEIGHTS, 0)
    assert hashes_of(folder, monkeypatch, trust_files=True)[1]
    assert hashes_of(folder, monkeypatch, trust_files=True)[1]


def test_a_damaged_entry_is_replaced(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = opened(folder).fingerprint()
    (entry,) = known_hashes._file("x").parent.iterdir()
    entry.write_bytes(b"\xff\xfe")
    assert hashes_of(folder, monkeypatch, trust_files=True) == (first, True)
    assert hashes_of(folder, monkeypatch, trust_files=True) == (first, False)


def test_a_cache_that_cannot_be_written_costs_time_alone(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (folder.parent / "cache").write_text("a file where the folder should be")
    assert hashes_of(folder, monkeypatch, trust_files=True)[1]
    assert hashes_of(folder, monkeypatch, trust_files=True)[1]


def test_a_file_that_is_written_while_it_is_hashed_is_not_remembered(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = iter(["before", "after"])
    monkeypatch.setattr(base.known_hashes, "key_of", lambda *_: next(keys))
    kept: list[str] = []
    monkeypatch.setattr(base.known_hashes, "remember", lambda key, _: kept.append(key))
    opened(folder).fingerprint()
    assert not kept
