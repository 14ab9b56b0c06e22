"""A calibration from beginning to end: statistics, the best of several ways to choose scales, the sites that stay in
bfloat16, and a report on observations that had no say in any of it.

Everything is measured with the emulated reference (emulate.py) against the float32 one, so it needs no GPU that has the
format.
"""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from typing import Any

import torch
from torch import Tensor

from turbopi import backends
from turbopi.backends.pytorch import reference_model
from turbopi.calibrate import observations as observed
from turbopi.calibrate.observations import Batch
from turbopi.calibrate.product_errors import product_errors
from turbopi.calibrate.report import read_report
from turbopi.calibrate.statistics import METHODS, Histogram, Method, collect
from turbopi.checkpoint import Checkpoint
from turbopi.engine.emulate import NO_SIGNAL, RoundedWeights, delta_cosine, has_signal, relative_rms, rounded
from turbopi.engine.graph import collect_and_empty_cache
from turbopi.models import FAMILIES, family_of
from turbopi.policy import shipped
from turbopi.policy.examples import NoisyExample, with_noises
from turbopi.policy.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import RANDOM_NOISE, Quantization, SiteScale, shapes_of
from turbopi.quantization.directions import Rows, directions
from turbopi.quantization.formats import FP8, Format
from turbopi.quantization.fp8 import Directions
from turbopi.quantization.plan import HALF_SUMS, format_of, refusal
from turbopi.quantization.sites import KINDS, MLP_KINDS, PARTS, Site, sites
from turbopi.support.errors import CheckpointError, ConfigError
from turbopi.support.reading import plain_document

TARGET = 0.9975  # cosine of the actions' deltas that automatic choice of sites aims at
ROOM = 0.8  # of the error that the target allows, on the few calls that sites are chosen on: others may be harder
SATURATION_LIMIT = 0.01  # part of a site's held-out values beyond the largest number: more is told loudly
SITE_LIMIT = 0.25  # relative rms of a site's products beyond which it stays in bfloat16 whatever the actions say
SELECTION = 8  # calls at most that ways to choose scales and groups of sites are compared on, of few the half


@dataclass(frozen=True)
class Settings:
    """What to calibrate on and for. `arguments` are UnifiedPolicy's besides the checkpoint, backend and precision."""

    arguments: Mapping[str, Any]
    observations: str | None = None  # see observations.read_examples
    count: int = 64
    noises: int = 1
    seed: int = 0
    target: float = TARGET
    batch: int = 8
    methods: Sequence[Method] = METHODS
    format: Format = FP8


@dataclass
class Progress:
    """How a run tells what it is doing; by default it doesn't."""

    begin: Callable[[str, int], None] = field(default=lambda text, total: None)
    advance: Callable[[], None] = field(default=lambda: None)


def check_family(checkpoint: Checkpoint, format: Format) -> None:
    """Raise ConfigError for a model that no calibration in this format is for, before anything else is read."""
    family = family_of(checkpoint.config.model)
    formats = dict.fromkeys(format_of(tier) for tier in family.tiers)
    if format in formats:
        return
    if formats:
        others = " or ".join(one.name for one in formats)
        raise ConfigError(f"{family.label} doesn't run in {format.label}: calibrate it for {others}")
    names = ", ".join(one.label for one in FAMILIES.values() if one.tiers)
    other = ", or on an NVIDIA GPU in 'int8-weights', which needs none" if family.reader is not None else ""
    raise ConfigError(
        f"calibrations are for {names} alone, and {checkpoint.config.name} is {family.label}: run it in "
        f"precision 'bf16'{other}"
    )


