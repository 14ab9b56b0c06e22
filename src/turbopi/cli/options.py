"""Options that several commands share: which weights, and how to run them."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from turbopi.cli.files import let_import_from_here
from turbopi.cli.framework import Output
from turbopi.cli.process import interrupts_end_at_once, slow_import_reported
from turbopi.cli.typed import as_typed
from turbopi.config import PRESETS, typed_grid
from turbopi.support.errors import ConfigError
from turbopi.support.text import data_size, denoising

if TYPE_CHECKING:
    from turbopi.checkpoint import Checkpoint
    from turbopi.policy.policy import UnifiedPolicy

MOST_CALLS, MOST_OBSERVATIONS, MOST_NOISES = 1_000_000, 100_000, 1000  # more is a slip, and would never end
SHOW_LOADING_BYTES = 1e9  # smaller weights load before a line about it is read

_WEIGHTS, _RUNNING = "Weights", "How to run them"
COMMON = (  # of these options, what --help shows without --help-all
    *("--random-weights", "--config", "--robot"),
    *("--backend", "--precision", "--quantization", "--steps"),
)
CHECKPOINT_HELP = "A checkpoint's folder: openpi's (PyTorch or JAX), LeRobot's, or an ONNX export."

CheckpointArgument = Annotated[
    str | None, typer.Argument(metavar="CHECKPOINT", help=CHECKPOINT_HELP, show_default=False)
]

# FP8 of engines and graphs (`build`, `export`)
EngineCalibration = Annotated[
    Path | None,
    typer.Option(
        metavar="PATH",
        help="For fp8: an observation or a recording (as for `turbopi infer`), or the file of `turbopi calibrate`. "
        "Unless given, the LIBERO images that come with Turbo-Pi.",
    ),
]
ScaleMethod = Annotated[
    str, typer.Option(metavar="modelopt|max", help="Who measures the scales: NVIDIA's ModelOpt, or Turbo-Pi (max).")
]


def _option(*names: str, panel: str, metavar: str, help: str) -> Any:
    return typer.Option(*names, metavar=metavar, help=help, rich_help_panel=panel)


SolverOption = Annotated[
    str | None,
    _option(
        "--solver",
        panel=_RUNNING,
        metavar="NAME",
        help="Solver of the flow from noise to actions: euler, midpoint, heun, ab2 or exponential. --steps counts "
        "evaluations of the model. Unless given: what the checkpoint says, else euler.",
    ),
]
TimeGridOption = Annotated[
    str | None,
    _option(
        "--time-grid",
        panel=_RUNNING,
        metavar="NAME|T,T,…",
        help="Times of the steps: uniform, shifted_to_noise, shifted_to_actions, or numbers that fall strictly from 1 "
        "to 0. Unless given: what the checkpoint says, else uniform.",
    ),
]
GuidanceOption = Annotated[
    float | None,
    _option(
        "--guidance",
        panel=_RUNNING,
        metavar="SCALE",
        help="Classifier-free guidance towards --guidance-tag. 1 unless given: the prompt with the tag alone. 0: the "
        "prompt alone. Any other number takes both prompts.",
    ),
]
GuidanceTagOption = Annotated[
    str | None,
    _option(
        "--guidance-tag",
        panel=_RUNNING,
        metavar="TEXT",
        help="What training put behind the prompts of good data, such as 'Advantage: positive' (RECAP).",
    ),
]
# UnifiedPolicy's arguments of how noise becomes actions
FLOW = ("num_denoising_steps", "solver", "time_grid", "guidance", "guidance_tag")


@dataclass(frozen=True)
class WeightOptions:
    """Which weights: those of a CHECKPOINT argument, or random ones."""

    random_weights: Annotated[
        str | None,
        _option(
            "--random-weights",
            panel=_WEIGHTS,
            metavar="PRESET",
            help=f"Random weights instead of a checkpoint: {', '.join(PRESETS)} or smolvla_base. Their actions mean "
            "nothing.",
        ),
    ] = None
    weights_seed: Annotated[
        int | None,
        _option("--weights-seed", panel=_WEIGHTS, metavar="N", help="Seed of the random weights; 0 unless given."),
    ] = None
    config: Annotated[
        str | None,
        _option(
            "--config",
            panel=_WEIGHTS,
            metavar="PRESET|FILE",
            help="What the checkpoint doesn't record (robot, horizon, …): a preset's name or a .json. Unless given, "
            "the turbopi.json beside the weights, or LeRobot's own files. Random weights keep their preset's sizes.",
        ),
    ] = None

    def open(self, checkpoint: str | None) -> "Checkpoint":
        """The checkpoint that the user means. Raises ConfigError unless exactly one is named."""
        self.check(checkpoint)
        config = "auto" if self.config is None else self.config
        with interrupts_end_at_once():
            with slow_import_reported():
                from turbopi.checkpoint import open_checkpoint, random_checkpoint

            if self.random_weights is not None:
                return random_checkpoint(self.random_weights, self.weights_seed or 0, config)
            assert checkpoint is not None
            return open_checkpoint(checkpoint, config)

    def split(self, command: str, paths: Sequence[str], other: str) -> tuple[str | None, str]:
        """`[CHECKPOINT] OTHER` as it was typed: the checkpoint, if there should be one, and the other path."""
        if self.random_weights is not None and len(paths) == 1:
            return None, paths[0]
        if len(paths) == 2:
            self.check(paths[0])
            if Path(paths[0]).is_file() and Path(paths[1]).is_dir():
                raise ConfigError(f"{paths[0]} is a file, but the checkpoint's folder comes first: is it {paths[1]}?")
            return paths[0], paths[1]
        wanted = (
            f"one path, the {other} (the weights are random)"
            if self.random_weights is not None
            else f"two paths, the checkpoint and the {other} (or --random-weights PRESET and the {other} alone)"
        )
        raise ConfigError(f"{command} takes {wanted}, but got {len(paths)}: {' '.join(paths)}")

    def check(self, checkpoint: str | None) -> None:
        """Raise ConfigError for options that contradict each other."""
        if checkpoint is None and self.random_weights is None:
            raise ConfigError(
                "no weights: give a checkpoint's folder, or --random-weights PRESET (such as pi05_tiny) to do without"
            )
        if checkpoint is not None and self.random_weights is not None:
            raise ConfigError(
                f"two kinds of weights: the checkpoint {checkpoint!r} and --random-weights {self.random_weights}; "
                "give one of them"
            )
        if self.random_weights is None and self.weights_seed is not None:
            raise ConfigError("--weights-seed is the seed of --random-weights, which wasn't given")

    def tell_if_random(self, checkpoint: "Checkpoint", output: Output) -> None:
        if checkpoint.random is not None:
            which = f"{self.random_weights}, " if self.random_weights is not None else ""
            output.line(f"RANDOM WEIGHTS ({which}{checkpoint.random}): the actions mean nothing.", "bold yellow")
            from turbopi.checkpoint.source import mark_random_reported

            mark_random_reported(checkpoint.source)


@dataclass(frozen=True)
class RobotOptions(WeightOptions):
    """Which weights, and for which robot."""

    robot: Annotated[
        str | None,
        _option(
            "--robot",
            panel=_WEIGHTS,
            metavar="NAME|FILE|CLASS",
            help="Instead of the configuration's robot: a built-in one, a type of LeRobot's (so101_follower), a "
            "description (.json), or your own class as module:Class, whose code is run.",
        ),
    ] = None

    def make_robot(self) -> Any:
        """What UnifiedPolicy takes as `robot`; "module:Class" runs that module's code, as was asked for."""
        if self.robot is None or ":" not in self.robot:
            return self.robot
        from turbopi.robots import import_robot

        let_import_from_here()
        return import_robot(self.robot)


