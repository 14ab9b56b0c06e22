"""Files appear whole or not at all, whatever happens while they are written."""

import errno
import fcntl
import json
import multiprocessing
import os
import platform
import stat
import sys
import threading
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import IO, Any

import numpy as np
import pytest
from file_helpers import no_room
from matplotlib.figure import Figure

from turbopi.support.errors import CheckpointError, ConfigError, OutputError
from turbopi.support.files import (
    alone_in,
    append_line,
    cache_folder,
    keep_in_cache,
    new_file,
    new_folder,
    whole_lines,
    write_whole,
)
from turbopi.support.plots import write_figure


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


# -- caches ------------------------------------------------------------------------------------------------------------


def test_what_can_be_made_again_is_kept_or_named_once_in_the_log(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert keep_in_cache(tmp_path / "new" / "cubin", b"code") and (tmp_path / "new" / "cubin").read_bytes() == b"code"
    assert not caplog.messages
    (tmp_path / "file").write_text("")
    for name in ("one", "another"):
        assert not keep_in_cache(tmp_path / "file" / "folder" / name, b"code")
    with no_room(100):
        assert not keep_in_cache(tmp_path / "full", b"code" * 100)
    not_made, full = caplog.messages
    assert "can't make the folder" in not_made and "make room" in full
    assert names(tmp_path) == ["file", "new"]


def test_a_user_without_a_home_has_a_cache_folder_that_cannot_be_made(monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", homeless)
    assert not keep_in_cache(cache_folder() / "cubin", b"code")


# -- one file ----------------------------------------------------------------------------------------------------------


def test_text_bytes_and_what_a_function_writes_arrive_alone(tmp_path: Path) -> None:
    write_whole(tmp_path / "text", "größer\n")
    write_whole(tmp_path / "bytes", b"\0\1")
    write_whole(tmp_path / "arrays.npz", lambda stream: np.savez(stream, a=np.arange(3)))
    assert (tmp_path / "text").read_text(encoding="utf-8") == "größer\n"
    assert (tmp_path / "bytes").read_bytes() == b"\0\1"
    with np.load(tmp_path / "arrays.npz") as arrays:
        assert arrays["a"].tolist() == [0, 1, 2]
    assert names(tmp_path) == ["arrays.npz", "bytes", "text"]


def large_figure(file: Path) -> None:
    figure = Figure(figsize=(4, 4))
    figure.subplots().imshow(np.random.default_rng(0).random((200, 200)))
    write_figure(file, figure)


def fill(stream: IO[bytes]) -> None:
    for _ in range(100):
        stream.write(b"x" * 1000)


WRITERS = {
    "text": lambda file: write_whole(file, "new " * 1000),
    "function": lambda file: write_whole(file, fill),
    "npz": lambda file: write_whole(file, lambda stream: np.savez(stream, a=np.zeros(9999), b=np.zeros(3))),
    "npz, compressed": lambda file: write_whole(
        file, lambda stream: np.savez_compressed(stream, a=np.random.default_rng(0).random(9999))
    ),
    "png": lambda file: large_figure(file.with_suffix(".png")),
    "svg": lambda file: large_figure(file.with_suffix(".svg")),
    "pdf": lambda file: large_figure(file.with_suffix(".pdf")),
}


@pytest.mark.parametrize("room", [0, 100, 1000])
@pytest.mark.parametrize("writer", WRITERS)
def test_a_full_disk_keeps_the_earlier_file_and_names_it(writer: str, room: int, tmp_path: Path) -> None:
    ending = f".{writer}" if writer in ("png", "svg", "pdf") else ""
    file = tmp_path / f"result{ending}"
    file.write_text("earlier")
    with no_room(room), pytest.raises(OutputError) as reported:
        WRITERS[writer](file)
    assert str(reported.value) == f"can't write {file}: File too large; make room, or write to another place"
    assert file.read_text() == "earlier" and names(tmp_path) == [file.name]


def test_a_disk_that_is_full_only_when_it_is_synced_counts_as_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on disks that give out room late."""

    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    file = tmp_path / "result"
    file.write_text("earlier")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OutputError, match=r"can't write .*result: No space left on device; make room"):
        write_whole(file, "new")
    assert file.read_text() == "earlier" and names(tmp_path) == ["result"]


def test_a_disk_that_cant_sync_is_written_to(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(descriptor: int) -> None:
        raise OSError(errno.EINVAL, os.strerror(errno.EINVAL))

    monkeypatch.setattr(os, "fsync", unknown)
    write_whole(tmp_path / "result", "new")
    assert (tmp_path / "result").read_text() == "new"


def test_whatever_ends_the_writing_leaves_the_earlier_file(tmp_path: Path) -> None:
    file = tmp_path / "result"
    file.write_text("earlier")
    for reason in (KeyboardInterrupt(), ValueError("a wrong value"), ConfigError("refused")):

        def stop(stream: IO[bytes], reason: BaseException = reason) -> None:
            stream.write(b"half")
            raise reason

        with pytest.raises(type(reason)) as reported:
            write_whole(file, stop)
        assert reported.value is reason
        assert file.read_text() == "earlier" and names(tmp_path) == ["result"]


def test_a_file_is_on_the_disk_before_it_has_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    happened = []
    sync, replace = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        happened.append(Path(os.readlink(f"/proc/self/fd/{descriptor}")))
        sync(descriptor)

    def replaced(source: Path, target: Path) -> None:
        assert source.read_text() == "new"
        happened.append(Path(target))
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", replaced)
    write_whole(tmp_path / "result", "new")
    temporary, target, folder = happened
    assert temporary.parent == tmp_path and temporary.name.startswith(".result.") and str(os.getpid()) in temporary.name
    assert (target, folder) == (tmp_path / "result", tmp_path)


def test_messages_name_the_file_the_reason_and_are_of_the_callers_class(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=f"^can't write {tmp_path}/no/file: there is no folder {tmp_path}/no$"):
        write_whole(tmp_path / "no" / "file", "", CheckpointError)
    with pytest.raises(OutputError, match=f"^can't write {tmp_path}: Is a directory$") as reported:
        write_whole(tmp_path, "")
    assert isinstance(reported.value, OSError)
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=f"^can't write {tmp_path}/file/below: there is no folder {tmp_path}/file$"):
        write_whole(tmp_path / "file" / "below", "")


def test_a_fault_of_another_file_is_told_as_that_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="another") as reported:
        write_whole(tmp_path / "result", lambda stream: stream.write((tmp_path / "sub" / "another").read_bytes()))
    assert not isinstance(reported.value, OutputError) and names(tmp_path) == []


def test_permissions_and_links_stay(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    file, link = tmp_path / "elsewhere" / "private", tmp_path / "link"
    file.write_text("earlier")
    file.chmod(0o600)
    link.symlink_to(file)
    write_whole(link, "new")
    assert link.is_symlink() and file.read_text() == "new" and stat.S_IMODE(file.stat().st_mode) == 0o600
    assert names(tmp_path) == ["elsewhere", "link"] and names(file.parent) == ["private"]


def test_a_new_files_permissions_are_the_users_usual_ones(tmp_path: Path) -> None:
    write_whole(tmp_path / "ours", "")
    (tmp_path / "usual").write_text("")
    assert (tmp_path / "ours").stat().st_mode == (tmp_path / "usual").stat().st_mode


def test_what_cant_be_replaced_is_written_to(tmp_path: Path) -> None:
    write_whole(Path(os.devnull), "nothing")
    assert stat.S_ISCHR(os.stat(os.devnull).st_mode)
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    read: list[bytes] = []
    reader = threading.Thread(target=lambda: read.append(pipe.read_bytes()))
    reader.start()
    write_whole(pipe, "through")
    reader.join(60)
    assert read == [b"through"] and stat.S_ISFIFO(pipe.stat().st_mode)


def test_a_long_name_leaves_room_for_the_temporary_one(tmp_path: Path) -> None:
    for letter in ("x", "ö", "🤖"):
        name = letter * (250 // len(letter.encode()))
        write_whole(tmp_path / name, "new")
        assert (tmp_path / name).read_text() == "new"


def write_often(file: Path, number: int) -> None:
    for _ in range(50):
        write_whole(file, str(number) * 20_000)


@pytest.mark.slow
def test_of_many_writers_at_once_none_fails_and_readers_find_a_whole_file(tmp_path: Path) -> None:
    file = tmp_path / "shared"
    write_often(file, 9)
    with ProcessPoolExecutor(3, mp_context=multiprocessing.get_context("spawn")) as pool:
        writers = [pool.submit(write_often, file, number) for number in range(6)]
        while not all(writer.done() for writer in writers):
            text = file.read_text()
            assert len(text) == 20_000 and len(set(text)) == 1
        for writer in writers:
            writer.result()
    assert names(tmp_path) == ["shared"]


def test_a_path_that_another_writer_fills_becomes_the_file(tmp_path: Path) -> None:
    with new_file(tmp_path / "video.mp4", ending=".mp4") as temporary:
        temporary.write_text("frames")
        assert names(tmp_path) == [temporary.name] and temporary.name.startswith(".video.mp4.")
        assert temporary.suffix == ".mp4"
    assert names(tmp_path) == ["video.mp4"]


# -- folders -----------------------------------------------------------------------------------------------------------


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:

    def fail(folder: Path) -> None:
        (folder / "half").write_text("")
        raise RuntimeError

    with pytest.raises(RuntimeError), new_folder(tmp_path / "made") as folder:
        fail(folder)
    assert names(tmp_path) == []
    with new_folder(tmp_path / "deep" / "made") as folder:
        (folder / "below").mkdir()
        (folder / "below" / "file").write_text("whole")
        assert not (tmp_path / "deep" / "made").exists()
    assert (tmp_path / "deep" / "made" / "below" / "file").read_text() == "whole"
    assert names(tmp_path / "deep") == ["made"]


def test_a_folder_on_a_full_disk_leaves_nothing_and_is_named(tmp_path: Path) -> None:
    target = tmp_path / "made"
    with (
        no_room(10),
        pytest.raises(CheckpointError, match=f"can't write {target}: File too large"),
        new_folder(target, CheckpointError) as folder,
    ):
        (folder / "file").write_bytes(b"x" * 100)
    assert names(tmp_path) == []


def test_what_somebody_put_there_meanwhile_stays(tmp_path: Path) -> None:
    target = tmp_path / "made"

    def fill_both(folder: Path) -> None:
        (folder / "ours").write_text("")
        target.mkdir()
        (target / "theirs").write_text("")

    with pytest.raises(OutputError, match=f"can't write {target}: Directory not empty"), new_folder(target) as folder:
        fill_both(folder)
    assert names(tmp_path) == ["made"] and names(target) == ["theirs"]


def test_an_empty_folder_that_cant_be_replaced_is_filled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Such as a container's mounted folder: it has no neighbours on its disk, and can't be removed."""
    target = tmp_path / "mounted"
    target.mkdir()
    before = target.stat().st_ino
    monkeypatch.setattr(Path, "is_mount", lambda self: self == target)
    with new_folder(target) as folder:
        assert folder.parent == target
        (folder / "below").mkdir()
        (folder / "below" / "file").write_text("whole")
    assert target.stat().st_ino == before and names(target) == ["below"] and names(tmp_path) == ["mounted"]


# -- one writer of several files ---------------------------------------------------------------------------------------


def hold(folder: Path, ready: Any, done: Any) -> None:
    with alone_in(folder, "a test"):
        ready.set()
        done.wait(120)


@pytest.fixture(params=["locks", "no locks"])
def disk(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """A disk with locks, and one that knows none."""

    def unsupported(descriptor: int, operation: int) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    if request.param == "no locks":
        monkeypatch.setattr(fcntl, "flock", unsupported)
    return str(request.param)


@pytest.mark.slow
def test_a_second_writer_is_refused_with_the_first_ones_process(tmp_path: Path, disk: str) -> None:
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    first = spawn.Process(target=hold, args=(tmp_path, ready, done))
    first.start()
    assert ready.wait(120)
    said = f"^{tmp_path} is being written by a test, process {first.pid} on {platform.node()}: wait until it is done"
    with pytest.raises(ConfigError, match=said), alone_in(tmp_path, "a test", ConfigError):
        pass
    done.set()
    first.join(120)
    with alone_in(tmp_path, "a test"):
        assert names(tmp_path) == [".turbopi.lock"]
    assert names(tmp_path) == []


@pytest.mark.slow
def test_a_killed_writer_leaves_no_lock(tmp_path: Path, disk: str) -> None:
    spawn = multiprocessing.get_context("spawn")
    ready, done = spawn.Event(), spawn.Event()
    killed = spawn.Process(target=hold, args=(tmp_path, ready, done))
    killed.start()
    assert ready.wait(120)
    killed.kill()
    killed.join(120)
    assert names(tmp_path) == [".turbopi.lock"]
    with alone_in(tmp_path, "a test"):
        assert str(os.getpid()) in (tmp_path / ".turbopi.lock").read_text()
    assert names(tmp_path) == []


@pytest.mark.parametrize("left", ["", "process 0x7 on", "process 99999999999999999999 on here", "\0\xff"])
def test_a_damaged_lock_is_no_lock(left: str, tmp_path: Path, disk: str) -> None:
    (tmp_path / ".turbopi.lock").write_text(left)
    with alone_in(tmp_path, "a test"):
        pass


def test_a_full_disk_leaves_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(OutputError, match="No space left on device"), alone_in(tmp_path, "a test"):
        pass
    assert names(tmp_path) == []


def test_without_locks_another_hosts_is_believed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "fcntl", None)  # as on systems that have none
    (tmp_path / ".turbopi.lock").write_text("process 7 on elsewhere\n")
    with (
        pytest.raises(OutputError, match=r"process 7 on elsewhere: .* gone, delete .*\.turbopi\.lock"),
        alone_in(tmp_path, "a test"),
    ):
        pass


def test_one_of_many_gets_the_lock(tmp_path: Path) -> None:
    """Locking and removing the lock's file don't come between each other: never two at once."""
    inside, most, refused = 0, 0, 0
    counting = threading.Lock()

    def often() -> None:
        nonlocal inside, most, refused
        for _ in range(200):
            try:
                with alone_in(tmp_path, "a test"):
                    with counting:
                        inside += 1
                        most = max(most, inside)
                    with counting:
                        inside -= 1
            except OutputError:
                with counting:
                    refused += 1

    threads = [threading.Thread(target=often) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most == 1 and refused < 800


# -- lines -------------------------------------------------------------------------------------------------------------


def test_lines_are_appended_whole(tmp_path: Path) -> None:
    file = tmp_path / "index.jsonl"
    for number in range(3):
        append_line(file, json.dumps({"number": number, "text": "\u2028 ö"}, ensure_ascii=False))
    assert [json.loads(line)["number"] for line in whole_lines(file)] == [0, 1, 2]


@pytest.mark.parametrize("half", ['{"number": 1, "te', "{", "1", "\0" * 200_000, '{"a": "' + "x" * 200_000])
def test_a_half_line_is_ignored_and_never_damages_the_next_one(half: str, tmp_path: Path) -> None:
    file = tmp_path / "index.jsonl"
    for first in ("", '{"number": 0}\n'):
        file.write_text(first + half)
        assert "".join(f"{line}\n" for line in whole_lines(file)) == first
        append_line(file, '{"number": 2}')
        assert file.read_text() == first + '{"number": 2}\n'


def test_a_last_line_that_lacks_only_its_line_break_is_kept(tmp_path: Path) -> None:
    file = tmp_path / "index.jsonl"
    file.write_text('{"number": 0}\n{"number": 1}')
    assert whole_lines(file) == ['{"number": 0}', '{"number": 1}']
    append_line(file, '{"number": 2}')
    assert file.read_text() == '{"number": 0}\n{"number": 1}\n{"number": 2}\n'


def test_a_full_disk_leaves_no_half_line(tmp_path: Path) -> None:
    file = tmp_path / "index.jsonl"
    append_line(file, '{"number": 0}')
    with no_room(20), pytest.raises(OutputError, match=rf"can't write {file}: File too large; make room"):
        append_line(file, '{"number": 1}')
    assert file.read_text() == '{"number": 0}\n'
    append_line(file, '{"number": 2}')
    assert whole_lines(file) == ['{"number": 0}', '{"number": 2}']


def append_often(file: Path, number: int) -> None:
    for _ in range(100):
        append_line(file, json.dumps({"number": number, "text": str(number) * 5000}))


@pytest.mark.slow
def test_several_processes_may_append_to_one_file(tmp_path: Path) -> None:
    file = tmp_path / "index.jsonl"
    with ProcessPoolExecutor(3, mp_context=multiprocessing.get_context("spawn")) as pool:
        for writer in [pool.submit(append_often, file, number) for number in range(3)]:
            writer.result()
    lines = [json.loads(line) for line in whole_lines(file)]
    assert sorted(line["number"] for line in lines) == [0] * 100 + [1] * 100 + [2] * 100
    assert all(line["text"] == str(line["number"]) * 5000 for line in lines)
