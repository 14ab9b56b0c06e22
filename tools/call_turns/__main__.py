"""Time variants of a whole call in turns, and write the timeline of one. Run from the repository, on a Hopper GPU:

    export PYTHONPATH=src:tools
    python -m call_turns --precisions bf16,fp8 --calls 300 --out FOLDER

Weights are random. FP8 takes a calibration file's scales without directions: its times are those of any calibration.
A variant is what VARIANTS has; each is captured once, and in every round has its share of the calls. The first one is
what the others are compared with.
"""

import argparse
import dataclasses
import statistics
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from call_turns.timeline import in_full, profiled, steps, summary
from turbopi.backends import Precision, resolve_device
from turbopi.backends.fused import FusedBackend
from turbopi.bench.measure import Observations, bench_policy
from turbopi.bench.profile import start_profiler
from turbopi.bench.work import Job
from turbopi.checkpoint import random_checkpoint
from turbopi.engine.schedule import SCHEDULE, Schedule
from turbopi.kernels.ops import fused_ops
from turbopi.kernels.sm90 import ops as hopper
from turbopi.kernels.sm90.attention import kernel as attention
from turbopi.kernels.tile_table import LIBRARY, Knobs, Numbers, TileKey, TileTable
from turbopi.observation import Observation
from turbopi.policy import UnifiedPolicy
from turbopi.quantization.calibration_file import Quantization

CALIBRATION = Path("benchmarks/results/h200_2026-11-24_pi05_libero/calibrate.json")
ROUNDS, PROFILED = 6, 5
TIMES = ("total", "infer", "preprocess", "postprocess", "vision", "prefix", "denoise", "device")
COMPARED = ("kv_k", "kv_v", "actions")
Outputs = list[dict[str, torch.Tensor]]  # by observation: what COMPARED names
STATE = ("_ops", "_graphs", "_calls", "_pictures", "_begun")  # of a runner, by variant


def _tile(
    numbers: Numbers, operation: str, out: int, inner: int, rows: int = 576, **knobs: int
) -> tuple[TileKey, Knobs]:
    usual = {"cluster_m": 1, "cluster_n": 1, "splits": 1, "overlap": 0, "ring": 16, "gather": 0}
    return TileKey("hopper", operation, numbers, rows, out, inner), usual | knobs


TABLES = {
    "usual": TileTable(),
    # benchmarks/results/h200_2026-11-26_tune, where they are faster than the usual ones
    "tuned": TileTable(
        dict(
            (
                _tile("bf16", "plain", 2560, 2048, warpgroups=3, columns=64),
                _tile("bf16", "parts", 2048, 2048, warpgroups=3, columns=96, splits=2, ring=5),
                _tile("bf16", "plain", 512, 2048, warpgroups=1, columns=48),
                _tile("bf16", "residual", 1152, 1152, 512, warpgroups=1, columns=80),
                _tile("bf16", "bias", 2048, 1152, 512, warpgroups=1, columns=128, cluster_m=2),
                _tile("fp8", "plain", 512, 2048, warpgroups=1, columns=64),
                _tile("fp8", "gelu", 4304, 1152, 512, warpgroups=2, columns=144, cluster_m=2),
            )
        )
    ),
    # cuBLAS's two parts at once were 1.1 us faster alone; a pair of blocks that share rows takes 43 bytes a cycle from
    # L2 instead of 64
    "down": TileTable(
        dict(
            (
                (TileKey("hopper", "parts", "bf16", 576, 2048, 16384), {LIBRARY: 2}),
                _tile("fp8", "parts", 2048, 16384, warpgroups=3, columns=96, splits=2, cluster_n=2),
            )
        )
    ),
    "out": TileTable(  # as many results a block as the usual one in FP8, fewer bytes of operands
        dict(_tile(numbers, "parts", 2048, 2048, warpgroups=2, columns=80) for numbers in ("bf16", "fp8"))
    ),
}


@dataclass(frozen=True)
class Variant:
    """What differs from the calls as they are."""

    schedule: Mapping[str, bool] = field(default_factory=dict)
    ahead: bool = False
    norms: bool = False
    rope: bool = False
    tiles: str = "usual"  # of TABLES
    keys: int = 64  # of prefix attention


ENDS = {"ends_by_kernel": True}
VARIANTS = {
    "as is": Variant(),
    "ends by kernel": Variant(ENDS),
    "prompt beside": Variant({"prompt_beside_vision": True}),
    "keys beside": Variant({"keys_beside_prefix": True}),
    "vision in two": Variant({"vision_in_two": True}),
    "marks aside": Variant({"marks_aside": True}),
    "ahead": Variant(ahead=True),
    "tiles": Variant(tiles="tuned"),
    "tiles of down": Variant(tiles="down"),
    "tiles of out": Variant(tiles="out"),
    "48 keys": Variant(keys=48),
    "96 keys": Variant(keys=96),
    "tiles and ahead": Variant(ahead=True, tiles="tuned"),
    "norms": Variant(norms=True),
    "rope": Variant(rope=True),
    "all but marks": Variant(
        {one.name: one.name != "marks_aside" for one in dataclasses.fields(Schedule)},
        ahead=True,
        norms=True,
        rope=True,
        tiles="tuned",
    ),
    "all": Variant(
        {one.name: True for one in dataclasses.fields(Schedule)}, ahead=True, norms=True, rope=True, tiles="tuned"
    ),
}


