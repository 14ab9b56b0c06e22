"""`turbopi build`."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from turbopi.cli.framework import JsonFlag, Output, command, new_console
from turbopi.cli.options import CheckpointArgument, EngineCalibration, ScaleMethod, WeightOptions
from turbopi.config import LIMITS
from turbopi.support.errors import BackendUnavailable, ConfigError

if TYPE_CHECKING:
    from turbopi.backends.tensorrt.calibrate import Calibration
    from turbopi.models.observation import Observation
    from turbopi.policy.policy import UnifiedPolicy

PRECISIONS = ("bf16", "fp8")


@command(
    "build",
    shared=WeightOptions,
    examples=(
        "turbopi build checkpoints/pi05_libero --cameras 2 --prompt-tokens 48",
        "turbopi build checkpoints/mine --precision fp8 --calibration recordings",
        "turbopi build --random-weights pi05_libero --cameras 2 --json",
    ),
)
def build(
    options: WeightOptions,
    checkpoint: CheckpointArgument = None,
    cameras: Annotated[int, typer.Option(metavar="N", min=0, max=4, help="Valid cameras of an observation.")] = 2,
    prompt_tokens: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=LIMITS["max_prompt_tokens"],
            metavar="N",
            help="Longest prompt; the model's own limit unless given.",
        ),
    ] = None,
    horizon: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=LIMITS["action_horizon"],
            metavar="N",
            help="Actions in a chunk; the model's own number unless given.",
        ),
    ] = None,
    precision: Annotated[
        str, typer.Option(metavar="bf16|fp8", help="Of the prefix's MLPs: for backend tensorrt, or tensorrt_fp8.")
    ] = "bf16",
    calibration: EngineCalibration = None,
    method: ScaleMethod = "max",
    cache: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Engine cache; else $TURBOPI_ENGINES or the user's cache.")
    ] = None,
    rebuild: Annotated[bool, typer.Option("--rebuild", help="Build engines anew that are in the cache.")] = False,
    device: Annotated[str, typer.Option("--device", metavar="DEVICE", help="auto, cuda or cuda:N.")] = "auto",
    as_json: JsonFlag = False,
) -> None:
    """Build TensorRT engines for a checkpoint ahead of time, so that its backend starts at once.

    An engine holds for one set of weights, shape, precision, library version and GPU. What is in the cache and still
    right is kept; what is stale or damaged is named and built again.
    """
    output = Output(as_json)
    if precision not in PRECISIONS:
        raise ConfigError(f"unknown precision {precision!r} for engines; choose one of {', '.join(PRECISIONS)}")
    if precision == "bf16" and calibration is not None:
        raise ConfigError("--calibration is for --precision fp8; bf16 engines need none")
    from turbopi import backends
    from turbopi.backends.tensorrt import calibrate, library
    from turbopi.backends.tensorrt.cache import default_folder
    from turbopi.backends.tensorrt.engines import for_this_gpu
    from turbopi.backends.tensorrt.parts import SLOTS, EngineShape, fingerprint

    opened = options.open(checkpoint)
    _ = opened.config.planned_model  # which other families don't have: better known before a library is installed
    resolved = backends.resolve_device(device)
    backend = "tensorrt_fp8" if precision == "fp8" else "tensorrt"
    for reason in (backends.availability(backend, resolved), calibrate.unavailable(method)):
        if reason is not None:
            raise BackendUnavailable(f"can't build engines for {backend}: {reason}")
    options.tell_if_random(opened, output)
    from turbopi.backends.pytorch import reference_model
    from turbopi.engine.weights import pack
    from turbopi.policy.policy import UnifiedPolicy

    policy = UnifiedPolicy(opened, backend="pytorch", precision="bf16", device=resolved, progress=output.shows_progress)
    config = policy.config.planned_model
    state = dict(reference_model(policy.backend).state_dict())
    weights_hash, folder = fingerprint(state), (cache or default_folder()).expanduser()
    found = measure_scales(policy, calibration, method, output) if precision == "fp8" else None
    if found is not None:
        found.save(folder / weights_hash)
    slots = -(-(prompt_tokens or config.max_prompt_tokens) // SLOTS) * SLOTS
    shape = EngineShape(cameras, slots, horizon or config.action_horizon)
    started = time.perf_counter()
    engines = for_this_gpu(
        library(),
        config,
        pack(config, state),
        weights_hash,
        resolved,
        folder=folder,
        scales=None if found is None else found.scales,
        report=output.line,
    )
    del policy
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, console=new_console(stderr=True), transient=True, disable=not output.shows_progress) as bar:
        task = bar.add_task("building engines", total=len(engines.specifications(shape)))
        engines.prepare(
            shape, rebuild=rebuild, progress=lambda name: bar.update(task, advance=1, description=f"built {name}")
        )
    seconds = time.perf_counter() - started
    started = time.perf_counter()
    engines.parts(shape)  # TensorRT-RTX compiles an engine's kernels when it is loaded, and they are kept
    loading = time.perf_counter() - started
    counts = {kind: sum(origin == kind for origin in engines.origin.values()) for kind in ("built", "cached")}
    size = sum(engines.cache.file(name).stat().st_size for name in engines.origin)
    output.line(
        f"{len(engines.origin)} engines for {shape}: {counts['built']} built, {counts['cached']} from the cache, "
        f"{size / 1e9:.2f} GB in {engines.cache.folder}, {seconds:.1f} s, and {loading:.1f} s to load them"
    )
    output.document(
        {
            "backend": backend,
            "shape": str(shape),
            "folder": engines.cache.folder,
            "bytes": size,
            "seconds": seconds,
            "load_seconds": loading,
            "engines": engines.origin,
            "environment": vars(engines.cache.environment),
            "calibration": None if found is None else found.about(),
        }
    )


def measure_scales(policy: "UnifiedPolicy", path: Path | None, method: str, output: Output) -> "Calibration":
    """Scales from observations, or from a file that `turbopi calibrate` wrote."""
    from turbopi.backends.pytorch import reference_model
    from turbopi.backends.tensorrt.calibrate import calibrate, from_quantization

    model = reference_model(policy.backend)
    if path is not None and path.suffix == ".json" and path.is_file():
        from turbopi.quantization.calibration_file import Quantization

        quantization = Quantization.load(path)
        quantization.check(policy.config.planned_model, policy._checkpoint.fingerprint())
        return from_quantization(model, quantization)
    observations, source = calibration_observations(policy, path)
    found = calibrate(model, observations, method=method, source=source)
    output.line(f"calibrated on {found.observations} observations ({source}), {found.method}")
    return found


def calibration_observations(policy: "UnifiedPolicy", path: Path | None) -> "tuple[list[Observation], str]":
    """Observations as the policy's model sees them, and where they are from."""
    from turbopi.models.observation import Observation

    given, source = given_observations(policy, path)
    return [Observation.stack([policy.prepare(one)]) for one in given], source


def given_observations(policy: "UnifiedPolicy", path: Path | None) -> tuple[list[dict[str, object]], str]:
    """Observations under the robot's keys, and where they are from; None: the images that come with Turbo-Pi."""
    if path is None:
        from turbopi.policy.shipped import load_frames, observations

        return observations(policy, load_frames()), "LIBERO images that come with Turbo-Pi"
    from turbopi.cli.infer import _sources
    from turbopi.recordings import load_observation

    return [load_observation(one) for one in _sources(path, None)], path.name
