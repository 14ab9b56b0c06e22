"""What calibration leaves behind: one JSON file that says which products run in FP8, INT8 or NVFP4, with what scales.

It holds for one set of weights (by the hash of all of them), one model and one version of this format; everything else
is refused. What was measured to get there is kept in it and goes with it into every policy's metadata.
"""

import base64
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import torch

from turbopi.quantization.formats import FORMATS, Format, Numbers
from turbopi.quantization.fp8 import E4M3, Directions
from turbopi.quantization.plan import HALF_SUMS, TIERS, PrecisionPlan, format_of, reason_for_bf16
from turbopi.quantization.sites import PARTS, Part, Stacks, sites
from turbopi.support.errors import CalibrationError, ConfigError
from turbopi.support.files import write_whole
from turbopi.support.reading import is_finite, is_integer, one_line, read_json, shown

# version 1 has no directions; 2 has no scales for the expert's activations; 4 says `numbers`. FP8's files are written
# as version 3, which older Turbo-Pis read, too.
FORMAT, VERSION, FP8_VERSION = "turbopi-quantization", 4, 3
HALF_SUMS_COST = 1.5  # times FP8's error: by chance it may be more or less, as roundings near an edge fall either way
RANDOM_NOISE = "random-noise"  # instead of observations: has to be asked for by this name


@dataclass(frozen=True)
class SiteScale:
    """A site's share of the file.

    scale       of its activation: x ≈ e4m3 or int8 * scale, in NVFP4 the tensor's; 1 where it isn't rounded; None for
                the expert's in files of versions 1 and 2
    largest     |x| seen in calibration
    saturated   part of the held-out values beyond the largest number
    error       relative rms of its products on the calls that sites are chosen on, rounded against not
    kept        why it stays in bfloat16; None: it doesn't
    directions  what its activations have in common, for the rounding of its weights; None: rounded to nearest
    """

    scale: float | None
    largest: float
    saturated: float
    error: float
    kept: str | None = None
    directions: Directions | None = None

    @property
    def digest(self) -> tuple[str, ...]:
        """What tells its directions from others, if it has any."""
        d = self.directions
        if d is None:
            return ()
        return (hashlib.sha256(_bytes(d.codes)).hexdigest(), *map(str, d.scale.tolist()), str(d.rest))

    def as_json(self) -> dict[str, Any]:
        content = {one.name: getattr(self, one.name) for one in fields(self)}
        if self.directions is not None:
            content["directions"] = {
                "e4m3": base64.b64encode(_bytes(self.directions.codes)).decode(),  # [width, as many as scales]
                "scale": self.directions.scale.tolist(),
                "rest": self.directions.rest,
            }
        return content

    @classmethod
    def from_json(cls, content: Mapping[str, Any]) -> "SiteScale":
        """Raises ValueError, KeyError, TypeError or RuntimeError for what `as_json` didn't make."""
        _expect(isinstance(content, dict), "the site", "an object", content)
        scale, kept = content.get("scale"), content.get("kept")
        is_scale = scale is None or (_is_number(scale) and _SCALES[0] <= scale <= _SCALES[1])  # NaN isn't
        _expect(is_scale, "the scale", f"a number from {_SCALES[0]:g} to {_SCALES[1]:g}", scale)
        _expect(kept is None or isinstance(kept, str), "the reason kept", "a reason or null", kept)
        for name in ("largest", "saturated", "error"):
            _expect(_is_number(content[name]), name, "a number", content[name])
        given = content.get("directions")
        if given is None:
            return cls(**content)
        if not all(map(is_finite, (*given["scale"], given["rest"]))):
            raise ValueError("directions that aren't finite numbers")
        codes = torch.frombuffer(bytearray(base64.b64decode(given["e4m3"], validate=True)), dtype=torch.uint8)
        scale = torch.tensor(given["scale"], dtype=torch.float32)
        found = Directions(codes.view(E4M3).view(-1, len(scale)), scale, float(given["rest"]))
        if not (found.main.isfinite().all() and 0 < found.rest < float("inf")):
            raise ValueError("directions that aren't finite")
        return cls(**{**content, "directions": found})