def calibrate(checkpoint: Checkpoint, settings: Settings, progress: Progress | None = None) -> Quantization:
    """Choose scales and sites for a checkpoint.

    Raises what `check_family` raises, ObservationError for observations that can't be used, CheckpointError where the
    reference itself isn't finite.
    """
    progress, started = progress or Progress(), time.perf_counter()
    check_family(checkpoint, settings.format)
    if settings.arguments.get("robot") is None:
        checkpoint = shipped.with_libero_stats(checkpoint)
    arguments = dict(settings.arguments) | {"backend": "pytorch", "precision": "f32"}
    arguments["device"] = backends.resolve_device(arguments.get("device", "auto"))
    policy = UnifiedPolicy(checkpoint, **arguments)
    source, examples = observed.read_examples(policy, settings.observations, settings.count)
    chosen, held = observed.split(examples)
    model = reference_model(policy.backend)
    config = model.config
    shape = (config.action_horizon, config.action_dim)
    calibration = with_noises(chosen, shape, settings.noises, settings.seed)
    held_out = with_noises(held, shape, settings.noises, settings.seed + len(calibration))
    steps = int(policy.metadata["num_denoising_steps"])
    loaded = time.perf_counter()
    result = calibrate_model(model, calibration, held_out, steps, settings, progress)
    finished = time.perf_counter()
    report = {
        "turbopi": _version(),
        "model": checkpoint.config.name,
        "random_weights": checkpoint.format == "random",
        "device": policy.metadata["device_name"],
        "observations": {
            "source": source,
            "count": len(examples),
            "noises": settings.noises,
            "seed": settings.seed,
            "calibration": {one.source: one.sha256 for one in chosen},
            "held_out": {one.source: one.sha256 for one in held},
        },
        **result.report,
    }
    if source == RANDOM_NOISE:
        report["target_reached"] = None
    hashes = report["observations"]
    twice = len(set(hashes["held_out"].values()) & set(hashes["calibration"].values()))
    if twice:
        report["warnings"].append(
            f"{twice} of {len(held)} held-out observations were calibrated on, too: the same inputs"
        )
    fingerprint = checkpoint.fingerprint()
    report["seconds"] = {
        "loading": round(loaded - started, 2),
        "measuring": round(finished - loaded, 2),
        "hashing the weights": round(time.perf_counter() - finished, 2),
    }
    del model, policy
    collect_and_empty_cache()
    name = settings.format.name
    return Quantization(fingerprint, shapes_of(config), result.sites, plain_document(read_report(report, name)), name)


@dataclass(frozen=True)
class Measured:
    sites: dict[str, SiteScale]
    report: dict[str, Any]


def calibrate_model(
    model: Any,
    calibration: Sequence[NoisyExample],
    held_out: Sequence[NoisyExample],
    steps: int,
    settings: Settings,
    progress: Progress | None = None,
) -> Measured:
    """The same for a reference model and calls that are given. Raises what `calibrate` raises."""
    progress, format = progress or Progress(), settings.format
    everywhere = sites(model.config)
    impossible = {site: why for site in everywhere if (why := refusal(site, format)) is not None}
    eligible = [site for site in everywhere if site not in impossible]

    def statistics(
        text: str, calls: Sequence[NoisyExample], rows: dict[str, Rows] | None = None
    ) -> dict[str, Histogram]:
        made = list(observed.batches(calls, settings.batch, model.device))
        progress.begin(text, len(made))

        def ticking() -> Any:
            for _, batch in made:
                yield batch
                progress.advance()

        return collect(model, everywhere, ticking(), steps, rows, format)

    rows: dict[str, Rows] = {}
    # weights rounded for what some calls have in common are better on those than on any others
    others, chosen = _apart(calibration)
    histograms = statistics("what every site sees", others, rows)
    if chosen is not others:
        more = statistics("what it sees where sites are chosen", chosen)
        histograms = {name: one.with_counts_of(more[name]) for name, one in histograms.items()}
    unseen = statistics("what held-out ones see", held_out)
    progress.begin("what its activations have in common", len(eligible))
    common: dict[Site, Directions] = {}
    for site in eligible:
        if (found := directions(rows.pop(str(site)).rows)) is not None:
            common[site] = found
        progress.advance()
    weights = RoundedWeights(common, format)
    selection = _Trials(model, chosen, steps, settings.batch, progress, weights)
    method, methods = _best_method(eligible, histograms, selection, settings.methods, progress)
    scales = _scales(everywhere, histograms, method, format)

    progress.begin("matmuls of every site", 1)
    products = product_errors(model, {site: scales[site] for site in eligible}, selection.batches, steps, weights)
    progress.advance()
    kept = {str(site): f"not possible: {why}" for site, why in impossible.items()}
    kept |= {
        name: f"its matmuls alone are off by {error:.0%}" for name, error in products.items() if error > SITE_LIMIT
    }
    groups = _groups(eligible, scales, kept, selection, progress)
    kept |= _keep_groups(eligible, scales, kept, groups, selection, settings.target, progress)

    entries, warnings = {}, []
    for site in everywhere:
        name, scale = str(site), scales[site]
        saturated = unseen[name].error(scale)[1] if format.rounds_input(site.part) else 0.0
        if saturated > SATURATION_LIMIT:
            warnings.append(f"{saturated:.1%} of the held-out values of {name} saturate: more observations may help")
        entries[name] = SiteScale(
            scale,
            histograms[name].largest,
            saturated,
            products.get(name, 0.0),
            kept.get(name),
            None if name in kept or site not in common else common[site].to(torch.device("cpu")),
        )
    final = _Trials(model, held_out, steps, settings.batch, progress, weights)
    on_held_out = _held_out(model, eligible, scales, kept, final, progress)
    reached = on_held_out[format.name]["delta_cosine"]
    if len(kept) == len(everywhere):
        warnings.append(
            f"no site is left in {format.label}, so no policy can be made of this: a lower target may leave some"
        )
    if reached < settings.target:
        warnings.append(f"the held-out actions' cosine is {reached:.5f}, below the target {settings.target}")
    elif HALF_SUMS in on_held_out and (half := on_held_out[HALF_SUMS]["delta_cosine"]) < settings.target:
        warnings.append(f"in {HALF_SUMS} their cosine is {half:.5f}, below the target {settings.target}")
    report = {
        "steps": steps,
        "method": method,
        "methods": methods,
        "groups_alone": groups,
        "kept_in_bf16": kept,
        "target": settings.target,
        "target_reached": reached >= settings.target,
        "held_out": on_held_out,
        "warnings": warnings,
    }
    return Measured(entries, report)


