"""What a study is, and what it is given. Each file of one has a `STUDY`."""

import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import torch

from turbopi import backends
from turbopi.checkpoint import Checkpoint
from turbopi.policy import shipped
from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.errors import BackendUnavailable, ConfigError
from turbopi.support.provenance import provenance
from turbopi_lab.studies.report import Report

FEWEST_EPISODES = 200  # of a cell that a conclusion rests on
SMALL_EPISODES = 8


Done = TypeVar("Done")
Tell = Callable[[str], None]


def _silent(line: str) -> None:
    return None


def tell_on_stderr(line: str) -> None:
    """Progress of another process."""
    print(line, file=sys.stderr, flush=True)


def _packaged(policy: UnifiedPolicy) -> tuple[list[dict[str, object]], str]:
    return shipped.observations(policy, shipped.load_frames()), "LIBERO images that come with Turbo-Pi"


@dataclass(frozen=True, kw_only=True)
class Setup:
    """How a study is run.

    small        the form for trying and tests: seconds, and numbers that mean little
    command      what the user typed, for the report
    checkpoint   for studies of any checkpoint; None: the study has policies of its own
    observations gives those to measure on, under the keys of a policy's robot, and says where they are from
    policies     folders of toy policies that aren't shipped, by name (studies/rollouts.py)
    tell         is told of progress, a line at a time
    """

    small: bool = False
    command: str = "turbopi study"
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    checkpoint: Checkpoint | None = None
    observations: Callable[[UnifiedPolicy], tuple[list[dict[str, object]], str]] = _packaged
    policies: Mapping[str, Path] = field(default_factory=dict)
    simulator: str = "libero"  # of the studies in a simulator
    ways: Sequence[str] = ()  # which of their cells; none: all
    folder: Path | None = None  # where they keep episodes, so that they can go on; None: nowhere
    report_only: bool = False  # they report on the episodes that are there, and run none
    workers: int | None = None  # simulators, or processes with a policy each, at a time
    episodes: int | None = None  # of a cell; None: the form's own number
    steps: int = 10  # of denoising
    calls: int = 100
    seed: int = 0
    tell: Tell = _silent

    def each(self, work: Callable[[Tell, str, Path], Done], policies: Mapping[str, Path]) -> list[Done]:
        """`work`(tell, name, folder) for each policy, one after the other, or in as many processes as `workers` says.

        `work` is a function of a module, or a partial of one, so that another process can be given it.
        """
        if (self.workers or 1) == 1:
            return [work(self.tell, name, folder) for name, folder in policies.items()]
        with ProcessPoolExecutor(min(self.workers or 1, len(policies)), multiprocessing.get_context("spawn")) as pool:
            waiting = [pool.submit(work, tell_on_stderr, name, folder) for name, folder in policies.items()]
            return [future.result() for future in waiting]

    @contextmanager
    def kept_in(self) -> Iterator[Path]:
        """The folder of episodes; a temporary one if none was given."""
        if self.folder is not None:
            yield self.folder
            return
        with tempfile.TemporaryDirectory() as folder:
            yield Path(folder)

    @property
    def toy_policies(self) -> dict[str, Path]:
        """Folders by name: the one that ships, and those that were given."""
        return {"chase": shipped.CHASE_POLICY, **self.policies}

    @property
    def cell_episodes(self) -> int:
        if self.episodes is not None:
            return self.episodes
        return SMALL_EPISODES if self.small else FEWEST_EPISODES

    def needed_checkpoint(self, study: str) -> Checkpoint:
        """The checkpoint. Raises ConfigError if none was given."""
        if self.checkpoint is None:
            raise ConfigError(
                f"the {study} study needs weights: give a checkpoint's folder, or --random-weights PRESET "
                "(such as pi05_tiny)"
            )
        return self.checkpoint

    def report(self, study: "Study", **parts: object) -> Report:
        """A report of `study` with what every report says of how it was run."""
        return Report(
            study=study.name,
            question=study.question,
            claimed=study.claimed,
            small=self.small,
            command=self.command,
            provenance=provenance(self.device),
            **parts,  # type: ignore[arg-type]
        )


@dataclass(frozen=True)
class Study:
    """A question and what answers it. `claimed`: what an earlier project found. `episodes`: of a study in a simulator,
    runs the cells that were asked for, and reports nothing.
    """

    name: str
    question: str
    claimed: str
    run: Callable[[Setup], Report]
    needs_tensorrt: bool = False
    episodes: Callable[[Setup], None] | None = None

    def check(self, device: torch.device) -> None:
        """Raise BackendUnavailable where it can't run."""
        reason = backends.availability("tensorrt", device) if self.needs_tensorrt else None
        if reason is not None:
            raise BackendUnavailable(f"the {self.name} study needs TensorRT: {reason}")
