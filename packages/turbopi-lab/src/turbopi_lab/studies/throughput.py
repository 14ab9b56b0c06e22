"""What do several observations in flight give? One at a time through `tensorrt`, several through
`tensorrt_pipelined`.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from msgspec import Struct, field

from turbopi.policy.policy import UnifiedPolicy
from turbopi.support.reading import plain_document
from turbopi_lab.studies.report import Cell, Control, Grid, Panel, Plot, Report, Series
from turbopi_lab.studies.study import Setup, Study

Timings = dict[str, float]  # medians, e.g. "total_ms", and "per_second": observations


class Throughput(Struct, frozen=True):
    calls: int
    one_at_a_time: dict[str, Timings] = field(name="one at a time")  # by backend
    in_flight: Timings = field(name="in flight")
    actions_equal_bit_for_bit: bool


def throughput_study(
    plain: UnifiedPolicy, pipelined: UnifiedPolicy, observations: Sequence[Any], calls: int
) -> Throughput:
    """Latency of one call at a time through both, throughput of calls in flight, and whether the actions are the same.

    Both run the same observations and noise in turn; the pipelined policy's backend has `submit`. Milliseconds are
    from host to host, throughput is observations a second.
    """
    seeds = range(len(observations))

    def one_at_a_time(policy: UnifiedPolicy) -> tuple[list[np.ndarray], Timings]:
        for obs, seed in zip(observations, seeds, strict=True):  # warm, and the actions to compare with
            policy.infer(obs, seed=seed)
        results, start = [], time.perf_counter()
        for i in range(calls):
            results.append(policy.infer(observations[i % len(observations)], seed=i % len(observations)))
        seconds = time.perf_counter() - start
        return [one["actions"] for one in results], {**_medians(results), "per_second": calls / seconds}

    expected, alone = one_at_a_time(plain)
    again, pipelined_alone = one_at_a_time(pipelined)
    start = time.perf_counter()
    futures = [pipelined.submit(observations[i % len(seeds)], seed=i % len(seeds)) for i in range(calls)]
    flown = [future.result() for future in futures]
    seconds = time.perf_counter() - start
    equal = all(
        np.array_equal(a, b) and np.array_equal(a, c["actions"]) for a, b, c in zip(expected, again, flown, strict=True)
    )
    return Throughput(
        calls,
        {plain.backend.name: alone, pipelined.backend.name: pipelined_alone},
        {**_medians(flown), "per_second": calls / seconds},
        equal,
    )


def _medians(results: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Of every timing of some calls."""
    names = results[0]["policy_timing"]
    return {name: float(np.median([one["policy_timing"][name] for one in results])) for name in names}


def run(setup: Setup) -> Report:
    checkpoint = setup.needed_checkpoint("throughput")
    policies = []
    for name in ("tensorrt", "tensorrt_pipelined"):
        options = {"backend": name, "device": setup.device, "num_denoising_steps": setup.steps}
        policies.append(UnifiedPolicy(checkpoint, **options))  # type: ignore[arg-type]
        policies[-1].warmup()
    given, source = setup.observations(policies[0])
    found = throughput_study(policies[0], policies[1], given, setup.calls)
    of = f"{policies[0].config.name}, {source}, {setup.calls} calls, {setup.steps} steps, host to host"
    return _report(setup, found, of)


def _report(setup: Setup, found: Throughput, of: str) -> Report:
    lines = {f"{name}, one at a time": one for name, one in found.one_at_a_time.items()} | {
        "in flight": found.in_flight
    }
    rows: list[list[Cell]] = [[name, one["total_ms"], one["per_second"]] for name, one in lines.items()]
    alone, flown = found.one_at_a_time["tensorrt"], found.in_flight
    series = [Series(name, [one["total_ms"]], [one["per_second"]]) for name, one in lines.items()]
    return setup.report(
        STUDY,
        method=f"{of}.",
        controls=[
            Control("The actions of all three are equal, bit for bit.", found.actions_equal_bit_for_bit, ""),
        ],
        tables=[Grid("Two observations in flight", ["how", "latency, ms, median", "observations a second"], rows)],
        plots=[Plot("throughput", [Panel("In flight", "latency, ms", "observations a second", series)])],
        verdict=(
            f"In flight {flown['per_second']:.1f} observations a second at {flown['total_ms']:.2f} ms, one at a time "
            f"{alone['per_second']:.1f} at {alone['total_ms']:.2f} ms."
        ),
        would_change="A GPU that one observation doesn't fill, or batches: `turbopi bench` measures those.",
        not_run=[],
        data={"throughput": plain_document(found)},
    )


STUDY = Study(
    "throughput",
    "What do several observations in flight give?",
    "The pipelined backend has the throughput of its slowest stage.",
    run,
    needs_tensorrt=True,
)
