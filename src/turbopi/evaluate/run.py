"""One evaluation from start to finish: continue what is there, run the rest, write what came out."""

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path

import torch

from turbopi.evaluate.plan import Job, Protocol, VideoPlan
from turbopi.evaluate.reading import check_is_run, load_results
from turbopi.evaluate.report import FILE as REPORT
from turbopi.evaluate.report import write_report
from turbopi.evaluate.results import FILE, OWN_HZ, Episode, PolicyDescription, Results, protocol_json
from turbopi.evaluate.schedule import OnAnswer, Scheduler
from turbopi.evaluate.sources import PolicySource
from turbopi.evaluate.video import check_can_write
from turbopi.evaluate.worker import WorkerSetup
from turbopi.evaluate.workers import LOG
from turbopi.sim import Simulator
from turbopi.sim.base import faults_named
from turbopi.support.errors import ConfigError
from turbopi.support.files import alone_in
from turbopi.support.provenance import provenance
from turbopi.support.reading import plain_document

# Is told of every episode as it ends, with the results so far
OnEpisode = Callable[[Episode, Results], None]


def default_workers() -> int:
    """Half of the CPUs: the policy and the renderers need the others."""
    return max(1, min(16, (os.cpu_count() or 2) // 2))


def prepare(
    folder: Path, protocol: Protocol, source: PolicySource, simulator: Simulator, jobs: Sequence[Job], *, restart: bool
) -> Results:
    """Results for these jobs, with the episodes that the folder holds already unless `restart`: then `evaluate` removes
    them, once it can begin.

    Raises ConfigError if those were run in another way or by another policy, if it is no evaluation that the folder
    holds, or if another process evaluates into it.
    """
    if folder.is_dir():
        with _alone(folder):  # `evaluate` needs to be; who can't be should know before it is prepared
            pass
    policy = PolicyDescription(source.label, source.identity, source.about)
    with faults_named(simulator, "versions()"):
        own = simulator.versions()
    versions = {"simulator": own, **plain_document(provenance(torch.device("cpu")))}
    results = Results(folder, protocol_json(protocol), policy, [job.task for job in jobs], versions, {})
    if restart:
        check_is_run(folder)
        results.replaces = True
    elif (folder / FILE).exists():
        results.continue_from(load_results(folder))
    results.planned |= {job.key for job in jobs}
    return results


def pending(results: Results, jobs: Sequence[Job]) -> list[Job]:
    """Jobs without a verdict; crashed ones are tried again."""
    return [job for job in jobs if job.key not in results.episodes or not results.episodes[job.key].judged]


def most_at_once(protocol: Protocol, jobs: Sequence[Job]) -> int:
    """How many of these episodes can run at a time: where tasks are seeded, one of each task. At least 1."""
    return max(1, len({job.task.index for job in jobs}) if protocol.sim.seeding == "task" else len(jobs))


def evaluate(
    results: Results,
    protocol: Protocol,
    source: PolicySource,
    simulator: Simulator,
    jobs: Sequence[Job],
    *,
    num_workers: int,
    max_batch: int,
    videos: VideoPlan,
    on_episode: OnEpisode = lambda episode, results: None,
    on_answer: OnAnswer | None = None,
) -> Results:
    """Run the jobs that have no verdict yet; add them to `results`, in whose folder everything is written.

    Whatever ends it, Ctrl-C or a lost server, results.json and report.html then hold what was finished. Raises
    ConfigError while another process evaluates into that folder.
    """
    if videos.which != "none":
        check_can_write()

    def ended(episode: Episode, job: Job) -> None:
        results.add(episode)
        on_episode(episode, results)

    setup = WorkerSetup(
        protocol.simulator,
        protocol.suite,
        protocol.sim,
        protocol.replan,
        protocol.max_steps,
        videos.smooth,
        str(results.folder),
        protocol.execution,
        protocol.delay,
        protocol.control_hz,
        dict(source.real_time),
    )
    scheduler = Scheduler(
        protocol,
        setup,
        source,
        simulator,
        num_workers=num_workers,
        max_batch=max_batch,
        on_episode=ended,
        on_answer=on_answer,
    )
    with _alone(results.folder):
        if results.replaces:
            _clear(results.folder)
        elif (results.folder / FILE).exists():  # another process may have added to it since `prepare`
            results.continue_from(load_results(results.folder))
        results.options = {"workers": num_workers, "max_batch": max_batch, "videos": asdict(videos)}
        if protocol.control_hz is not None:
            results.options = {**results.options, OWN_HZ: simulator.control_hz}
        start = time.monotonic()
        try:
            scheduler.run(pending(results, jobs))
        finally:
            results.wall_seconds += time.monotonic() - start
            results.save()
            write_report(results)
    return results


def _alone(folder: Path) -> AbstractContextManager[None]:
    return alone_in(folder, "another evaluation", ConfigError)


def _clear(folder: Path) -> None:
    """Remove what an earlier run wrote, and nothing else."""
    for name in (FILE, LOG, REPORT, "success.png", "steps.png", "latency.png", "visited.npz"):
        with contextlib.suppress(FileNotFoundError):
            (folder / name).unlink()
    for on_frame in (folder / "videos").glob("task*_state*_*.mp4"):
        on_frame.unlink()
    with contextlib.suppress(OSError):
        (folder / "videos").rmdir()
