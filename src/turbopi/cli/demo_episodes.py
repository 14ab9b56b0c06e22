"""The part of `turbopi demo` in which the policy acts: a few episodes of LIBERO, filmed."""

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from turbopi.cli.framework import Output
from turbopi.support.reading import plain_document
from turbopi.support.text import counted

if TYPE_CHECKING:
    from turbopi.evaluate.results import Episode, Results
    from turbopi.policy.policy import UnifiedPolicy

SUITE = "libero_spatial"
TASKS = tuple(range(10))  # in the order in which they are taken
FIRST_STATE = 30  # of LIBERO's initial states: the small policy was trained on 0 to 24
DEFAULT = 3


def play_episodes(
    make_policy: "Callable[[], UnifiedPolicy]", wanted: int | None, folder: Path, output: Output
) -> dict[str, object] | None:
    """Play and tell; returns the results' summary. `wanted` None: DEFAULT, or nothing where LIBERO isn't installed.

    Raises SimulatorUnavailable if episodes were asked for and can't be played.
    """
    from turbopi.evaluate.plan import Protocol, VideoPlan, choose_tasks, make_jobs
    from turbopi.evaluate.run import evaluate, prepare
    from turbopi.evaluate.sources import LocalPolicy
    from turbopi.sim import SimulatorUnavailable, create

    simulator = create("libero")
    try:
        simulator.check()
    except SimulatorUnavailable as error:
        if wanted is not None:
            raise
        output.line(f"The policy didn't act in the simulator: {error}", "dim")
        return None
    count = DEFAULT if wanted is None else wanted
    protocol, plan = Protocol("libero", SUITE), VideoPlan("all")
    jobs = [
        job
        for round_ in range(-(-count // len(TASKS)))
        for task in TASKS[: min(len(TASKS), count - round_ * len(TASKS))]
        for job in make_jobs(choose_tasks(simulator, SUITE, [task]), [FIRST_STATE + round_], None, plan)
    ]
    policy = make_policy()
    policy.warmup()
    source = LocalPolicy(policy)
    results = prepare(folder, protocol, source, simulator, jobs, restart=True)
    output.line(f"{len(jobs)} episodes of {SUITE}, from initial states that the small policy never saw:")

    def reported(episode: "Episode", results: "Results") -> None:
        task = results.tasks[episode.task].instruction
        output.line(f"  {task}: {episode.status} after {counted(episode.steps, 'step')} ({episode.seconds:.0f} s)")

    evaluate(results, protocol, source, simulator, jobs, num_workers=1, max_batch=1, videos=plan, on_episode=reported)
    summary = results.summary()
    success, call = summary.success, summary.call_ms
    took = f"; a chunk took {call.p50:.0f} ms (95 %: {call.p95:.0f} ms)" if call else ""
    output.line(
        f"{success.successes} of {success.trials} episodes solved{took}; videos in {folder / 'videos'}",
        "bold",
    )
    return {"folder": str(folder), **plain_document(summary)}
