"""`turbopi demo`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.progress import Progress
from rich.table import Table

from turbopi.cli.files import check_report
from turbopi.cli.framework import CHECK_FAILED, JsonFlag, Output, command, new_console, plain
from turbopi.cli.options import CheckpointArgument, PolicyOptions
from turbopi.cli.timings import STAGES, timing_columns
from turbopi.support.errors import ConfigError
from turbopi.support.files import write_whole
from turbopi.support.installation import manual
from turbopi.support.text import significant

if TYPE_CHECKING:
    import numpy as np

    from turbopi.policy.shipped import Frame
    from turbopi.verify.demo import OracleCheck

NEXT = (
    "next, with your own: turbopi inspect CHECKPOINT, then turbopi infer CHECKPOINT OBSERVATION. From there to a robot "
    "that moves: "
)


@command(
    "demo",
    shared=PolicyOptions,
    examples=(
        "turbopi demo",
        "turbopi demo --episodes 10",
        "turbopi demo --real-time",
        "turbopi demo --backend pytorch_compile --steps 5 --report report",
        "turbopi demo checkpoints/pi05_libero --config pi05_libero",
        "turbopi demo --random-weights pi05_libero --frames 1",
    ),
)
def demo(
    options: PolicyOptions,
    checkpoint: CheckpointArgument = None,
    report: Annotated[
        Path, typer.Option("--report", metavar="DIR", help="Where images, actions and numbers are written.")
    ] = Path("turbopi-report"),
    frames: Annotated[
        int | None,
        typer.Option("--frames", min=1, metavar="N", help="Use only the first N frames.", show_default="all"),
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, metavar="N", help="Of the noise that actions start from.")] = 0,
    episodes: Annotated[
        int | None,
        typer.Option(
            "--episodes",
            min=0,
            max=1000,
            metavar="N",
            help="Let the policy act in LIBERO, too: N episodes.",
            show_default="3 if the simulator is installed",
        ),
    ] = None,
    real_time: Annotated[
        bool,
        typer.Option(
            "--real-time",
            help="Instead: a policy under delay in a dynamic task, joining its chunks and not.",
        ),
    ] = False,
    as_json: JsonFlag = False,
) -> None:
    """Run a policy on real LIBERO images, check it against the float32 reference, and let it act in the simulator.

    Without a checkpoint it is the small policy that comes with Turbo-Pi, trained on these tasks; its chunks are set
    against what the expert did that it learned from. Where the simulator is installed (in a clone: scripts/setup
    libero) it acts in a few episodes, with success, latency and videos at the end. The report folder gets demo.png,
    actions.npz, report.json and episodes/. Exit code 1: the check failed.

    With --real-time another small policy catches a runner, under a delay of four control steps: once each chunk simply
    takes over when it is there, once it continues the running one. real_time.png, commands.png, real_time.json.
    """
    if real_time:
        if episodes == 0:
            raise ConfigError("--real-time plays episodes, and --episodes is 0: give 1 or more, or leave it out")
        if frames is not None:
            raise ConfigError("--frames is for images of LIBERO, which --real-time doesn't show: leave it out")
        from turbopi.cli.demo_real_time import show_real_time

        output = Output(as_json)
        show_real_time(options, checkpoint, episodes, seed, report, output)
        output.line(NEXT + manual("tutorial"))
        return
    if episodes is not None and episodes > 20:
        raise ConfigError(f"--episodes is {episodes}; LIBERO's part of the demo plays 20 at most (turbopi eval libero)")
    if checkpoint is None and options.random_weights is None:
        from turbopi.policy.shipped import SMALL_POLICY

        checkpoint = str(SMALL_POLICY)
    # what can't be written, or played, is better known before the work
    check_report(report / "report.json", "frames", "a report of `turbopi demo`")
    if episodes:
        from turbopi.sim import create

        create("libero").check()
    output = Output(as_json)
    run = _Run(options, checkpoint, frames, seed, output)
    run.play(report / "episodes", episodes)
    run.report_to(report)
    output.line(NEXT + manual("tutorial"))
    if run.check.ok is False:
        raise typer.Exit(CHECK_FAILED)


class _Run:
    """One demo: the backend on every frame, then the oracle; prints as it goes."""

    def __init__(
        self, options: PolicyOptions, checkpoint: str | None, limit: int | None, seed: int, output: Output
    ) -> None:
        opened = options.open(checkpoint)
        from turbopi.policy.history import refuse_memory
        from turbopi.policy.policy import UnifiedPolicy
        from turbopi.policy.shipped import load_frames, observations, with_libero_stats
        from turbopi.verify.demo import check, num_oracle_runs, run_frames

        self.output, self.seed = output, seed
        self.frames: list[Frame] = load_frames()[:limit]
        options.tell_if_random(opened, output)
        opened = with_libero_stats(opened)
        policy = options.make_policy(opened, output)
        self.metadata = policy.metadata
        refuse_memory(self.metadata, "the demo")
        self.robot: str = self.metadata["robot"]
        output.line("Warming up …")
        output.line(f"warm-up: {policy.warmup():.2f} s")
        observed = observations(policy, self.frames)
        with _progress(output) as bar:
            task = bar.add_task("policy", total=len(observed))
            self.results = run_frames(policy, observed, seed, lambda: bar.advance(task))
        self._show_timings()
        self._show_chunk(self.results[0]["actions"])

        self._show_expert()

        del policy  # its weights make room for the oracle's
        arguments = options.policy_arguments() | {"backend": "pytorch", "precision": "f32"}
        oracle = UnifiedPolicy(opened, progress=output.shows_progress, **arguments)
        with _progress(output) as bar:
            task = bar.add_task("float32 reference and its control", total=num_oracle_runs(len(observed)))
            self.check: OracleCheck = check(
                [result["actions"] for result in self.results],
                oracle,
                observed,
                precision=self.metadata["precision"],
                seed=seed,
                tick=lambda: bar.advance(task),
            )
        self._show_check()
        self.policy_again = lambda: options.make_policy(opened, Output(True))
        self.played: dict[str, Any] | None = None

    def play(self, folder: Path, episodes: int | None) -> None:
        """In the simulator, if it is there and the policy is for it; says why not otherwise, if that was asked for."""
        from turbopi.cli.demo_episodes import play_episodes

        trained = self.robot == "libero" and not self.metadata["random_weights"]
        if episodes == 0 or (episodes is None and not trained):
            return
        self.played = play_episodes(self.policy_again, episodes, folder, self.output)

    def _show_expert(self) -> None:
        """How near the chunks are to the expert's, for a policy that should be."""
        from turbopi.verify.demo import expert_distance

        if self.robot != "libero" or self.metadata["random_weights"]:
            return
        title = "against what the expert did next: the first 5 actions, 1 = 0.05 m a step"
        table = Table(title=title, title_justify="left")
        for column in ("frame", "mean difference of translation", "expert's mean translation", "same gripper command"):
            table.add_column(column, justify="right")
        for number, (frame, result) in enumerate(zip(self.frames, self.results, strict=True)):
            if frame.expert is not None:
                found = expert_distance(result["actions"], frame.expert)
                table.add_row(str(number), f"{found.position:.2f}", f"{found.scale:.2f}", f"{found.gripper:.0%}")
        self.output.table(table)

    def _show_timings(self) -> None:
        for number, frame in enumerate(self.frames):
            self.output.line(f"frame {number}: {frame.prompt}")
        table = Table(title="milliseconds", title_justify="left")
        table.add_column("stage")
        for number in range(len(self.frames)):
            table.add_column(f"frame {number}", justify="right")
        for name, key in timing_columns(self.results[0]["policy_timing"]).items():
            table.add_row(name, *(f"{result['policy_timing'][key]:.1f}" for result in self.results))
        self.output.table(table)
        self.output.line(STAGES, "dim")

    def _show_chunk(self, actions: "np.ndarray") -> None:
        from turbopi.support.action_groups import action_groups

        steps, dims = actions.shape
        shown = min(steps, 10, max(3, (self.output.console.width - 42) // 9))
        cut = f"; the first {shown} of them" if shown < steps else ""
        title = f"frame 0: the next {steps} actions, {dims} numbers each{cut}"
        table = Table(title=title, title_justify="left")
        for heading in ("action", "unit"):
            table.add_column(heading)
        for step in range(shown):
            table.add_column(str(step), justify="right")
        for group in action_groups(self.robot, dims):
            table.add_section()
            for index in group.names:
                table.add_row(group.label(index), group.unit, *(f"{value:+.3f}" for value in actions[:shown, index]))
        self.output.table(table)

    def _show_check(self) -> None:
        check, of_all = self.check, self.check.all_frames
        table = Table(title="against the float32 reference, same noise", title_justify="left")
        for column in ("frame", "largest error", "rms error", "its bound", ""):
            table.add_column(column, justify="left" if column == "" else "right")
        for number, difference in enumerate(check.differences):
            table.add_row(str(number), significant(difference.max), significant(difference.rms))
        table.add_section()
        verdict = "" if check.ok is None else "[green]ok[/]" if check.ok else "[bold red]FAIL[/]"
        table.add_row("all", *map(significant, (of_all.max, of_all.rms, check.bound)), verdict)
        self.output.table(table)
        precision = self.metadata["precision"]
        step = "half a bfloat16 step" if precision == "bf16" else "half a float32 step (scaled from bfloat16's)"
        self.output.line(
            "Errors are in units of the model's normalised actions. "
            f"The bound is {check.factor:g} times the control, {significant(check.control)}: how far the reference "
            f"itself moves when every weight moves by up to {step}.",
            "dim",
        )
        backend = self.metadata["backend"]
        error, bound = significant(of_all.rms), significant(check.bound)
        if check.ok is None:
            self.output.line(
                "Nothing was judged: the reference's own actions don't change with its weights. Where a model writes "
                "tokens, zeros stand in for an answer that can't be read: take its robot's own observations, with "
                "turbopi infer.",
                "yellow",
            )
        elif check.ok:
            self.output.line(
                f"OK: {backend} {precision} is within {error} of the reference (bound {bound}).", "bold green"
            )
        else:
            self.output.line(
                f"FAIL: {backend} {precision} is {error} from the reference, beyond its bound "
                f"{bound}: this is more than rounding.",
                "bold red",
            )

    def report_to(self, folder: Path) -> None:
        """Write demo.png, actions.npz and report.json."""
        import numpy as np

        folder.mkdir(parents=True, exist_ok=True)
        actions = np.stack([result["actions"] for result in self.results])
        oracle = self.check.oracle_actions
        write_whole(folder / "actions.npz", lambda stream: np.savez(stream, actions=actions, oracle_actions=oracle))
        document = self._document()
        text = json.dumps(plain(document), indent=1, ensure_ascii=False)
        write_whole(folder / "report.json", text + "\n")
        self._plot(folder / "demo.png")
        self.output.line(f"written to {folder}: demo.png, actions.npz, report.json")
        self.output.document(document)

    def _document(self) -> dict[str, Any]:
        return {
            "ok": self.check.ok,
            "random_weights": self.metadata["random_weights"],
            "check": self.check.as_json(),
            "seed": self.seed,
            "frames": [
                {"prompt": frame.prompt, "timing": result["policy_timing"], "actions": result["actions"]}
                for frame, result in zip(self.frames, self.results, strict=True)
            ],
            "policy": self.metadata,
            "episodes": self.played,
        }

    def _plot(self, file: Path) -> None:
        from turbopi.support.plots import Row, plot_chunks

        rows = [
            Row(
                heading=f"“{frame.prompt}”    {result['policy_timing']['total_ms']:.0f} ms, "
                f"rms error {significant(difference.rms)}",
                camera_images={"base camera": frame.base, "wrist camera": frame.wrist},
                actions=result["actions"],
                oracle=truth,
                expert=frame.expert if self.robot == "libero" and not self.metadata["random_weights"] else None,
            )
            for frame, result, truth, difference in zip(
                self.frames, self.results, self.check.oracle_actions, self.check.differences, strict=True
            )
        ]
        about = self.metadata
        title = f"turbopi demo: {about['config']}, {about['backend']} {about['precision']} on {about['device_name']}"
        plot_chunks(file, rows, robot=self.robot, title=title, random_weights=about["random_weights"])


def _progress(output: Output) -> Progress:
    return Progress(console=new_console(stderr=True), disable=not output.shows_progress, transient=True)