class Turns:
    """One policy whose runner takes on each variant's graphs and operations in turn."""

    def __init__(self, precision: Precision, job: Job) -> None:
        checkpoint, quantization = random_checkpoint("pi05_libero"), None
        if precision == "fp8":
            quantization = Quantization.load(CALIBRATION)
            checkpoint.__dict__["_fingerprint"] = quantization.fingerprint  # hashing all weights takes a minute
        self.policy: UnifiedPolicy = bench_policy(
            checkpoint,
            "fused",
            precision,
            resolve_device("cuda"),
            job,
            quantization=quantization,  # type: ignore[arg-type]
        )
        assert isinstance(self.policy.backend, FusedBackend)
        self.backend, self.job = self.policy.backend, job
        self.observations = Observations(self.policy, job)
        self._kept: dict[str, dict[str, Any]] = {}
        self._ops = {(False, False, False, "usual"): self.backend._ops}

    def take(self, name: str) -> None:
        """From now on the policy is this variant."""
        if name not in self._kept:
            variant = VARIANTS[name]
            for one in dataclasses.fields(Schedule):
                setattr(SCHEDULE, one.name, variant.schedule.get(one.name, False))
            attention.KEYS = variant.keys
            key = (variant.ahead, variant.norms, variant.rope, variant.tiles)
            if key not in self._ops:
                hopper.WEIGHTS_AHEAD, hopper.NORMS_IN_PRODUCTS, hopper.ROPE_IN_PRODUCTS = key[:3]
                self._ops[key] = fused_ops(self.backend.device, TABLES[variant.tiles])
                hopper.WEIGHTS_AHEAD = hopper.NORMS_IN_PRODUCTS = hopper.ROPE_IN_PRODUCTS = False
            self._kept[name] = {"_ops": self._ops[key], "_graphs": {}, "_calls": {}, "_pictures": {}, "_begun": None}
        for attribute in STATE:
            setattr(self.backend, attribute, self._kept[name][attribute])

    def call(self) -> dict[str, float]:
        timing: dict[str, float] = self.policy.infer(next(self.observations), num_steps=self.job.steps)["policy_timing"]
        found = {name.removesuffix("_ms"): milliseconds for name, milliseconds in timing.items()}
        return found | {"device": sum(found[stage] for stage in ("vision", "prefix", "denoise"))}

    def outputs(self) -> Outputs:
        return outputs(self.policy, self.job)


def outputs(policy: UnifiedPolicy, job: Job) -> Outputs:
    """What becomes of two observations that are the same for every policy."""
    source, found = Observations(policy, job, seed=1), []
    for seed in range(2):
        shape = (1, job.horizon, policy.config.model.action_dim)
        noise = torch.from_numpy(np.random.default_rng(seed).standard_normal(shape, dtype=np.float32))
        seen = Observation.stack([policy.prepare(next(source))])
        trace = policy.backend.intermediates(seen, noise, job.steps)
        cameras = seen.image_mask[0].repeat_interleave(policy.config.model.vision.num_tokens)
        valid = torch.cat((cameras, seen.token_mask[0]))
        made = {name: trace[name].float().cpu() for name in COMPARED}
        found.append({name: one if name == "actions" else one[:, :, valid] for name, one in made.items()})
    return found


def exact_outputs(job: Job) -> Outputs:
    """The same in float32."""
    policy = bench_policy(random_checkpoint("pi05_libero"), "pytorch", "f32", resolve_device("cuda"), job)
    found = outputs(policy, job)
    del policy
    torch.cuda.empty_cache()
    return found


def compared(ours: Outputs, usual: Outputs, exact: Outputs) -> str:
    """Whether they are the usual bits, and the relative rms errors of keys, values and actions against float32."""
    pairs = list(zip(ours, usual, exact, strict=True))
    same = all(torch.equal(one[name], other[name]) for one, other, _ in pairs for name in COMPARED)

    def error(name: str) -> float:
        off = sum(float((one[name] - right[name]).square().sum()) for one, _, right in pairs)
        return float((off / sum(float(right[name].square().sum()) for *_, right in pairs)) ** 0.5)

    errors = ", ".join(f"{name} {error(name):.5f}" for name in COMPARED)
    return f"{'the same bits' if same else 'other bits'}; {errors}"


