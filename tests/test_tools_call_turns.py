"""The timeline of a call: an order by ends, medians over calls, and steps that add up."""

from typing import Any

import pytest
from call_turns.timeline import in_full, in_order, shortened, steps, summary


def event(name: str, start: float, duration: float, category: str = "kernel") -> dict[str, Any]:
    return {"cat": category, "name": name, "ts": start, "dur": duration, "args": {"grid": [2, 1, 1], "stream": 7}}


def call(late: float = 0.0) -> list[dict[str, Any]]:
    return [
        event("cudaGraphLaunch", 95, 4, "cuda_runtime"),
        event("gemm", 112, 10 + late),  # launched early: it waits for the norm
        event("norm", 100, 15),
        event("Memcpy DtoH", 125 + late, 2, "gpu_memcpy"),
        event("aten::copy_", 90, 40, "cpu_op"),
    ]


def test_steps_add_up_to_the_whole_call_also_where_kernels_overlap() -> None:
    ran, host = in_order(call())
    assert [one.name for one in ran] == ["norm", "gemm", "Memcpy DtoH"]
    assert host == [("cudaGraphLaunch", -5, 4)]
    found = steps([ran])
    assert [(one.step, one.gap, one.duration) for one in found] == [(15, 0, 15), (7, -3, 10), (5, 3, 2)]
    assert sum(one.step for one in found) == 27


def test_several_calls_give_medians_and_must_have_run_the_same() -> None:
    calls = [in_order(call(late))[0] for late in (0, 2, 9)]
    assert [one.step for one in steps(calls)] == [15, 9, 5]
    with pytest.raises(ValueError, match="calls ran"):
        steps([calls[0], calls[1][:-1]])


def test_the_summary_counts_a_kernel_by_what_ran_before_it() -> None:
    found = steps([in_order([*call(), event("gemm", 130, 6)])[0]])
    lines = list(summary(found))
    assert sum("gemm" in line[:10] for line in lines) == 2
    assert lines[-1] == "all: 36.0 us, 4 kernels and copies"
    assert len(list(in_full(found))) == 5


def test_names_of_the_library_are_shortened() -> None:
    assert shortened("void cutlass::Kernel2<cutlass::gemm<int, 2>>(Params)") == "Kernel2"
    assert shortened("_rms_norm_kernel") == "_rms_norm_kernel"
