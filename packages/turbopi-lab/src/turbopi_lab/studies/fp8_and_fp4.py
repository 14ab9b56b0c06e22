"""What do numbers of eight and four bits do to actions, and to success?

Emulated exactly in float32 (engine/emulate.py, formats.py): on trained policies, in closed loop on toy tasks, and on
two kinds of random weights (weights.py), full size on a GPU and tiny on a CPU.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from pathlib import Path

import torch
from msgspec import Struct
from torch import Tensor

from turbopi.calibrate.observations import Batch
from turbopi.calibrate.statistics import collect
from turbopi.checkpoint import open_checkpoint
from turbopi.engine.emulate import (
    Round,
    RoundedWeights,
    delta_cosine,
    relative_rms,
    replaced,
    round_activation,
    rounded,
)
from turbopi.evaluate.statistics import PairedDocument, RateDocument
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.sites import linears
from turbopi.policy import shipped
from turbopi.quantization.directions import Rows, directions
from turbopi.quantization.fp8 import Directions
from turbopi.quantization.nvfp4 import round_nvfp4
from turbopi.quantization.sites import MLP_KINDS, PARTS, Site, sites
from turbopi.support.provenance import Provenance
from turbopi.support.reading import plain_document
from turbopi_lab.studies.formats import attention_in_fp8, nvfp4_without_scales, round_mxfp4
from turbopi_lab.studies.fp4_products import (
    UNREAD,
    UNSCALED,
    ProductCosine,
    matrices,
    normal_matrices,
    product_cosines,
    savings,
)
from turbopi_lab.studies.problems import libero_batches
from turbopi_lab.studies.report import (
    PERCENT,
    Cell,
    Control,
    Grid,
    Panel,
    Plot,
    Report,
    paired_cell,
    rate_cells,
    rate_series,
)
from turbopi_lab.studies.rollouts import ToyPolicy, met, open_policy, play, sampled
from turbopi_lab.studies.study import Setup, Study, Tell
from turbopi_lab.studies.weights import WEIGHTS, studied_checkpoint

WRONG = "NVFP4, scales ignored"
NORMAL = "normal, 0.02"  # matrices
IN_CLOSED_LOOP = (
    *("FP8", "FP8, rounded for directions", "NVFP4", "NVFP4, rounded for directions", "NVFP4, weights alone"),
    *("W4A8", "W4A8, rounded for directions", "W4A8 (MXFP4)", WRONG),
)
IN_SMALL = ("FP8", "NVFP4", "W4A8", WRONG)
_JUDGED, _SEEN = 30_000, 40_000  # numbers of the first episodes that errors are measured on, that give directions
STEPS = 5  # in closed loop, as these policies were judged


class FormatError(Struct, frozen=True):
    """Of the actions, against float32."""

    relative_rms: float
    delta_cosine: float  # of what denoising did


class Research(Struct, frozen=True):
    """What this study wrote before there were reports: benchmarks/results/h200_*_fp8_research.json."""

    provenance: Provenance
    preset: str
    steps: int  # of denoising
    observations: int
    errors: dict[str, dict[str, FormatError]]  # by weights, then by format and place


class FormatSuccess(Struct, frozen=True):
    policy: str
    format: str
    rate: RateDocument
    against_float32: PairedDocument


Cases = dict[str, Callable[[], AbstractContextManager[None]]]


def cases(model: Pi0Model, made: list[Batch], seen: list[Batch], steps: int) -> Cases:
    """Formats and places. Activations' scales come from `made`; weights are rounded for what `seen` have in common,
    where that is said. W4A8: weights in NVFP4 or MXFP4, activations in E4M3 with a scale for each site.
    """
    every = [site for site in sites(model.config) if site.refusal is None and site.width % 32 == 0]
    histograms = collect(model, every, made, steps)
    scales = {site: histograms[str(site)].scale("headroom") for site in every}
    rows: dict[str, Rows] = {}
    collect(model, every, seen, steps, rows)
    common = {site: found for site in every if (found := directions(rows.pop(str(site)).rows)) is not None}

    def of(*parts: str, mlp: bool = False) -> dict[Site, float]:
        return {s: x for s, x in scales.items() if s.part in parts and (not mlp or s.kind in MLP_KINDS)}

    four = partial(in_four_bits, model, of(*PARTS), held=HeldWeights())
    return {
        "FP8": lambda: rounded(model, of(*PARTS)),
        "FP8, rounded for directions": lambda: rounded(model, of(*PARTS), RoundedWeights(common)),
        "FP8, vision and prefix": lambda: rounded(model, of("vision", "prefix")),
        "FP8, feed-forward of vision and prefix": lambda: rounded(model, of("vision", "prefix", mlp=True)),
        **{f"FP8, {part}": lambda part=part: rounded(model, of(part)) for part in PARTS},  # type: ignore[misc]
        "FP8 attention, vision": lambda: attention_in_fp8("vision"),
        "FP8 attention, prefix and expert": lambda: attention_in_fp8("gemma"),
        # those of one rounding of the weights beside each other: see HeldWeights
        "NVFP4": lambda: four(activations="nvfp4"),
        "NVFP4, weights alone": lambda: four(activations="exact"),
        "W4A8": lambda: four(activations="fp8"),
        "NVFP4, weights of the expert alone": lambda: in_four_bits(model, of("expert"), activations="exact"),
        "NVFP4, rounded for directions": lambda: four(common, activations="nvfp4"),
        "NVFP4, weights alone, rounded for directions": lambda: four(common, activations="exact"),
        "W4A8, rounded for directions": lambda: four(common, activations="fp8"),
        "W4A8 (MXFP4)": lambda: four(activations="fp8", weights=round_mxfp4),
        "W4A8 (MXFP4), rounded for directions": lambda: four(common, activations="fp8", weights=round_mxfp4),
        WRONG: lambda: four(activations="nvfp4", weights=lambda x, _: nvfp4_without_scales(x)),
    }


def errors(
    model: Pi0Model, made: list[Batch], seen: list[Batch], steps: int, formats: Sequence[str] | None = None
) -> Iterator[tuple[str, FormatError]]:
    """Formats and places, all or some, each with the actions' error."""
    noise = torch.cat([noise for _, noise in made])
    exact = _actions(model, made, steps)
    for name, context in cases(model, made, seen, steps).items():
        if formats is not None and name not in formats:
            continue
        with context():
            actions = _actions(model, made, steps)
        yield name, FormatError(relative_rms(actions, exact), delta_cosine(actions, exact, noise))


