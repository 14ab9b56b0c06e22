"""Packed weights: the policies that ship are as they were trained, whatever becomes of the cache."""

import lzma
import shutil
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from turbopi.checkpoint import convert, open_checkpoint, packed
from turbopi.checkpoint.packed import CHECKSUM, PACKED, unpacked
from turbopi.checkpoint.torch_files import WEIGHTS
from turbopi.policy.shipped import CHASE_POLICY, SMALL_POLICY
from turbopi.support.errors import CheckpointError


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty cache of the user's, and a process that has unpacked nothing."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(packed, "_temporary", {})
    return tmp_path / "cache" / "turbopi" / "weights"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the smaller policy that ships."""
    return Path(shutil.copytree(CHASE_POLICY, tmp_path / "policy"))


@pytest.fixture
def unpackings(monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """The files that were unpacked."""
    found: list[Path] = []
    unpack = packed._unpack

    def counted(file: Path) -> bytes:
        found.append(file)
        return unpack(file)

    monkeypatch.setattr(packed, "_unpack", counted)
    return found


@pytest.mark.parametrize("policy", [SMALL_POLICY, CHASE_POLICY], ids=lambda policy: policy.name)
def test_convert_gives_a_shipped_policy_in_openpis_layout(policy: Path, tmp_path: Path) -> None:
    content = (convert(policy, tmp_path / "plain", precision="bf16") / WEIGHTS).read_bytes()
    assert content == lzma.decompress((policy / PACKED).read_bytes())
    assert open_checkpoint(tmp_path / "plain").fingerprint() == open_checkpoint(policy).fingerprint()


def test_weights_are_unpacked_once_into_the_users_cache(folder: Path, cache: Path, unpackings: list[Path]) -> None:
    opened = [open_checkpoint(one) for one in (folder, folder, CHASE_POLICY)]
    assert unpackings == [folder / PACKED]
    assert [one.path for one in opened] == [folder, folder, CHASE_POLICY]
    assert {file for one in opened for file in one.source.files} == set(cache.glob(f"*/{WEIGHTS}"))  # type: ignore[attr-defined]
    assert not (folder / WEIGHTS).exists()


def test_the_unpacked_file_comes_before_the_packed_one(folder: Path, cache: Path) -> None:
    (folder / PACKED).write_bytes(b"damaged")
    (folder / WEIGHTS).write_bytes(lzma.decompress((CHASE_POLICY / PACKED).read_bytes()))
    assert open_checkpoint(folder).source.files == [folder / WEIGHTS]  # type: ignore[attr-defined]
    assert not cache.exists()


@pytest.mark.parametrize("damage", ["a byte", "the end", "nothing left", "a folder"])
def test_a_damaged_file_of_the_cache_never_becomes_weights(folder: Path, damage: str) -> None:
    expected = open_checkpoint(CHASE_POLICY).fingerprint()
    file = unpacked(folder) / WEIGHTS
    content = file.read_bytes()
    if damage == "a folder":
        file.unlink()
        (file / "sub").mkdir(parents=True)
    else:
        middle = len(content) // 2
        changed = content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]
        file.write_bytes({"a byte": changed, "the end": content[:-1], "nothing left": b""}[damage])
    assert open_checkpoint(folder).fingerprint() == expected
    assert (unpacked(folder) / WEIGHTS).read_bytes() == content
    assert (unpacked(folder) == file.parent) == (damage != "a folder")


def test_two_at_once_both_get_the_weights(folder: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As two processes: each finds an empty cache, unpacks and writes."""
    both, unpack = threading.Barrier(2, timeout=60), packed._unpack

    def unpack_together(file: Path) -> bytes:
        both.wait()
        return unpack(file)

    monkeypatch.setattr(packed, "_unpack", unpack_together)
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(unpacked, [folder, folder]))
    assert [file.name for file in cache.rglob("*") if file.is_file()] == [WEIGHTS]
    assert {(one / WEIGHTS).read_bytes() for one in found} == {lzma.decompress((folder / PACKED).read_bytes())}


