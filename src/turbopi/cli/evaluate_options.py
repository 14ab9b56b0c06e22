"""The options of `turbopi eval`: which policy, which episodes, and how they are run."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from turbopi.cli.files import let_import_from_here
from turbopi.cli.framework import Output
from turbopi.cli.options import COMMON, PolicyOptions
from turbopi.support.errors import ConfigError

if TYPE_CHECKING:
    from collections.abc import Callable

    from turbopi.checkpoint import Checkpoint
    from turbopi.evaluate.delays import Cell
    from turbopi.evaluate.plan import Job, Protocol, VideoPlan
    from turbopi.evaluate.sources import PolicySource
    from turbopi.sim import Simulator

_EPISODES, _PROTOCOL, _RUNS, _OUTPUT = "Which episodes", "Protocol (openpi's unless given)", "How fast", "Output"
_DELAY = "Under delay"
COMMON_EVAL = (  # what --help shows without --help-all
    *("--suite", "--tasks", "--trials", "--initial-states", "--replan", "--execution", "--delay-steps", "--workers"),
    *("--videos", "--out", "--restart", *COMMON),
)


def _option(*names: str, panel: str, help: str, metavar: str | None = None, **more: Any) -> Any:
    return typer.Option(*names, metavar=metavar, help=help, rich_help_panel=panel, **more)


@dataclass(frozen=True)
class EvalOptions(PolicyOptions):
    """Which policy, which episodes, and how they are run."""

    suite: Annotated[
        str | None,
        _option("--suite", panel=_EPISODES, metavar="NAME", help="libero: spatial (default), object, goal, 10 or 90."),
    ] = None
    tasks: Annotated[
        str | None, _option("--tasks", panel=_EPISODES, metavar="N,N-N", help="Indices of tasks; all unless given.")
    ] = None
    initial_states: Annotated[
        str | None,
        _option(
            "--initial-states", panel=_EPISODES, metavar="N,N-N", help="Of each task; all unless given (LIBERO: 0-49)."
        ),
    ] = None
    trials: Annotated[
        int | None,
        _option("--trials", panel=_EPISODES, metavar="N", help="Only the first N of a task's initial states.", min=1),
    ] = None
    seed: Annotated[int, _option("--seed", panel=_PROTOCOL, metavar="N", help="Of environments and noise.", min=0)] = 7
    seeding: Annotated[
        str,
        _option(
            "--seeding",
            panel=_PROTOCOL,
            metavar="episode|task",
            help="Seed the environment before every episode, or once for each task as openpi does.",
        ),
    ] = "episode"
    replan: Annotated[
        int,
        _option("--replan", panel=_PROTOCOL, metavar="N", help="Actions carried out before the next inference."),
    ] = 5
    execution: Annotated[
        str,
        _option(
            "--execution",
            panel=_DELAY,
            metavar="WAY,WAY,…",
            help="How chunks join: sync, async, ensemble, rtc, rtc_identity, rtc_trained, warm_start, paint.",
        ),
    ] = "sync"
    delay_steps: Annotated[
        str | None,
        _option(
            "--delay-steps",
            panel=_DELAY,
            metavar="N,N,…",
            help="Control steps from an observation to the chunk computed from it: simulated, exact, repeatable. "
            "0 unless given.",
        ),
    ] = None
    real_time: Annotated[
        bool,
        _option(
            "--real-time",
            panel=_DELAY,
            help="The world advances with the wall clock, whatever the policy does; delays are measured.",
        ),
    ] = False
    control_hz: Annotated[
        float | None,
        _option(
            "--control-hz",
            panel=_DELAY,
            metavar="HZ",
            help="Of --real-time: control steps a second; the simulator's own rate unless given. Less is slow motion.",
        ),
    ] = None
    execution_horizon: Annotated[
        str | None,
        _option("--execution-horizon", panel=_DELAY, metavar="N,N,…", help="As --replan; several are run in turn."),
    ] = None
    max_steps: Annotated[
        int | None,
        _option("--max-steps", panel=_PROTOCOL, metavar="N", help="Limit of an episode; the suite's own unless given."),
    ] = None
    wait_steps: Annotated[
        int, _option("--wait-steps", panel=_PROTOCOL, metavar="N", help="Steps of standing still at the beginning.")
    ] = 10
    camera_px: Annotated[
        int, _option("--camera-px", panel=_PROTOCOL, metavar="N", help="Width and height that cameras are drawn at.")
    ] = 256
    image_px: Annotated[
        int, _option("--image-px", panel=_PROTOCOL, metavar="N", help="Width and height that the policy is sent.")
    ] = 224
    workers: Annotated[
        int | None,
        _option(
            "--workers", panel=_RUNS, metavar="N", help="Simulator processes; half of the CPUs unless given.", min=1
        ),
    ] = None
    max_batch: Annotated[
        int | None,
        _option(
            "--max-batch",
            panel=_RUNS,
            metavar="N",
            help="Requests that are computed together, at most. Unless given: as many as workers; of `turbopi compare` "
            "1. With 1, a run repeats bit for bit.",
            min=1,
        ),
    ] = None
    videos: Annotated[
        str,
        _option("--videos", panel=_OUTPUT, metavar="sample|all|none", help="sample: all failures and some successes."),
    ] = "sample"
    video_successes: Annotated[
        int,
        _option(
            "--video-successes",
            panel=_OUTPUT,
            metavar="N",
            help="Of sample: successes from a task's first N initial states.",
        ),
    ] = 1
    smooth_videos: Annotated[
        bool,
        _option(
            "--smooth-videos", panel=_OUTPUT, help="Film every control step, not only where the policy looks: slower."
        ),
    ] = False
    out: Annotated[
        Path | None,
        _option("--out", panel=_OUTPUT, metavar="DIR", help="Where results go; an interrupted run there continues."),
    ] = None
    restart: Annotated[
        bool, _option("--restart", panel=_OUTPUT, help="Delete an earlier run's results in that folder.")
    ] = False
    record: Annotated[
        Path | None,
        _option(
            "--record",
            panel=_OUTPUT,
            metavar="DIR",
            help="Keep what the policy sees, in a new folder there: for `turbopi calibrate` and `turbopi verify`.",
        ),
    ] = None

    def simulator(self, name: str, output: Output) -> "Simulator":
        """Checked, with its warnings printed."""
        from turbopi.sim import create
        from turbopi.sim.base import faults_named

        if ":" in name:
            let_import_from_here()
        simulator = create(name)
        with faults_named(simulator, "check()"):
            warnings = list(simulator.check())
        for warning in warnings:
            output.line(f"warning: {warning}", "yellow")
        return simulator

    def protocol(self, simulator: "Simulator", name: str) -> "Protocol":
        from turbopi.evaluate.plan import Protocol
        from turbopi.sim import SimSettings
        from turbopi.sim.base import full_suite_name

        suite = simulator.suites[0] if self.suite is None else full_suite_name(simulator, self.suite)
        settings = SimSettings(self.seed, self.seeding, self.wait_steps, self.camera_px)  # type: ignore[arg-type]
        own = simulator.control_hz if self.control_hz is None else self.control_hz
        hz = own if self.real_time else None
        return Protocol(name, suite, settings, self.replan, self.image_px, self.max_steps, control_hz=hz)

    def cells(self) -> "list[Cell]":
        """The ways to run, delays and execution horizons that are asked for, in all combinations."""
        from turbopi.evaluate.delays import make_cells
        from turbopi.evaluate.plan import parse_numbers

        if self.execution_horizon is None:
            horizons = [self.replan]
        elif self.replan != type(self).replan:
            raise ConfigError("--replan and --execution-horizon say the same; give one of them")
        else:
            horizons = parse_numbers("--execution-horizon", self.execution_horizon)
        ways = [name.strip() for name in self.execution.split(",")]
        if self.real_time:
            return make_cells(ways, [None], horizons)
        delays = [0] if self.delay_steps is None else parse_numbers("--delay-steps", self.delay_steps)
        return make_cells(ways, delays, horizons)

    def of_delay(self) -> list[str]:
        """The options under "Under delay" that are given."""
        names = ("execution", "delay_steps", "execution_horizon", "real_time", "control_hz")
        return [f"--{name.replace('_', '-')}" for name in names if getattr(self, name) != getattr(type(self), name)]

    def check_real_time(self) -> None:
        """Raise ConfigError for options that contradict --real-time, or need it."""
        if not self.real_time:
            if self.control_hz is not None:
                raise ConfigError("--control-hz is the rate of --real-time: give that, too, or leave it out")
            return
        if self.delay_steps is not None:
            raise ConfigError(
                f"--real-time measures the delay, and --delay-steps {self.delay_steps} simulates it: give one of them"
            )
        if self.workers is not None and self.workers > 1:
            raise ConfigError(
                f"--real-time runs one episode at a time, as those of --workers {self.workers} would wait for each "
                "other's calls of the policy: leave it out"
            )
        if self.smooth_videos:
            raise ConfigError(
                "--smooth-videos draws at every control step, for which the wall clock of --real-time doesn't wait: "
                "leave one of them out"
            )

    def video_plan(self) -> "VideoPlan":
        from turbopi.evaluate.plan import VideoPlan

        return VideoPlan(self.videos, self.video_successes, self.smooth_videos)  # type: ignore[arg-type]

    def jobs(self, simulator: "Simulator", suite: str) -> "list[Job]":
        from turbopi.evaluate.plan import choose_tasks, make_jobs, parse_numbers

        wanted = None if self.tasks is None else parse_numbers("--tasks", self.tasks)
        states = None if self.initial_states is None else parse_numbers("--initial-states", self.initial_states)
        return make_jobs(choose_tasks(simulator, suite, wanted), states, self.trials, self.video_plan())

    def local_policy(
        self, checkpoint: str | None, output: Output, check: "Callable[[Checkpoint], None]" = lambda opened: None
    ) -> "PolicySource":
        """The policy in this process, warmed up. `check` is called before its weights are loaded."""
        from turbopi.evaluate.sources import LocalPolicy
        from turbopi.policy.shipped import with_libero_stats

        opened = with_libero_stats(self.open(checkpoint))
        check(opened)
        self.tell_if_random(opened, output)
        policy = self.make_policy(opened, output)
        policy.warmup()
        return LocalPolicy(policy, opened.fingerprint(trust_files=True))