def own_precision(names: Sequence[str]) -> str:
    """bf16, unless none of the backends runs in it: then the first one's first. "auto" and unknown ones run in bf16."""
    from turbopi import backends

    known = backends.BACKENDS if set(names) <= {"auto", *backends.BACKENDS} else backends.known()
    own = [backends.precisions(name) if name in known else ("bf16",) for name in names]
    return "bf16" if not own or any("bf16" in one for one in own) else own[0][0]


@dataclass(frozen=True)
class PolicyOptions(RobotOptions):
    """Which weights, and everything else that UnifiedPolicy is made of."""

    backend: Annotated[
        str, _option("--backend", panel=_RUNNING, metavar="NAME", help="One that `turbopi doctor` lists, or auto.")
    ] = "auto"
    precision: Annotated[
        str | None,
        _option(
            "--precision",
            panel=_RUNNING,
            metavar="NAME",
            help="bf16 as openpi serves it, f32, int8-weights (Pi0-FAST), or calibrated: fp8, fp8-mlp, fp8-f16sums, "
            "int8, nvfp4. Unless given, the folder's own, else bf16, or what --backend has instead.",
        ),
    ] = None
    quantization: Annotated[
        str | None,
        _option(
            "--quantization",
            panel=_RUNNING,
            metavar="FILE",
            help="What `turbopi calibrate` wrote. Unless given: turbopi_fp8.json and the like beside the weights.",
        ),
    ] = None
    fp8_parts: Annotated[
        str | None,
        _option(
            "--fp8-parts",
            panel=_RUNNING,
            metavar="PART,PART",
            help="Calibrated in these parts alone: vision, prefix, expert. Unless given, all that calibration allows.",
        ),
    ] = None
    steps: Annotated[
        int | None,
        _option(
            "--steps",
            panel=_RUNNING,
            metavar="N",
            help="Denoising steps of an inference. Unless given: what the checkpoint says, else 10.",
        ),
    ] = None
    solver: SolverOption = None
    time_grid: TimeGridOption = None
    guidance: GuidanceOption = None
    guidance_tag: GuidanceTagOption = None
    device: Annotated[
        str,
        _option("--device", panel=_RUNNING, metavar="DEVICE", help="cpu, cuda, cuda:N, or auto: the GPU if any."),
    ] = "auto"
    tokenizer: Annotated[
        str | None,
        _option(
            "--tokenizer",
            panel=_RUNNING,
            metavar="FILE",
            help="SentencePiece model. Unless given: the checkpoint folder's, or openpi's cached one; for random "
            "weights Turbo-Pi's own small one.",
        ),
    ] = None
    default_prompt: Annotated[
        str | None,
        _option("--default-prompt", panel=_RUNNING, metavar="TEXT", help="Instruction for observations without one."),
    ] = None

    @property
    def flow_arguments(self) -> tuple[Any, ...]:
        """Values of FLOW."""
        return self.steps, self.solver, typed_grid(self.time_grid), self.guidance, self.guidance_tag

    def policy_arguments(self) -> dict[str, Any]:
        """UnifiedPolicy's arguments besides the checkpoint."""
        return {
            "backend": self.backend,
            "precision": self.precision_of(self.backend),
            "quantization": self._quantization(),
            **dict(zip(FLOW, self.flow_arguments, strict=True)),
            "device": self.device,
            "tokenizer": self.tokenizer,
            "default_prompt": self.default_prompt,
            "robot": self.make_robot(),
        }

    def for_checkpoint(self, checkpoint: "Checkpoint") -> "PolicyOptions":
        """The same; for an ONNX export what is left to choose is the one backend that runs it, and its device; for
        weights in eight bits their precision.
        """
        from turbopi.checkpoint.quantized_folder import precision_kept

        if self.precision is None and (kept := precision_kept(checkpoint)) is not None:
            return replace(self, precision=kept)
        if checkpoint.format != "onnx":
            return self
        backend = "onnx" if self.backend == "auto" else self.backend
        return replace(self, backend=backend, device="cpu" if self.device == "auto" else self.device)

    def precision_of(self, backend: str) -> str:
        """The precision that is asked for, or else bf16, or if the backend has none the first that it has."""
        return own_precision([backend]) if self.precision is None else self.precision

    def make_policy(self, checkpoint: "Checkpoint", output: Output, *, strict: bool = False) -> "UnifiedPolicy":
        """The policy, with what it is printed. `strict` as UnifiedPolicy's."""
        with interrupts_end_at_once():
            from turbopi.policy.policy import UnifiedPolicy

            if checkpoint.stored_bytes > SHOW_LOADING_BYTES:
                output.line(
                    f"Loading {checkpoint.stored_bytes / 1e9:.1f} GB of weights ({checkpoint.format}) from "
                    f"{checkpoint.path}: the disk decides how long this takes, minutes on a slow one …"
                )
            fitting = self.for_checkpoint(checkpoint)
            policy = UnifiedPolicy(
                checkpoint, progress=output.shows_progress, strict=strict, **fitting.policy_arguments()
            )
        about = policy.metadata["backend_details"] | policy.metadata
        if fitting.backend != self.backend:
            about["backend_reason"] = "auto: the folder holds ONNX graphs"
        loaded = ""  # a backend of another package may load no weights
        if "weight_bytes" in about:
            loaded = f"; weights: {data_size(about['weight_bytes'])} in {about['load_seconds']:.1f} s"
        output.line(
            f"{about['config']} for {about['robot']}, {about['precision']} on {about['device']} "
            f"({about['device_name']}), {denoising(about)}{loaded}"
        )
        if self.precision is None and about["precision"] != "bf16":
            kept = fitting.precision is not None
            why = "which the folder's weights are in" if kept else f"as {about['backend']} doesn't run in bf16"
            output.line(f"precision: {about['precision']}, {why}")
        output.line(f"backend: {about['backend']} ({as_typed(about['backend_reason'])})")
        if about.get("kept"):
            output.line(f"its ONNX export stays for the next start: {about['export']}")
        return policy

    def _quantization(self) -> Any:
        """What UnifiedPolicy takes as `quantization`."""
        if self.fp8_parts is None:
            return self.quantization
        if self.quantization is None:
            raise ConfigError("--fp8-parts narrows a calibration: name it with --quantization FILE")
        from turbopi.quantization.calibration_file import Quantization

        return Quantization.load(self.quantization).only([part.strip() for part in self.fp8_parts.split(",")])


@dataclass(frozen=True)
class ActingOptions(PolicyOptions):
    """The same, of commands whose actions a robot may carry out."""

    out_of_range: Annotated[
        str,
        _option(
            "--out-of-range",
            panel=_RUNNING,
            metavar="warn|refuse|clip",
            help="Actions far outside the checkpoint's training range: sent with a note, refused, or clipped, which "
            "the answer says. These are no limits of your robot: docs/safety.md.",
        ),
    ] = "warn"
    known_cameras: Annotated[
        Path | None,
        _option(
            "--known-cameras",
            panel=_RUNNING,
            metavar="FILE",
            help="The cameras.npz that `turbopi replay` wrote: exchanged, BGR or turned cameras are noted from the "
            "first call on.",
        ),
    ] = None

    def policy_arguments(self) -> dict[str, Any]:
        given = {"out_of_range": self.out_of_range, "known_cameras": self.known_cameras}
        return {**super().policy_arguments(), **given}
