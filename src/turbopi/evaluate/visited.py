"""Observations that a policy met on its way, kept to ask another policy about them."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct

from turbopi.evaluate.plan import Job
from turbopi.evaluate.sources import Answer, PolicySource
from turbopi.recordings import Recorder
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import listing, read_npz

FILE = "visited.npz"
KEPT = 48
HELD = 1e-5  # spread of a dimension that a policy holds still, over its size or 1: un-normalising adds openpi's 1e-6


class Visited:
    """A uniform sample of all requests of a run (reservoir sampling), kept beside its results.

    Each entry: the observation as the policy got it, the noise's seed, and the actions it gave.
    """

    def __init__(self, folder: Path, kept: int = KEPT, *, restart: bool = False) -> None:
        """Continues the sample that the folder holds, unless `restart`. Raises ConfigError if that is damaged."""
        self._path, self._kept = folder / FILE, kept
        self.seen, self.entries = (0, []) if restart or not self._path.exists() else _read(self._path)
        self._found = self.seen
        self._rng = np.random.default_rng(self.seen)

    def __call__(self, job: Job, step: int, observation: dict[str, object], seed: int, answer: Answer) -> None:
        self.seen += 1
        entry = {key: np.asarray(value) for key, value in observation.items()}
        entry |= {"seed": np.asarray(seed, np.uint64), "actions": answer.actions}
        if len(self.entries) < self._kept:
            self.entries.append(entry)
            return
        place = int(self._rng.integers(self.seen))
        if place < self._kept:
            self.entries[place] = entry

    def save(self) -> None:
        """Write the sample; if nothing was added to it, what the folder holds stays as it is."""
        if self.seen == self._found:
            return
        stored: dict[str, Any] = {"seen": self.seen, "count": len(self.entries)}
        for row, entry in enumerate(self.entries):
            stored |= {f"{row}|{name}": value for name, value in entry.items()}
        self._path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(self._path, lambda stream: np.savez_compressed(stream, **stored))


class Recording:
    """All requests of a run, as `turbopi serve --record` writes them: to calibrate and to verify on."""

    def __init__(self, folder: Path, source: PolicySource) -> None:
        """Into a new folder below `folder`. Raises ConfigError if it can't be made."""
        self._recorder = Recorder(folder, {"label": source.label, "identity": source.identity})

    def __call__(self, job: Job, step: int, observation: dict[str, object], seed: int, answer: Answer) -> None:
        size = sum(value.nbytes for value in observation.values() if isinstance(value, np.ndarray))
        where = {"task": job.task.index, "initial_state": job.initial_state, "step": step, "seed": str(seed)}
        timing = {} if answer.infer_ms is None else {"policy_timing": {"infer_ms": answer.infer_ms}}
        self._recorder.put(observation, {"actions": answer.actions, **timing, "episode": where}, size=size)

    def close(self) -> str:
        """Write what waits. Returns what to tell."""
        self._recorder.close()
        missing = self._recorder.dropped + self._recorder.failed
        lost = f"; {missing} more could not be written" if missing else ""
        return f"recorded {self._recorder.written} observations in {self._recorder.folder}{lost}"


class ActionDifference(Struct, frozen=True):
    """Difference to the reference's actions, each dimension in units of its own spread over the reference's chunks.

    A dimension that the reference holds still (HELD) counts in its own unit: its spread is rounding.
    """

    rms: float
    max: float
    observations: int


def action_error(entries: Sequence[Mapping[str, np.ndarray]], reference: PolicySource) -> ActionDifference | None:
    """How far the entries' actions are from the reference's, given the same observations and noise.

    None without entries.
    """
    if not entries:
        return None
    exact = []
    for entry in entries:
        observation = {
            key: str(value) if value.dtype.kind == "U" else value
            for key, value in entry.items()
            if key not in ("seed", "actions")
        }
        exact.append(reference.infer([observation], [int(entry["seed"])])[0].actions)
    truth, given = np.stack(exact), np.stack([entry["actions"] for entry in entries])
    spread = truth.std(axis=(0, 1))
    spread[spread <= HELD * np.maximum(1.0, np.abs(truth).max(axis=(0, 1)))] = 1
    error = (given - truth) / spread
    return ActionDifference(float(np.sqrt(np.mean(error**2))), float(np.abs(error).max()), len(entries))


def _read(path: Path) -> tuple[int, list[dict[str, np.ndarray]]]:
    """How many requests were seen, and the entries kept of them. ConfigError for a file that `save` didn't write."""
    stored = read_npz(path, ConfigError)
    whole = [name for name in ("seen", "count") if name in stored and stored[name].ndim == 0]
    kinds = [stored[name].dtype.kind for name in whole]
    if kinds != ["i", "i"] or not 0 <= stored["count"] <= stored["seen"]:
        raise ConfigError(
            f"{path} isn't a sample of requests that `turbopi eval` wrote; give another --out, or --restart"
        )
    names = {name.split("|", 1)[1] for name in stored if "|" in name}
    rows = range(min(int(stored["count"]), len(stored)))
    absent = [f"{row}|{name}" for row in rows for name in names if f"{row}|{name}" not in stored]
    if absent or len(rows) < stored["count"] or (rows and not {"seed", "actions"} <= names):
        raise ConfigError(f"{path} lacks {listing(absent) or 'entries'}; give another --out, or --restart")
    return int(stored["seen"]), [{name: stored[f"{row}|{name}"] for name in names} for row in rows]
