"""What several test files share, which is in shared.py, and what every run of the tests says."""

import gpu_evidence
import pytest
from shared import (  # noqa: F401
    GOLDEN,
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
)

# Files about the fast path that take seconds, without a GPU or a compiler: `scripts/test -m quick`.
QUICK = (
    *("test_backend_choice", "test_capture", "test_fused_choice", "test_kernels_arguments", "test_kernels_launch"),
    *("test_graph_cache", "test_launch_geometry", "test_tools_mutate"),
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    for item in items:
        if item.path.stem in QUICK and item.get_closest_marker("gpu") is None:
            item.add_marker(pytest.mark.quick)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say at the end of every run that the GPU tests weren't run on this code, if that is so."""
    waiting = gpu_evidence.pending()
    if waiting is not None:
        terminalreporter.section("THE GPU TESTS WERE NOT RUN ON THIS CODE", red=True, bold=True)
        terminalreporter.line(f"since {waiting.date}: {waiting.reason}. Run scripts/gpu_check on a Hopper GPU.")
