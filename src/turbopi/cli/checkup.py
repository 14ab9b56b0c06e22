"""A line of `turbopi doctor`'s report, and what several checks need."""

import importlib
from dataclasses import dataclass
from typing import Any, Literal

from turbopi.cli.process import slow_import_reported

Level = Literal["OK", "WARN", "FAIL"]

# Weights of the full-size model (docs: 3.617 B parameters)
FULL_SIZE_GB = {"bf16": 7.2, "f32": 14.5}


@dataclass(frozen=True)
class Row:
    """One line of the report; `fix` is empty if there is nothing to do."""

    level: Level
    name: str
    found: str
    fix: str = ""


def imported_torch() -> Any:
    """PyTorch, or None where it can't be imported (check_torch says so)."""
    try:
        with slow_import_reported():
            return importlib.import_module("torch")
    except Exception:
        return None


def has_gpu() -> bool:
    torch = imported_torch()
    return torch is not None and bool(torch.cuda.is_available())
