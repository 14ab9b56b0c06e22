"""What several test files share, which is in shared.py, and what every run of the tests says."""

from collections import defaultdict
from pathlib import Path

import gpu_evidence
import pytest
from shared import (  # noqa: F401
    GOLDEN,
    TWO_LAYERS,
    _own_fingerprints,
    cubins,
    drawn,
    golden,
    golden_cases,
    golden_folder,
    golden_model,
    gpu_or_interpreter,
    on_hopper,
    packed_arrays,
    two_layers,
    two_threads,
    unseen_plots,
)

# Those that take longest, longest first.
LONGEST = (
    *("test_serve_fleet_faults", "test_sim_libero", "test_tutorial", "test_onnx", "test_backends", "test_gpu_evidence"),
    *("test_engine_backward", "test_kernels_portable_denoise_emulated", "test_examples", "test_studies_simulated"),
    *("test_kernels_attention_emulated", "test_engine_batch_conditioned", "test_kernels_emulated", "test_engine"),
    *("test_kernels_denoise_emulated", "test_emulated_fp8", "test_checkpoint_memory", "test_bench", "test_calibrate"),
    *("test_kernels_denoise_by_token", "test_serve_schedule", "test_kernels_denoise", "test_onnx_fp8"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """No process shall begin a long file when the others are done."""
    place = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(LONGEST)))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say at the end of every run what was skipped, and whether the GPU tests were run on this code."""
    waiting = gpu_evidence.pending()
    if waiting is not None:
        terminalreporter.section("THE GPU TESTS WERE NOT RUN ON THIS CODE", red=True, bold=True)
        terminalreporter.line(f"since {waiting.date}: {waiting.reason}. Run scripts/gpu_check on a Hopper GPU.")
    skipped = defaultdict[str, list[str]](list)
    for report in terminalreporter.stats.get("skipped", ()):
        file, _, reason = report.longrepr
        skipped[reason.removeprefix("Skipped: ").partition("; ")[0]].append(Path(file).stem)
    if skipped:
        terminalreporter.section("what was skipped, and why")
    for reason, files in sorted(skipped.items()):
        terminalreporter.line(f"skipped: {len(files)} of {', '.join(sorted(set(files)))}: {reason}")