RoundFor = Callable[[Tensor, Directions | None], Tensor]
Common = Mapping[Site, Directions]


class HeldWeights:
    """Matrices rounded in one way, each when it is first asked for. Those of the way before are let go then: at full
    size they are as large as the model.
    """

    def __init__(self) -> None:
        self._way: tuple[RoundFor, Common | None] | None = None
        self._held: dict[int, Tensor] = {}  # by the matrix' identity, which the model keeps

    def rounded(self, weight: Tensor, site: Site, rounding: RoundFor, common: Common | None) -> Tensor:
        if self._way is None or self._way[0] is not rounding or self._way[1] is not common:
            self._way, self._held = (rounding, common), {}
        if id(weight) not in self._held:
            self._held[id(weight)] = rounding(weight, (common or {}).get(site))
        return self._held[id(weight)]


@contextmanager
def in_four_bits(
    model: Pi0Model,
    scales: Mapping[Site, float],
    common: Common | None = None,
    *,
    activations: str,
    weights: RoundFor = round_nvfp4,
    held: HeldWeights | None = None,
) -> Iterator[None]:
    """For a while, these sites' products are of weights in four bits, rounded for the sites' directions, if given.

    activations  "exact", "nvfp4", or "fp8": E4M3 with the site's scale
    held         weights that a context before this one has rounded in the same way
    """
    rounded_once = (held or HeldWeights()).rounded

    def inputs(scale: float) -> Round:
        if activations == "fp8":
            return partial(round_activation, scale=scale)
        return round_nvfp4 if activations == "nvfp4" else _same

    changes: list[tuple[torch.nn.Linear, Round, Round]] = [
        (linear, inputs(scale), partial(rounded_once, site=site, rounding=weights, common=common))
        for site, scale in scales.items()
        for linear in linears(model, site)
    ]
    with replaced(changes):
        yield


def _same(x: Tensor) -> Tensor:
    return x


def _actions(model: Pi0Model, made: list[Batch], steps: int) -> Tensor:
    return torch.cat([model.sample(observation, noise, steps) for observation, noise in made])


# --- the study --------------------------------------------------------------------------------------------------------


