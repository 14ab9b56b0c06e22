"""`turbopi study`."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec.structs import replace
from rich.table import Table

from turbopi.cli.framework import JsonFlag, Output, command
from turbopi.cli.options import MOST_CALLS, CheckpointArgument, WeightOptions
from turbopi.config import LIMITS
from turbopi.errors import BackendUnavailable, ConfigError
from turbopi.files import write_whole
from turbopi.reading import plain_document
from turbopi.wording import cosine, significant

if TYPE_CHECKING:
    import torch

    from turbopi.checkpoint import Checkpoint
    from turbopi.policy import UnifiedPolicy
    from turbopi.studies.tensorrt import BackendOff, CacheOff, StudyDocument, StyleOff, Throughput

MASK_STEPS = (1, 10)
STUDIES = ("precision", "mask", "actions", "throughput")
ACTION_BACKENDS = ("pytorch", "tensorrt", "tensorrt_fp8")
RANDOM_OBSERVATIONS = 8


@command(
    "study",
    shared=WeightOptions,
    examples=(
        "turbopi study precision,mask checkpoints/pi05_libero --out study.json",
        "turbopi study mask --random-weights pi05_tiny --device cpu",
        "turbopi study throughput checkpoints/pi05_libero --calls 200",
    ),
)
def study(
    options: WeightOptions,
    which: Annotated[
        str,
        typer.Argument(
            metavar="STUDY,STUDY,…",
            help="What to study: precision, mask, actions, throughput.",
            show_default=False,
        ),
    ],
    checkpoint: CheckpointArgument = None,
    observation: Annotated[
        Path | None,
        typer.Option(
            metavar="PATH",
            help="As for `turbopi infer`; else Turbo-Pi's LIBERO pictures (precision, mask: the first).",
        ),
    ] = None,
    steps: Annotated[
        int,
        typer.Option(
            metavar="N", min=1, max=LIMITS["num_denoising_steps"], help="Denoising steps; the mask study has its own."
        ),
    ] = 10,
    calls: Annotated[
        int, typer.Option(metavar="N", min=1, max=MOST_CALLS, help="Calls of each measurement of the throughput study.")
    ] = 100,
    seed: Annotated[int, typer.Option(metavar="N", min=0, help="Of the precision and mask studies' noise.")] = 0,
    device: Annotated[str, typer.Option(metavar="DEVICE", help="auto, cpu, cuda or cuda:N.")] = "auto",
    out: Annotated[Path | None, typer.Option(metavar="FILE", help="Write the results there as JSON.")] = None,
    as_json: JsonFlag = False,
) -> None:
    """Measure what TensorRT's precisions, masks of the cache, and two observations in flight do.

    precision: the language model's layers as TensorRT engines, fused or written-out attention in float16, bfloat16 and
    float32, against the float32 reference. mask: the suffix over a compacted, a padded and masked, and a padded and not
    masked cache, in float32 PyTorch. actions: those of pytorch in bfloat16, tensorrt and tensorrt_fp8 (which needs
    `turbopi build --precision fp8`) against the float32 reference's, on the observations and on random ones.
    throughput: backend tensorrt one call at a time, tensorrt_pipelined with several in flight.
    """
    output = Output(as_json)
    chosen = which.split(",")
    for name in chosen:
        if name not in STUDIES:
            raise ConfigError(f"unknown study {name!r}; choose of {', '.join(STUDIES)}")
    from turbopi import backends

    resolved = backends.resolve_device(device)
    for name in chosen:
        reason = None if name == "mask" else backends.availability("tensorrt", resolved)
        if reason is not None:
            raise BackendUnavailable(f"the {name} study needs TensorRT: {reason}")
    opened = options.open(checkpoint)
    options.tell_if_random(opened, output)
    from turbopi.cli.build import given_observations
    from turbopi.policy import UnifiedPolicy
    from turbopi.provenance import provenance
    from turbopi.studies.tensorrt import StudyDocument

    policy = UnifiedPolicy(opened, backend="pytorch", precision="f32", device=resolved, progress=output.shows_progress)
    given, source = given_observations(policy, observation)
    document = StudyDocument(
        provenance=provenance(resolved),
        model=policy.config.name,
        random_weights=opened.format == "random",
        observations=source,
        seed=seed,
        steps=steps,
    )
    if "precision" in chosen or "mask" in chosen:
        document = _errors(policy, given[0], chosen, document, output)
    if "actions" in chosen:
        judged = _actions(opened, policy, {source: given}, steps)
        document = replace(document, actions=judged)
        output.table(_actions_table(judged))
    del policy
    if "throughput" in chosen:
        measured = _throughput(opened, given, resolved, steps, calls)
        document = replace(document, throughput=measured)
        output.table(_throughput_table(measured))
    if out is not None:
        write_whole(out, json.dumps(plain_document(document), indent=1) + "\n")
        output.line(f"wrote {out}")
    output.document(document)


def _errors(
    policy: "UnifiedPolicy", given: dict[str, object], chosen: list[str], document: "StudyDocument", output: Output
) -> "StudyDocument":
    """The document with the precision and mask studies on one observation."""
    import numpy as np
    import torch

    from turbopi.backends.pytorch import reference_model
    from turbopi.observation import Observation
    from turbopi.studies import tensorrt as studies
    from turbopi.tensorrt import library

    model = reference_model(policy.backend)
    config = policy.config.model
    one = Observation.stack([policy.prepare(given)]).to(model.device)
    shape = (1, config.action_horizon, config.action_dim)
    drawn = np.random.default_rng(document.seed).standard_normal(shape, dtype=np.float32)
    noise = torch.from_numpy(drawn).to(model.device)
    tokens = int(one.image_mask.sum()) * config.vision.num_tokens + int(one.token_mask.sum())
    document = replace(document, prefix_tokens=tokens)
    if "precision" in chosen:
        found = library()
        named = f"{found.name} {found.version}"
        styles = studies.attention_study(model, one, noise, document.steps, studies.builder(found))
        document = replace(document, library=named, precision=styles)
        output.table(_precision_table(styles, named))
    if "mask" in chosen:
        caches = studies.mask_study(model, one, noise, MASK_STEPS)
        document = replace(document, mask=caches)
        output.table(_mask_table(caches))
    return document


def _actions(
    checkpoint: "Checkpoint", exact: "UnifiedPolicy", observations: dict[str, list[dict[str, object]]], steps: int
) -> "list[BackendOff]":
    from turbopi.policy import UnifiedPolicy
    from turbopi.studies import tensorrt as studies

    observations["random"] = [exact.example_observation(seed) for seed in range(RANDOM_OBSERVATIONS)]
    results = []
    for name in ACTION_BACKENDS:
        judged = UnifiedPolicy(checkpoint, backend=name, device=exact.backend.device)
        results += studies.actions_study(exact, judged, observations, steps)
        del judged
    return results


def _actions_table(results: "list[BackendOff]") -> Table:
    table = Table(title="actions against the float32 reference", title_justify="left")
    for column in ("backend", "observations"):
        table.add_column(column)
    for column in ("count", "worst cosine", "worst relative error"):
        table.add_column(column, justify="right")
    for one in results:
        errors = (cosine(one.worst_cosine), significant(one.worst_relative))
        table.add_row(one.backend, one.observations, str(one.count), *errors)
    return table


def _throughput(
    checkpoint: "Checkpoint", given: list[dict[str, object]], device: "torch.device", steps: int, calls: int
) -> "Throughput":
    from turbopi.policy import UnifiedPolicy
    from turbopi.studies import tensorrt as studies

    policies = []
    for name in ("tensorrt", "tensorrt_pipelined"):
        policies.append(UnifiedPolicy(checkpoint, backend=name, device=device, num_denoising_steps=steps))
        policies[-1].warmup()
    return studies.throughput_study(policies[0], policies[1], given, calls)


def _throughput_table(result: "Throughput") -> Table:
    table = Table(title="two observations in flight", title_justify="left")
    table.add_column("how")
    for column in ("latency, ms, median", "observations a second"):
        table.add_column(column, justify="right")
    rows = {f"{name}, one at a time": one for name, one in result.one_at_a_time.items()}
    for name, one in {**rows, "in flight": result.in_flight}.items():
        table.add_row(name, f"{one['total_ms']:.2f}", f"{one['per_second']:.1f}")
    equal = "equal" if result.actions_equal_bit_for_bit else "NOT equal"
    table.caption = f"actions of all three: {equal}, bit for bit"
    return table


def _precision_table(results: "list[StyleOff]", library: str) -> Table:
    table = Table(title=f"{library} against the float32 reference", title_justify="left")
    for column in ("attention", "precision"):
        table.add_column(column)
    for column in ("K, layer 0", "K, last", "V, last", "V, last, max", "actions", "actions, max", "cosine"):
        table.add_column(column, justify="right")
    for one in results:
        first, last, actions = one.layers[0], one.layers[-1], one.actions
        table.add_row(
            one.attention,
            one.precision,
            *map(significant, (first.k_relative, last.k_relative, last.v_relative, last.v_max)),
            *map(significant, (actions.relative, actions.max)),
            cosine(actions.cosine),
        )
    return table


def _mask_table(results: "list[CacheOff]") -> Table:
    table = Table(title="the suffix's cache, against the compacted one, float32", title_justify="left")
    table.add_column("cache")
    for column in ("slots", "steps", "cosine of actions", "relative error"):
        table.add_column(column, justify="right")
    for one in results:
        numbers = (cosine(one.cosine), significant(one.relative))
        table.add_row(one.cache, str(one.slots), str(one.steps), *numbers)
    return table