def _apart(calibration: Sequence[NoisyExample]) -> tuple[Sequence[NoisyExample], Sequence[NoisyExample]]:
    """(calls to find directions on, calls to choose sites on); of a single call it is both."""
    count = min(SELECTION, len(calibration) // 2)
    if count == 0:
        return calibration, calibration
    chosen = {i * len(calibration) // count for i in range(count)}
    others = [call for i, call in enumerate(calibration) if i not in chosen]
    return others, [calibration[i] for i in sorted(chosen)]


class _Trials:
    """The same calls again and again with other sites rounded, against what float32 made of them."""

    def __init__(
        self,
        model: Any,
        calls: Sequence[NoisyExample],
        steps: int,
        size: int,
        progress: Progress,
        weights: RoundedWeights,
    ) -> None:
        self._model, self._steps, self._weights = model, steps, weights
        self._made = list(observed.batches(calls, size, model.device))
        progress.begin("float32 reference", len(self._made))
        self.exact: list[Tensor] = []
        for _, (observation, noise) in self._made:
            self.exact.append(model.sample(observation, noise, steps))
            progress.advance()
            if not bool(self.exact[-1].isfinite().all()):
                raise CheckpointError("the float32 reference itself gives actions that aren't finite; damaged weights?")
        noise = torch.cat([noise for _, (_, noise) in self._made])
        if not has_signal(torch.cat(self.exact).cpu().numpy(), noise.cpu().numpy()):
            raise CheckpointError(f"nothing to judge: {NO_SIGNAL}")

    @property
    def format(self) -> Format:
        return self._weights.format

    @property
    def batches(self) -> list[Batch]:
        return [batch for _, batch in self._made]

    @property
    def calls(self) -> list[NoisyExample]:
        return [call for calls, _ in self._made for call in calls]

    def actions(self, scales: Mapping[Site, float], model: Any = None, half_sums: bool = False) -> list[Tensor]:
        """Of every batch, with these sites rounded."""
        used = model or self._model
        with rounded(used, scales, self._weights, half_sums):
            return [used.sample(observation, noise, self._steps) for observation, noise in self.batches]

    def error(self, actions: Sequence[Tensor], against: Sequence[Tensor] | None = None) -> dict[str, float]:
        """How far actions are from float32's, or from others."""
        ours, exact = torch.cat(list(actions)), torch.cat(list(against or self.exact))
        noise = torch.cat([noise for _, noise in self.batches])
        return {
            "relative_rms": relative_rms(ours, exact),
            "delta_cosine": delta_cosine(ours, exact, noise),
            "max": float((ours - exact).abs().max()),
        }


def _scales(
    places: Sequence[Site], histograms: Mapping[str, Histogram], method: Method, format: Format
) -> dict[Site, float]:
    """Of these sites' activations; 1 where the format leaves them as they are."""
    return {site: histograms[str(site)].scale(method) if format.rounds_input(site.part) else 1.0 for site in places}


def _best_method(
    eligible: Sequence[Site],
    histograms: Mapping[str, Histogram],
    trials: _Trials,
    methods: Sequence[Method],
    progress: Progress,
) -> tuple[Method, dict[str, Any]]:
    """The way to choose scales whose actions are best; among those within 5 % the one that leaves most room."""
    progress.begin("ways to choose scales", len(methods))
    measured: dict[str, Any] = {}
    for method in methods:
        scales = _scales(eligible, histograms, method, trials.format)
        measured[method] = trials.error(trials.actions(scales))
        progress.advance()
    least = min(one["relative_rms"] for one in measured.values())
    good = [method for method in methods if measured[method]["relative_rms"] <= 1.05 * least]

    def room(method: Method) -> float:
        rounding = [histograms[str(site)] for site in eligible if trials.format.rounds_input(site.part)]
        return sum(one.scale(method) / one.scale("max") for one in rounding)

    return max(good, key=room), measured


def _groups(
    eligible: Sequence[Site],
    scales: Mapping[Site, float],
    kept: Mapping[str, str],
    trials: _Trials,
    progress: Progress,
) -> dict[str, Any]:
    """The actions' error with one group of sites rounded alone."""
    names = [f"{part}.{kind}" for part in PARTS for kind in KINDS[part]]
    progress.begin("groups of sites", len(names))
    measured = {}
    for name in names:
        own = {site: scales[site] for site in eligible if site.group == name and str(site) not in kept}
        if own:
            measured[name] = trials.error(trials.actions(own))
        progress.advance()
    return measured


def by_harm(rms: Mapping[str, float], work: Mapping[str, int]) -> list[tuple[str, ...]]:
    """Groups of sites in the order in which they go back to bfloat16: those first that hurt most for the work they do.

    The expert's go as one, since its kernel takes all matrices in one precision. Errors add up in squares.
    """
    together: dict[str, list[str]] = {}
    for name in rms:
        together.setdefault("expert" if name.startswith("expert.") else name, []).append(name)

    def harm(names: tuple[str, ...]) -> float:
        return sum(rms[name] ** 2 for name in names) / sum(work[name] for name in names)

    return sorted((tuple(names) for names in together.values()), key=harm, reverse=True)


def _keep_groups(
    eligible: Sequence[Site],
    scales: Mapping[Site, float],
    kept: Mapping[str, str],
    groups: Mapping[str, Mapping[str, float]],
    trials: _Trials,
    target: float,
    progress: Progress,
) -> dict[str, str]:
    """Take groups back to bfloat16, see `by_harm`, until the target is met."""
    work = {name: sum(site.width * site.outputs for site in eligible if site.group == name) for name in groups}
    rms = {name: measured["relative_rms"] for name, measured in groups.items()}
    hurting = by_harm(rms, work)
    progress.begin("which sites to keep in bfloat16", len(hurting))
    more: dict[str, str] = {}
    wanted = 1 - ROOM * (1 - target)
    for names in hurting:
        used = {site: scales[site] for site in eligible if str(site) not in kept and str(site) not in more}
        if not used or trials.error(trials.actions(used))["delta_cosine"] >= wanted:
            break
        alone = math.hypot(*(rms[name] for name in names))
        reason = f"the actions' cosine is below {wanted:.5g} with it; alone it costs {alone:.2%}"
        more |= {str(site): reason for site in used if site.group in names}
        progress.advance()
    return more


def _held_out(
    model: Any,
    eligible: Sequence[Site],
    scales: Mapping[Site, float],
    kept: Mapping[str, str],
    trials: _Trials,
    progress: Progress,
) -> dict[str, Any]:
    """Errors of tiers, parts and plain bfloat16 on observations that chose nothing."""
    used = {site: scale for site, scale in scales.items() if site in set(eligible) and str(site) not in kept}
    name = trials.format.name
    cases: dict[str, dict[Site, float]] = {name: used}
    if name == "fp8":
        if HALF_SUMS in family_of(model.config).tiers:
            cases[HALF_SUMS] = used
        cases["fp8-mlp"] = {s: scale for s, scale in used.items() if s.kind in MLP_KINDS and s.part != "expert"}
    for part in trials.format.parts:
        cases[f"{name} in the {part} alone"] = {s: used[s] for s in used if s.part == part}
    progress.begin("held-out observations", len(cases) + 1)
    report: dict[str, Any] = {}
    actions = {}
    for case, own in cases.items():
        actions[case] = trials.actions(own, half_sums=case == HALF_SUMS)
        report[case] = trials.error(actions[case])
        progress.advance()
    family, config = family_of(model.config), model.config
    state = {name: one.to(family.parameter_dtype(name, "bf16", config)) for name, one in model.state_dict().items()}
    plain = trials.actions({}, family.reference.from_state(config, state))
    report["bf16"] = trials.error(plain)
    report[f"{name} against bf16"] = trials.error(actions[name], plain)
    progress.advance()
    by_call = [
        relative_rms(ours, exact) for ours, exact in zip(torch.cat(actions[name]), torch.cat(trials.exact), strict=True)
    ]
    worst = max(range(len(by_call)), key=by_call.__getitem__)
    call = trials.calls[worst]
    report["worst"] = {"observation": call.example.source, "seed": call.seed, "relative_rms": by_call[worst]}
    return report


def _version() -> str:
    try:
        return metadata.version("turbopi")
    except metadata.PackageNotFoundError:
        return "not installed"