def timed(turns: Turns, names: list[str], calls: int) -> dict[str, dict[str, float]]:
    """Medians by variant, milliseconds."""
    found: dict[str, list[dict[str, float]]] = {name: [] for name in names}
    for turn in range(ROUNDS):
        for name in names[turn % len(names) :] + names[: turn % len(names)]:
            turns.take(name)
            for i in range(calls // ROUNDS + 3):
                timing = turns.call()
                if i >= 3:
                    found[name].append(timing)
    return {name: {key: statistics.median(one[key] for one in rows) for key in TIMES} for name, rows in found.items()}


def report(turns: Turns, names: list[str], calls: int, exact: Outputs) -> Iterator[str]:
    usual: Outputs = []
    differs, working = {}, []
    for name in names:
        start = time.perf_counter()
        turns.take(name)
        try:
            turns.call()
            made = turns.outputs()
        except Exception as error:  # one try that fails doesn't cost the others their turn
            yield f"{name}: FAILED, {type(error).__name__}: {error}"
            if name == names[0]:
                raise
            continue
        usual = usual or made
        differs[name] = compared(made, usual, exact)
        working.append(name)
        yield f"({name} captured in {time.perf_counter() - start:.1f} s)"
    rows = timed(turns, working, calls)
    yield f"{'ms, medians':16}" + "".join(f"{key:>12}" for key in TIMES) + "  bits of the first one? errors"
    for name, row in rows.items():
        yield f"{name:16}" + "".join(f"{row[key]:12.4f}" for key in TIMES) + f"  {differs[name]}"
    yield "against the first one, us; negative is faster"
    for name, row in rows.items():
        yield f"{name:16}" + "".join(f"{(row[key] - rows[working[0]][key]) * 1e3:12.1f}" for key in TIMES)


def timelines(turns: Turns, names: list[str]) -> Iterator[str]:
    for name in names:
        turns.take(name)
        for _ in range(20):  # the clock and caches as in a row of calls
            turns.call()
        ran, host = zip(*(profiled(turns.call) for _ in range(PROFILED)), strict=True)
        try:
            found = steps(ran)
        except ValueError as error:
            yield f"timeline of {name!r}: {error}"
            found = steps(ran[:1])
        yield f"\n==== {name}: by kernel, us, medians of {PROFILED} calls; step: from the end before to its end"
        yield from summary(found)
        yield "---- in order"
        yield from in_full(found)
        yield "---- CUDA calls of the host in the last one (start against the first kernel, us)"
        for what, start, duration in host[-1]:
            yield f"{what:40} {start:10.1f} {duration:8.1f}"


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m call_turns", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--precisions", default="bf16,fp8")
    parser.add_argument("--cameras", type=int, default=2)
    parser.add_argument("--calls", type=int, default=300, help="of each variant")
    parser.add_argument("--variants", default=",".join(VARIANTS), help="by comma")
    parser.add_argument("--timelines", default="as is,all", help="of these variants; empty: of none")
    parser.add_argument("--out", type=Path, required=True, help="folder for turns.txt and timeline.txt")
    arguments = parser.parse_args()
    precisions: list[Precision] = arguments.precisions.split(",")
    names = [name.strip() for name in arguments.variants.split(",")]
    profiles = [name.strip() for name in arguments.timelines.split(",") if name.strip()]
    arguments.out.mkdir(parents=True, exist_ok=True)
    start_profiler(resolve_device("cuda"))
    job = Job(cameras=arguments.cameras)
    exact = exact_outputs(job)
    with (arguments.out / "turns.txt").open("w") as text, (arguments.out / "timeline.txt").open("w") as order:
        for precision in precisions:
            _write(text, _told(precision, job, exact, names, profiles, arguments.calls, order))


def _told(
    precision: Precision, job: Job, exact: Outputs, names: list[str], profiles: list[str], calls: int, order: Any
) -> Iterator[str]:
    """Kernels that no GPU has run yet come last: an error in one may be for good, and the rest has been told then."""
    start, told = time.perf_counter(), set[str]()
    turns = Turns(precision, job)
    clock: Callable[[], str] = lambda: f"{time.perf_counter() - start:.1f} s"  # noqa: E731
    yield f"\n{precision}, {turns.job}, {torch.cuda.get_device_name()}, torch {torch.__version__}; loaded in {clock()}"
    print(f"# {precision} timelines", file=order)
    kernels = [name for name in names if VARIANTS[name].norms or VARIANTS[name].rope]
    others = [name for name in names if name not in kernels]
    for these in (others, [*others[:1], *kernels]) if kernels else (others,):
        yield from report(turns, these, calls, exact)
        for line in timelines(turns, [name for name in profiles if name in these and name not in told]):
            print(line, file=order, flush=True)
        told.update(these)
    yield f"({precision} took {clock()})"
    del turns
    torch.cuda.empty_cache()


def _write(text: Any, lines: Iterator[str]) -> None:
    for line in lines:
        print(line, flush=True)
        print(line, file=text, flush=True)


if __name__ == "__main__":
    main()