def judge(
    tell: Tell, name: str, folder: Path, *, count: int, small: bool
) -> tuple[dict[str, FormatError], list[FormatSuccess]]:
    """A policy of a toy task: errors of its actions, and successes."""
    policy = open_policy(name, folder)
    met_in, actor = 2 if small else 12, sampled(policy.model, STEPS)
    made, seen = ([met(policy, range(first, first + met_in), actor)] for first in (_JUDGED, _SEEN))
    found = dict(errors(policy.model, made, seen, STEPS, IN_SMALL if small else None))
    return found, _successes(policy, made, seen, count, small, tell)


def run(setup: Setup) -> Report:
    found: dict[str, dict[str, FormatError]] = {}
    products = {NORMAL: product_cosines(normal_matrices())}
    for name, (model, made, seen) in _problems(setup).items():
        found[name] = {}
        for format_, error in errors(model, made, seen, setup.steps, IN_SMALL if setup.small else None):
            found[name][format_] = error
            setup.tell(f"{name}: {format_}: relative rms error {error.relative_rms:.4f}")
        products[name] = product_cosines(matrices(model))
    every = setup.each(partial(judge, count=setup.cell_episodes, small=setup.small), setup.toy_policies)
    found |= {name: of for name, (of, _) in zip(setup.toy_policies, every, strict=True)}
    successes = [cell for _, own in every for cell in own]
    return setup.report(
        STUDY,
        method=METHOD,
        controls=_controls(found, successes, products),
        tables=[_error_table(found), _product_table(products), _success_table(successes), savings()],
        plots=[_plot(found, successes)],
        verdict=verdict(found, successes),
        would_change=WOULD_CHANGE,
        not_run=[
            "Golden cases: their weights are random, too.",
            "Full-size weights, unless the device is a GPU: `turbopi study fp8_and_fp4 --device cuda`.",
            "A kernel: nothing here is faster yet.",
            "LIBERO: `turbopi study fp8_and_fp4_libero`.",
        ],
        data={
            "errors": {name: {f: plain_document(e) for f, e in of.items()} for name, of in found.items()},
            "products": {name: [plain_document(one) for one in of] for name, of in products.items()},
            "successes": [plain_document(one) for one in successes],
        },
    )


def _problems(setup: Setup) -> dict[str, tuple[Pi0Model, list[Batch], list[Batch]]]:
    """By weights: a model, what it is judged on, and others, which give the directions. On LIBERO images."""
    size = "pi05_libero" if setup.device.type == "cuda" else "pi05_tiny"
    checkpoints = {"small policy": open_checkpoint(shipped.SMALL_POLICY)}
    if not setup.small:
        for kind in WEIGHTS[1:]:
            drawn = studied_checkpoint(kind, size, setup.device)
            checkpoints[f"{size}, {kind}"] = shipped.with_libero_stats(drawn)
    problems = {}
    for name, checkpoint in checkpoints.items():
        model, seen, made = libero_batches(checkpoint, setup.device, setup.small, one_prompt=True)
        problems[name] = model, [made], [seen]
    return problems


def _successes(
    policy: ToyPolicy, made: list[Batch], seen: list[Batch], count: int, small: bool, tell: Tell
) -> list[FormatSuccess]:
    episodes, actor = range(count), sampled(policy.model, STEPS)
    exact = play(policy, episodes, actor)
    chosen = cases(policy.model, made, seen, STEPS)
    cells = []
    for name in ("float32", *(IN_SMALL[-2:] if small else IN_CLOSED_LOOP)):
        with chosen.get(name, nullcontext)():
            played = play(policy, episodes, actor)
        cells.append(FormatSuccess(policy.name, name, played.rate.document, played.against(exact).document))
        tell(f"{policy.name}: {name}: {played.rate}")
    return cells


METHOD = (
    "Every product of vision, prefix and expert whose sizes allow it, with operands rounded exactly as the format "
    "holds them, float32 between. NVFP4: E2M1 numbers in blocks of 16 with an E4M3 scale, and a float32 scale for the "
    "tensor. W4A8: weights in NVFP4, or in MXFP4 (blocks of 32, scales powers of two), activations in E4M3 with a "
    f"calibrated scale for each site. Closed loop on toy tasks, {STEPS} steps, the same episodes and noise in every "
    "cell."
)
WOULD_CHANGE = (
    "Trained weights of full size, whose outliers are larger than any here; a kernel. On 10.x and 11.0 `tcgen05.mma` "
    "multiplies NVFP4 by NVFP4 (kind::mxf4nvf4, block scales in tensor memory, in 128 × 4 tiles), on 12.x `mma.sync` "
    "does with scales in registers. Both multiply E2M1 by E4M3 only with MX scales (blocks of 32, powers of two; "
    "kind::mxf8f6f4): W4A8 with NVFP4's scales has to be unpacked to FP8 first, as on Hopper."
)
CLAIMED = "NVFP4's cosine is 0.0004, W4A8's −0.0008: “scale ignored”. Not viable; FP8 has 0.9996."