def test_without_a_cache_a_process_unpacks_once_to_a_temporary_folder(
    folder: Path, cache: Path, unpackings: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    at_exit: list[tuple[object, ...]] = []
    monkeypatch.setattr(packed.atexit, "register", lambda *words, **_: at_exit.append(words))
    monkeypatch.setattr(packed.tempfile, "tempdir", str(tmp_path))
    cache.parent.parent.write_text("a file where the folder should be")
    first, second = unpacked(folder), unpacked(folder)
    assert first == second and first.parent == tmp_path and len(unpackings) == 1
    assert at_exit == [(shutil.rmtree, first)]
    (first / WEIGHTS).unlink()  # some systems clean /tmp
    assert open_checkpoint(folder).fingerprint() == open_checkpoint(CHASE_POLICY).fingerprint()


def test_where_nothing_can_be_written_both_places_are_named(
    folder: Path, cache: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cache.parent.parent.write_text("a file where the folder should be")
    monkeypatch.setattr(packed.tempfile, "tempdir", str(tmp_path / "missing"))
    with pytest.raises(CheckpointError, match=r"neither to .*cache/turbopi/weights.* XDG_CACHE_HOME or TMPDIR"):
        open_checkpoint(folder)


def damaged(content: bytes) -> dict[str, tuple[str, bytes | None, str]]:
    """Which file is replaced by what (None: it is missing), and the error."""
    middle = len(content) // 2
    return {
        "a byte": (PACKED, content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :], "is damaged"),
        "the end": (PACKED, content[:-5000], "ends early"),
        "no xz": (PACKED, b"PK\x03\x04, as archives of another kind begin", r"can't be unpacked \(.*damaged"),
        "others' weights": (PACKED, lzma.compress(b"weights"), f"doesn't hold what {CHECKSUM} beside it says"),
        "a pointer": (PACKED, b"version https://git-lfs.github.com/spec/v1\noid", "is a Git-LFS pointer"),
        "no checksum": (CHECKSUM, None, f"{CHECKSUM} can't be read: No such file or directory; it belongs to {PACKED}"),
        "no hash": (CHECKSUM, b"\xff../../../etc", "begins with .*; expected a line of sha256sum"),
        "other hash": (CHECKSUM, b"0" * 64 + b"  model.safetensors\n", "doesn't hold what"),
    }


@pytest.mark.parametrize("case", damaged(b" " * 9))
def test_damaged_files_are_refused_by_name(folder: Path, cache: Path, case: str) -> None:
    name, content, message = damaged((folder / PACKED).read_bytes())[case]
    (folder / name).unlink()
    if content is not None:
        (folder / name).write_bytes(content)
    with pytest.raises(CheckpointError, match=message) as caught:
        open_checkpoint(folder)
    assert str(folder) in str(caught.value) and not cache.exists()


def test_a_file_that_grows_without_end_is_refused(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(packed, "_MOST_BYTES", 2**20)
    (folder / PACKED).write_bytes(lzma.compress(bytes(2**20 + 1), preset=0))
    with pytest.raises(CheckpointError, match="holds more than 1 MiB: unpack it beside itself"):
        open_checkpoint(folder)


def test_unpacked_weights_beside_packed_ones_are_read_and_others_are_noted(folder: Path) -> None:
    """As scripts/setup leaves them in a clone; after an update they may be of before."""
    (folder / WEIGHTS).write_bytes(lzma.decompress((folder / PACKED).read_bytes()))
    assert not [note for note in open_checkpoint(folder).source.notes if "two sources" in note]
    with (folder / CHECKSUM).open("w") as stream:
        stream.write("0" * 64 + f"  {WEIGHTS}\n")
    notes = [note for note in open_checkpoint(folder).source.notes if "two sources of weights" in note]
    assert len(notes) == 1 and f"{WEIGHTS} is read" in notes[0] and PACKED in notes[0]
