"""What runs in which precision."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, get_args

from turbopi.quantization.formats import FORMATS, Format
from turbopi.quantization.fp8 import Directions
from turbopi.quantization.sites import MLP_KINDS, Site

# that a policy runs in; the tiers need a calibration, and weights in INT8 beside activations that aren't rounded none
Precision = Literal["bf16", "f32", "int8-weights", "fp8", "fp8-mlp", "fp8-f16sums", "int8", "nvfp4"]
Fp8Tier = Literal["fp8", "fp8-mlp", "fp8-f16sums"]
FP8_TIERS: tuple[Fp8Tier, ...] = get_args(Fp8Tier)
Tier = Literal["fp8", "fp8-mlp", "fp8-f16sums", "int8", "nvfp4"]
TIERS: tuple[Tier, ...] = get_args(Tier)
KEPT_TIERS: tuple[Tier, ...] = (*FP8_TIERS, "int8")  # that a folder keeps its weights in
WEIGHTS_ALONE: Final = "int8-weights"
HALF_SUMS: Final = "fp8-f16sums"  # FP8 whose products of vision and prefix are added up in float16: see fp8.py
ROUNDED: tuple[Precision, ...] = (WEIGHTS_ALONE, *TIERS)


def format_of(tier: str) -> Format:
    """What a tier's numbers are."""
    return next((one for one in FORMATS.values() if one.name == tier), FORMATS["fp8"])


@dataclass(frozen=True)
class PrecisionPlan:
    """A tier's choice: site -> scale of its activation (1 where that isn't rounded), site -> why it stays in bfloat16,
    site -> directions.
    """

    tier: str
    scales: Mapping[str, float]
    kept: Mapping[str, str]
    directions: Mapping[str, Directions]

    @property
    def format(self) -> Format:
        return format_of(self.tier)

    @property
    def expert(self) -> Literal["fp8", "int8", "bf16"]:
        """The denoising kernel takes all of the expert's matrices in one precision: bf16 if any is to be kept so."""
        name = self.format.name
        return "bf16" if name == "nvfp4" or any(one.startswith("expert.") for one in self.kept) else name

    @property
    def half_sums(self) -> bool:
        return self.tier == HALF_SUMS

    def has_half_sums(self, site: str) -> bool:
        """Not the expert's: denoising is bound by reading weights."""
        return self.half_sums and not site.startswith("expert.")

    def without_expert(self, reason: str) -> "PrecisionPlan":
        """The same with the expert in bfloat16, for this reason."""

        def others(of: Mapping[str, Any]) -> dict[str, Any]:
            return {site: one for site, one in of.items() if not site.startswith("expert.")}

        kept = {site: reason for site in [*self.scales, *self.kept] if site.startswith("expert.")}
        return PrecisionPlan(self.tier, others(self.scales), others(self.kept) | kept, others(self.directions))

    @property
    def rounded(self) -> list[str]:
        """The sites whose matrices are rounded: of the expert's all or none."""
        return [site for site in self.scales if self.expert != "bf16" or not site.startswith("expert.")]

    def describe(self) -> dict[str, Any]:
        """Which sites run in what, by group, and why the others don't."""
        by_group: dict[str, dict[str, list[str]]] = {}
        for name in [*self.scales, *self.kept]:
            part, layer, kind = name.split(".")
            state = f"{self.format.name}{' with float16 sums' * self.has_half_sums(name)}"
            state = state if name in self.scales else f"bf16: {self.kept[name]}"
            by_group.setdefault(f"{part}.{kind}", {}).setdefault(state, []).append(layer)
        return {
            group: next(iter(states))
            if len(states) == 1
            else {state: f"layers {', '.join(layers)}" for state, layers in states.items()}
            for group, states in sorted(by_group.items())
        }


def refusal(site: Site, format: Format) -> str | None:
    """Why a site can't be in a format, whatever its calibration says, or None."""
    if site.tells and not format.holds_nan:
        return f"{format.label} has no NaN, and a NaN of the prefix reaches the actions through these keys and values"
    if site.part not in format.parts:
        return f"{format.label} is for {' and '.join(format.parts)}: no denoising kernel has it"
    if site.weights_alone and format.rounds_input(site.part):
        return f"this family's denoising kernel takes no activations in {format.label}"
    return site.refusal


def reason_for_bf16(site: Site, scale: float | None, kept: str | None, tier: str, parts: Sequence[str]) -> str | None:
    """Why a site stays in bfloat16; None: it doesn't. `scale` and `kept`: what its calibration says."""
    if site.part not in parts:
        return f"{format_of(tier).label} is switched off in the {site.part}"
    if tier == "fp8-mlp" and (site.kind not in MLP_KINDS or site.part == "expert"):
        return "fp8-mlp takes the feed-forward matmuls of vision and prefix alone"
    if scale is None:
        return "its calibration is older than FP8 for this activation; run `turbopi calibrate` again"
    return refusal(site, format_of(tier)) or kept