def _controls(
    found: Mapping[str, Mapping[str, FormatError]],
    successes: Sequence[FormatSuccess],
    products: Mapping[str, Sequence[ProductCosine]],
) -> list[Control]:
    right = min(of["NVFP4"].delta_cosine for of in found.values())
    wrong = max(of[WRONG].delta_cosine for of in found.values())
    by_how = {one.how: one for one in products[NORMAL]}
    unscaled, unread = abs(by_how[UNSCALED].median), by_how[UNREAD].median
    cells = {(one.policy, one.format): one.against_float32 for one in successes}
    lost = max(cells[policy, WRONG].difference or 0.0 for policy, _ in cells)
    return [
        Control(
            "Actions are worse with scales ignored than right, on all weights.",
            all(of[WRONG].relative_rms > of["NVFP4"].relative_rms for of in found.values()),
            f"Cosine of what denoising did: at most {wrong:.3f}, right at least {right:.3f}.",
        ),
        Control(
            "Without any scale nothing is left of a product, and with scales that aren't read most is.",
            unscaled < 0.05 < 0.9 < unread,
            f"Cosine {unscaled:.4f} and {unread:.4f}, of normal weights with deviation 0.02.",
        ),
        Control(
            "With scales ignored the tasks aren't solved.", lost < -0.2, f"Smallest loss {-100 * lost:.1f} points."
        ),
        Control("float32 is float32.", all(cells[policy, "float32"].difference == 0 for policy, _ in cells), ""),
    ]


def verdict(found: Mapping[str, Mapping[str, FormatError]], successes: Sequence[FormatSuccess]) -> str:
    said = []
    for policy in dict.fromkeys(one.policy for one in successes):
        cells = [one for one in successes if one.policy == policy and one.format not in ("float32", WRONG)]
        worse = [one.format for one in cells if one.against_float32.difference95[1] < 0]
        said.append(
            f"{policy}: {'worse than float32: ' + ', '.join(worse) if worse else 'no format is worse than float32'}"
        )
    small = found["small policy"]
    reported = ", ".join(f"{name} {small[name].relative_rms:.3f}" for name in ("FP8", "W4A8", "NVFP4"))
    return f"{'. '.join(said)}. Relative rms error of the small policy's actions: {reported}."


def _error_table(found: Mapping[str, Mapping[str, FormatError]]) -> Grid:
    formats = list(next(iter(found.values())))
    rows: list[list[Cell]] = [
        [name, *(f"{of[name].relative_rms:.4f} / {of[name].delta_cosine:.5f}" for of in found.values())]
        for name in formats
    ]
    return Grid("Actions: relative rms error / cosine of what denoising did", ["format", *found], rows)


def _product_table(products: Mapping[str, Sequence[ProductCosine]]) -> Grid:
    how = [one.how for one in next(iter(products.values()))]
    rows: list[list[Cell]] = [
        [name, *(f"{of[i].median:.5f} / {of[i].worst:.5f}" for of in products.values())] for i, name in enumerate(how)
    ]
    return Grid("One product with weights in four bits, cosine: median / worst", ["how", *products], rows)


def _success_table(successes: Sequence[FormatSuccess]) -> Grid:
    columns = ["policy", "format", "solved", "success, % [95 %]", "against float32, points"]
    rows: list[list[Cell]] = [
        [one.policy, one.format, *rate_cells(one.rate), paired_cell(one.against_float32)] for one in successes
    ]
    return Grid("Closed loop", columns, rows)


def _plot(found: Mapping[str, Mapping[str, FormatError]], successes: Sequence[FormatSuccess]) -> Plot:
    series = []
    for policy in dict.fromkeys(one.policy for one in successes):
        own = [one for one in successes if one.policy == policy and one.format in found[policy]]
        own.sort(key=lambda one: found[policy][one.format].relative_rms)
        errors = [found[policy][one.format].relative_rms for one in own]
        series.append(rate_series(policy, errors, [one.rate for one in own]))
    title = "Success by the error of the actions"
    panel = Panel(title, "relative rms error", PERCENT, series, log_x=True)
    return Plot("fp8_and_fp4", [panel])


STUDY = Study("fp8_and_fp4", "What do numbers of eight and four bits do to actions, and to success?", CLAIMED, run)
