"""All stages in order. What isn't right and has another path beside it is excluded, and the stage begins again."""

import time
from collections.abc import Callable
from typing import Any

import torch

from turbopi.backends import qualification
from turbopi.backends.qualification import Stage
from turbopi.backends.qualifying import STAGES, Event
from turbopi.checkpoint.random_weights import random_checkpoint
from turbopi.qualify.ahead import Ahead
from turbopi.qualify.stages import (
    COMPILING,
    Faulty,
    Figures,
    Subject,
    certify,
    check_grid,
    check_kernels,
    free,
    golden,
    race,
    shallow,
)
from turbopi.support.text import significant

Say = Callable[[Event], None]
BUSY_DEVICE = "busy or unavailable"  # of CUDA's error where another process has the GPU for itself


def run(subject: Subject, say: Say, beside: Ahead | None = None) -> bool:
    """Whether it came to a verdict. Failures are said; those that nobody expected are raised, too.

    beside: the process that works ahead.
    """
    try:
        run_stages(subject, say, beside)
        return True
    except Faulty as fault:
        say(Event(failed=str(fault)))
    except torch.OutOfMemoryError as failure:
        say(Event(failed=f"the GPU's memory isn't enough: {str(failure).splitlines()[0]}", transient=True))
    except Exception as failure:
        line = next(iter(str(failure).splitlines()), "") or type(failure).__name__
        say(Event(failed=line, transient=BUSY_DEVICE in line))
        raise
    return False


def run_stages(subject: Subject, say: Say, beside: Ahead | None) -> None:
    """Raises Faulty for what isn't right and has no other path beside it."""
    qualification.under_test = subject.excluded  # which the backends of this process look at

    def exclude(path: str, why: str) -> None:
        subject.excluded[path] = why
        say(Event(excluded={path: why}))

    def stage(name: str, work: Callable[[], Figures], text: Callable[[Figures], str]) -> None:
        began = time.monotonic()
        subject.at(name, "", COMPILING)
        while True:
            try:
                figures = work()
                break
            except Faulty as fault:
                if not fault.path or fault.path in subject.excluded:
                    raise
                exclude(fault.path, str(fault))
            except torch.OutOfMemoryError:
                if beside is None or not beside.stop():
                    raise
            free(subject.device)
        seconds = round(time.monotonic() - began, 2)
        say(Event(stage=Stage(name=name, seconds=seconds, text=text(figures), figures=figures)))

    def kernels() -> Figures:
        compared = check_kernels(subject, small, calibration)
        for name, why in compared.failed.items():
            exclude(name, f"beside PyTorch's, {why}")
        return kernels() if compared.failed else compared.errors

    stage(STAGES[0], lambda: check_grid(subject), lambda found: "holds" if found else "left out")
    small = random_checkpoint(subject.policy_config(shallow(subject.model)))
    calibration = subject.quantization(small)
    stage(STAGES[1], kernels, lambda errors: f"{len(errors)} operations equal PyTorch's")
    stage(STAGES[2], lambda: certify(subject, small, calibration), _worst)

    if (policy := golden(subject)) is not None:
        stage(STAGES[3], lambda: certify(subject, policy, subject.quantization(policy)), _worst)

    def timed() -> Figures:
        raced = race(subject, calibration, beside.rival if beside is not None else lambda: None)
        figures = {f"{name} ms": times["total"] for name, times in raced.milliseconds.items()}
        reason = f"right; {_times(figures)}" + (f" ({raced.note})" if raced.note else "")
        taken: Any = subject.name if raced.wins else subject.rival
        say(Event(milliseconds=raced.milliseconds, memory=raced.memory, taken=taken, reason=reason))
        return figures

    stage(STAGES[4], timed, _times)
    say(Event(done=True))


def _times(figures: Figures) -> str:
    return ", and ".join(f"{name.removesuffix(' ms')} {ms:.2f} ms" for name, ms in figures.items())


def _worst(figures: Figures) -> str:
    return f"errors are at most {significant(max(figures.values()))} of what is allowed"
