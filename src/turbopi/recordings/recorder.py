"""Recording while serving: a thread that writes calls to disk and never holds the robot up."""

import itertools
import json
import logging
import queue
import threading
import time
from collections.abc import Callable
from pathlib import Path

from turbopi.recordings.format import FORMAT, VERSION, RecordedCall, RecordImages, save_call
from turbopi.recordings.limit import RecordLimit, Trimmed
from turbopi.support.errors import ConfigError, OutputError
from turbopi.support.files import append_line, write_whole

logger = logging.getLogger(__name__)


class Recorder:
    """Writes calls into a new folder below `record_dir` (layout: format.py), from a background thread.

    At most `queue_calls` calls or `queue_bytes` bytes wait for the disk; what comes beyond is dropped, and counted in
    `dropped`. A call that can't be written (disk full, folder gone) is counted in `failed` and leaves a gap in the
    numbers; the next one is tried again. A line of the index that can't be written comes with a later one.
    `count` is called with "written", "dropped", "failed" or "removed", from any thread.

    limit   what stays below `record_dir` (limit.py); None: everything
    images  as for `save_call`

    Raises ConfigError if the folder can't be made now.
    """

    def __init__(
        self,
        record_dir: str | Path,
        metadata: dict[str, object],
        *,
        queue_calls: int = 256,
        queue_bytes: int = 256 * 2**20,
        count: Callable[[str], None] = lambda outcome: None,
        limit: RecordLimit | None = None,
        images: RecordImages = "exact",
    ) -> None:
        self.written = self.dropped = self.failed = 0
        self._count, self._images = count, images
        self._queue_bytes = queue_bytes
        self._waiting_bytes = 0
        self._lock = threading.Lock()
        self._queue: queue.Queue[tuple[RecordedCall, int] | None] = queue.Queue(queue_calls)
        self._owed: list[str] = []  # lines of the index
        try:
            self.folder = _new_folder(Path(record_dir))
            manifest = {"format": FORMAT, "version": VERSION, "started": time.time(), "metadata": metadata}
            write_whole(self.folder / "manifest.json", json.dumps(manifest, indent=1, default=_plain), ConfigError)
            self._trimmed = None if limit is None else Trimmed(Path(record_dir), limit)
        except OSError as error:
            raise ConfigError(f"can't record into {record_dir}: {error}") from error
        self._thread = threading.Thread(target=self._write_all, name="turbopi-recorder", daemon=True)
        self._thread.start()

    def put(self, observation: dict[str, object], result: dict[str, object], *, size: int) -> None:
        """Record a call, or drop it if the disk is behind. Never waits, never raises.

        The values are written later: hand over what nobody changes. `size` is about how many bytes they hold.
        """
        with self._lock:
            full = self._waiting_bytes + size > self._queue_bytes and self._waiting_bytes > 0
            if not full:
                self._waiting_bytes += size
        if not full:
            try:
                self._queue.put_nowait((RecordedCall(observation, result, time.time()), size))
                return
            except queue.Full:
                self._release(size)
        self.dropped += 1
        self._count("dropped")
        if _is_power_of_two(self.dropped):
            logger.warning("%d calls weren't recorded: the disk can't keep up", self.dropped)

    def close(self, timeout: float = 30.0) -> None:
        """Write what waits, for at most `timeout` seconds, and stop. Don't call `put` after it."""
        deadline = time.monotonic() + timeout
        try:
            self._queue.put(None, timeout=timeout)
        except queue.Full:
            logger.warning("the recording in %s is incomplete: the disk doesn't answer", self.folder)
            return
        self._thread.join(max(deadline - time.monotonic(), 0.0))
        if self._thread.is_alive():
            logger.warning("the recording in %s is incomplete: the disk doesn't answer", self.folder)
        elif self._trimmed is not None:
            self._trimmed.report()
        lost = self.dropped + self.failed
        logger.info("recorded %d calls in %s%s", self.written, self.folder, f"; {lost} are lost" if lost else "")

    def _write_all(self) -> None:
        for number in itertools.count():
            if (item := self._queue.get()) is None:
                self._write_index()
                return
            call, size = item
            failure: Exception | None = None
            try:
                self._write(f"{number:06d}.npz", call)
            except Exception as error:  # whatever it is, it must not end serving or the rest of the recording
                failure = error
            self._release(size)
            if failure is None:
                self.written += 1
                self._count("written")
                continue
            self.failed += 1
            self._count("failed")
            if _is_power_of_two(self.failed):
                logger.warning("%d calls couldn't be recorded in %s: %s", self.failed, self.folder, failure)

    def _write(self, name: str, call: RecordedCall) -> None:
        save_call(self.folder / name, call, self._images)
        timing = call.result.get("server_timing", {})
        line = {"file": name, "time": call.time, "infer_ms": timing.get("infer_ms")}
        self._owed.append(json.dumps(line))
        self._write_index()
        if self._trimmed is not None:
            for _ in range(self._trimmed.add(self.folder / name)):
                self._count("removed")

    def _write_index(self) -> None:
        """Add the lines that are owed. What the disk doesn't take now is tried again with the next call."""
        if not self._owed:
            return
        try:
            append_line(self.folder / "index.jsonl", "\n".join(self._owed))
        except OutputError as error:
            if _is_power_of_two(len(self._owed)):
                logger.warning("%d calls are recorded and not in the index yet: %s", len(self._owed), error)
        else:
            self._owed.clear()

    def _release(self, size: int) -> None:
        with self._lock:
            self._waiting_bytes -= size


def _new_folder(parent: Path) -> Path:
    """A new folder named by the time, so that each run of the server has its own and they sort."""
    name = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    parent.mkdir(parents=True, exist_ok=True)
    for attempt in range(1000):
        folder = parent / (name if attempt == 0 else f"{name}-{attempt:03d}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            continue
    raise FileExistsError(f"{parent / name} and 999 names like it are taken")


def _plain(value: object) -> object:
    """Metadata for JSON: numpy arrays as lists, anything else as its text."""
    return value.tolist() if hasattr(value, "tolist") else str(value)


def _is_power_of_two(n: int) -> bool:
    return n & (n - 1) == 0