@dataclass(frozen=True)
class Quantization:
    """A calibrated checkpoint's FP8, INT8 or NVFP4: read with `load`, checked with `check`, narrowed with `only`."""

    fingerprint: str
    shapes: Mapping[str, Any]
    sites: Mapping[str, SiteScale]
    report: Mapping[str, Any]  # observations, method, held-out errors, warnings
    numbers: Numbers = "fp8"
    parts: tuple[Part, ...] = PARTS
    source: str = field(default="", compare=False)  # where it was read from

    @property
    def format(self) -> Format:
        return FORMATS[self.numbers]

    @property
    def on_random_noise(self) -> bool:
        return self.report["observations"]["source"] == RANDOM_NOISE

    @property
    def warnings(self) -> list[str]:
        """What every output should say."""
        noise = ["calibrated on random noise, not on observations: its errors say nothing"]
        old = ["the calibration has no scales for the expert's activations, so the expert stays in bf16: run it again"]
        return [
            *(noise if self.on_random_noise else []),
            *(old if any(site.scale is None for site in self.sites.values()) else []),
            *self.report.get("warnings", []),
        ]

    @property
    def identity(self) -> str:
        """SHA-256 of all that decides a policy's numbers: weights, scales, directions, what stays in bf16, parts."""
        sites = {name: (site.scale, site.kept is None, *site.digest) for name, site in self.sites.items()}
        decisive = {"weights": self.fingerprint, "sites": sites, "parts": list(self.parts)}
        if self.numbers != "fp8":  # whose identities stay what they were
            decisive["numbers"] = self.numbers
        return hashlib.sha256(json.dumps(decisive, sort_keys=True).encode()).hexdigest()

    def only(self, parts: Sequence[str]) -> "Quantization":
        """The same for these parts of the model alone. Raises ConfigError for a part that doesn't exist."""
        for part in parts:
            if part not in PARTS:
                raise ConfigError(f"unknown part {part!r} for {self.format.label}; choose of {', '.join(PARTS)}")
        if not parts:
            raise ConfigError(f"{self.format.label} in no part at all; use precision 'bf16'")
        return replace(self, parts=tuple(part for part in PARTS if part in parts))

    def check_shapes(self, config: Stacks) -> None:
        """Raise CalibrationError unless this was made for a model of these sizes."""
        where = self.source or "this calibration"
        wrong = list(_differences(self.shapes, shapes_of(config)))
        if wrong:
            raise CalibrationError(
                f"{where} was made for a model of other shapes: {'; '.join(wrong)}. Run `turbopi calibrate` on this one"
            )
        missing = [str(site) for site in sites(config) if str(site) not in self.sites]
        if missing:
            raise CalibrationError(f"{where} has no scale for {', '.join(missing[:5])}: it is damaged")
        for site in sites(config):
            common = self.sites[str(site)].directions
            if common is not None and len(common.codes) != site.width:
                raise CalibrationError(
                    f"{where} has directions of {len(common.codes)} numbers for {site}, which is {site.width} wide: "
                    "it is damaged"
                )

    def check(self, config: Stacks, fingerprint: str) -> None:
        """Raise CalibrationError unless this was made for these weights and this model."""
        self.check_shapes(config)
        if fingerprint != self.fingerprint:
            raise CalibrationError(
                f"{self.source or 'this calibration'} was made for other weights: their hash is "
                f"{self.fingerprint[:16]}…, that of these weights {fingerprint[:16]}…. Run `turbopi calibrate` on this "
                "checkpoint"
            )

    def plan(self, config: Stacks, tier: str) -> PrecisionPlan:
        """What is rounded in a tier, and why the rest isn't. Raises ConfigError for a tier of other numbers, or
        float16 sums that cost too much.
        """
        if tier not in TIERS:
            raise ConfigError(f"{tier!r} is no calibrated precision; choose one of {', '.join(TIERS)}")
        if format_of(tier).name != self.numbers:
            wanted = format_of(tier).name
            raise ConfigError(
                f"{self.source or 'this calibration'} is for {self.numbers}, the precision is {tier!r}; make one with "
                f"`turbopi calibrate --precision {wanted}`"
            )
        if tier == HALF_SUMS:
            self._check_half_sums()
        chosen: dict[str, float] = {}
        kept: dict[str, str] = {}
        common: dict[str, Directions] = {}
        for site in sites(config):
            entry = self.sites[str(site)]
            reason = reason_for_bf16(site, entry.scale, entry.kept, tier, self.parts)
            if reason is None:
                assert entry.scale is not None  # or there is a reason
                chosen[str(site)] = entry.scale
                if entry.directions is not None:
                    common[str(site)] = entry.directions
            else:
                kept[str(site)] = reason
        plan = PrecisionPlan(tier, chosen, kept, common)
        if tier == HALF_SUMS and not any(map(plan.has_half_sums, chosen)):
            raise ConfigError(f"nothing of vision and prefix is left in {HALF_SUMS}: take 'fp8'")
        return plan

    def _check_half_sums(self) -> None:
        """Raise ConfigError unless they were measured, and reach the target or cost next to nothing."""
        held, name = self.report.get("held_out", {}), self.source or "this calibration"
        if isinstance(held, Mapping) and HALF_SUMS not in held:
            raise ConfigError(f"{name} is older than {HALF_SUMS}; run `turbopi calibrate` again or take 'fp8'")
        try:
            ours, target = held[HALF_SUMS], self.report["target"]
            error, cosine, of_fp8 = ours["relative_rms"], ours["delta_cosine"], held["fp8"]["relative_rms"]
            if not all(map(is_finite, (error, cosine, of_fp8, target))):
                raise TypeError
        except (KeyError, TypeError):
            raise CalibrationError(f"{name} doesn't say what {HALF_SUMS} costs: its report is damaged") from None
        most = HALF_SUMS_COST * of_fp8
        if not (cosine >= target or error <= most):
            raise ConfigError(
                f"{name} doesn't allow {HALF_SUMS}: the held-out actions' error {error:.4f} is beyond {most:.4f} and "
                "their cosine below the target; take 'fp8'"
            )

    def describe(self, plan: PrecisionPlan) -> dict[str, Any]:
        """What goes into the metadata of a policy that runs with it."""
        return {
            "plan": plan.describe(),
            "calibration": self.source or "in memory",
            "identity": self.identity,
            "observations": self.report["observations"]["source"],
            "weights": f"{len(plan.directions)} of {len(plan.scales)} sites' rounded for directions, else to nearest",
            "warnings": self.warnings,
        }

    # -- the file ------------------------------------------------------------------------------------------------------

    def save(self, file: Path) -> None:
        """Write it, whole or not at all."""
        write_whole(file, json.dumps(self.as_json(), indent=1, ensure_ascii=False) + "\n")

    def as_json(self, *, directions: bool = True) -> dict[str, Any]:
        """All of it; without `directions`, which are megabytes, what a reader wants."""
        found = {name: site if directions else replace(site, directions=None) for name, site in self.sites.items()}
        return {
            "format": FORMAT,
            **({"version": FP8_VERSION} if self.numbers == "fp8" else {"version": VERSION, "numbers": self.numbers}),
            "weights_sha256": self.fingerprint,
            "shapes": dict(self.shapes),
            "sites": {name: site.as_json() for name, site in found.items()},
            "report": dict(self.report),
        }

    @classmethod
    def load(cls, file: str | Path) -> "Quantization":
        """Read what `save` wrote. Raises CalibrationError if it isn't that, or of another version."""
        path = Path(file)
        if not path.is_file():
            raise CalibrationError(f"there is no file {path}; make it with `turbopi calibrate CKPT --out {path}`")
        try:
            content = read_json(path, CalibrationError, limit=_MAX_BYTES, nan=True)
        except CalibrationError as error:
            raise CalibrationError(f"{error}, so it isn't a calibration that `turbopi calibrate` wrote") from error
        try:
            if content["format"] != FORMAT:
                raise CalibrationError(f"{path} is {shown(content['format'])}, not {FORMAT}")
            if not is_integer(content["version"]) or content["version"] not in range(1, VERSION + 1):
                raise CalibrationError(
                    f"{path} has version {shown(content['version'])} of {FORMAT}, this Turbo-Pi reads versions 1 to "
                    f"{VERSION}. Run `turbopi calibrate` again"
                )
            numbers = content.get("numbers", "fp8")
            _expect(isinstance(numbers, str) and numbers in FORMATS, "numbers", f"one of {', '.join(FORMATS)}", numbers)
            for name in ("sites", "shapes", "report"):
                _expect(isinstance(content[name], dict), name, "an object", content[name])
            report = content["report"]
            _expect(isinstance(content["weights_sha256"], str), "weights_sha256", "text", content["weights_sha256"])
            source, warnings = report["observations"]["source"], report.get("warnings", [])
            _expect(isinstance(source, str), "the source of observations", "text", source)
            for name, kind in (("calibration", dict), ("count", int)):
                value = report["observations"].get(name, kind())
                _expect(isinstance(value, kind), f"{name} of the observations", f"of type {kind.__name__}", value)
            listed = isinstance(warnings, list) and all(isinstance(one, str) for one in warnings)
            _expect(listed, "warnings", "a list of texts", warnings)
            found = {name: SiteScale.from_json(values) for name, values in content["sites"].items()}
            return cls(content["weights_sha256"], content["shapes"], found, report, numbers, source=str(path))
        except CalibrationError:
            raise
        except _UNSOUND as error:
            raise CalibrationError(
                f"{path} isn't a calibration that `turbopi calibrate` wrote: {type(error).__name__} {one_line(error)}"
            ) from error


