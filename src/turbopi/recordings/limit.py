"""How much of a recording stays on the disk: the newest calls, below a size, younger than an age."""

import logging
import re
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from turbopi.support.errors import ConfigError

logger = logging.getLogger(__name__)

_SIZES = {"MB": 10**6, "GB": 10**9, "TB": 10**12}
_AGES = {"h": 3600, "d": 86400}
_CALL = "[0-9]" * 6 + "*.npz"


@dataclass(frozen=True)
class RecordLimit:
    """What may stay below a `--record` folder. `bytes` and `seconds`: None is no limit."""

    bytes: int | None = None
    seconds: float | None = None

    @classmethod
    def of(cls, text: str) -> "RecordLimit":
        """From "20GB", "7d" or "20GB,7d". Raises ConfigError for anything else."""
        values: dict[str, float] = {}
        for part in text.split(","):
            found = re.fullmatch(r"\s*([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*(MB|GB|TB|h|d)\s*", part)
            kind = "bytes" if found is not None and found[2] in _SIZES else "seconds"
            if found is None or kind in values or not float(found[1]):
                raise ConfigError(
                    f"record_limit={text!r} should be a size, an age, or both: 20GB, 7d or 20GB,7d (MB, GB, TB; h, d)"
                )
            values[kind] = float(found[1]) * {**_SIZES, **_AGES}[found[2]]
        return cls(int(values["bytes"]) if "bytes" in values else None, values.get("seconds"))


class Trimmed:
    """Removes the oldest calls below a `--record` folder, those of earlier runs too, and says in the log what went.

    Whatever else is in the folder stays. Not for several threads.
    """

    def __init__(self, record_dir: Path, limit: RecordLimit) -> None:
        self._limit = limit
        self._calls: deque[tuple[float, int, Path]] = deque(sorted(_calls(record_dir)))
        self._bytes = sum(size for _, size, _ in self._calls)
        self._removed, self._reported = 0, 0
        self._removed_bytes = 0

    def add(self, file: Path) -> int:
        """Take note of a call that was written, and remove what is too much. How many calls were removed."""
        status = file.stat()
        self._calls.append((status.st_mtime, status.st_size, file))
        self._bytes += status.st_size
        return self.trim()

    def trim(self) -> int:
        """How many calls were removed now. The newest one always stays."""
        before, oldest = self._removed, time.time() - (self._limit.seconds or 0)
        while len(self._calls) > 1:
            moment, size, file = self._calls[0]
            too_old = self._limit.seconds is not None and moment < oldest
            too_many = self._limit.bytes is not None and self._bytes > self._limit.bytes
            if not too_old and not too_many:
                break
            self._calls.popleft()
            self._bytes -= size
            try:
                file.unlink(missing_ok=True)
            except OSError as error:
                logger.warning("--record-limit: %s can't be removed: %s", file, error.strerror)
                continue
            self._removed += 1
            self._removed_bytes += size
        if self._removed >= max(1, 2 * self._reported):
            self.report()
        return self._removed - before

    def report(self) -> None:
        """Say in the log what was removed so far, unless it was said."""
        if self._removed > self._reported:
            self._reported = self._removed
            logger.info(
                "--record-limit: the %d oldest recorded calls (%.0f MB) were removed; %d calls (%.0f MB) are left",
                *(self._removed, self._removed_bytes / 1e6, len(self._calls), self._bytes / 1e6),
            )


def _calls(record_dir: Path) -> Iterator[tuple[float, int, Path]]:
    """(moment, bytes, file) of every call of every run."""
    for manifest in record_dir.glob("*/manifest.json"):
        for file in manifest.parent.glob(_CALL):
            status = file.stat()
            yield status.st_mtime, status.st_size, file