_UNSOUND = (KeyError, TypeError, ValueError, OverflowError, RuntimeError)  # the last: tensors, or nested too deeply
_MAX_BYTES = 512 * 2**20  # the directions of a full-size model are most of it
_SCALES = (1e-30, 1e30)  # of an activation; further out float32 has no room for products


def _differences(theirs: Mapping[str, Any], ours: Mapping[str, Any], within: str = "") -> Iterator[str]:
    """In words, each size of ours that isn't theirs."""
    for name, here in ours.items():
        there = theirs.get(name)
        if isinstance(here, Mapping) and isinstance(there, Mapping):
            yield from _differences(there, here, f"{within}{name}.")
        elif there != here:
            yield f"{within}{name} is {shown(there)} there and {shown(here)} here"


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _expect(right: bool, name: str, expected: str, got: Any) -> None:
    if not right:
        raise ValueError(f"{name} {shown(got)} should be {expected}")


def _bytes(codes: torch.Tensor) -> bytes:
    return codes.contiguous().view(torch.uint8).numpy().tobytes()


def shapes_of(config: Stacks) -> dict[str, Any]:
    """The sizes that scales depend on, as JSON gives them back. Horizon and prompt length aren't among them."""
    return {
        "kind": config.kind,
        "vision": asdict(config.vision),
        "vlm": asdict(config.vlm),
        "expert": asdict(config.expert),
        "action_dim": config.action_dim,
    }


def check_given(precision: str, quantization: "str | Path | Quantization | None") -> None:
    """Raise ConfigError unless a calibration is given exactly where the precision needs one."""
    if precision not in TIERS and quantization is not None:
        raise ConfigError(f"precision {precision!r} takes no calibration; with one take {' or '.join(TIERS)}")
    if precision in TIERS and quantization is None:
        raise ConfigError(
            f"precision {precision!r} needs a calibration; make one with `turbopi calibrate --precision "
            f"{format_of(precision).name}` and give it as `quantization`"
        )
