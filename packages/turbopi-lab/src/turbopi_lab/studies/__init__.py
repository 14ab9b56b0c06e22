"""Research: one file a question, with what it takes to answer it again.

Each study gives a `Report` (report.py): question, method, controls, tables, plots, verdict, what would change it. The
questions, by the name that `turbopi study` takes, are in STUDIES; the reports that stand are in docs/research.md.

study.py                what a study is and is given
solvers.py, spread.py   cells of solvers and time grids; how broad a policy's actions are
rollouts.py, post.py    closed loop on toy tasks; the task with two ways
simulated.py            variants of a policy in the episodes of `turbopi eval`: what studies on LIBERO share
answering.py            a study's own function in a policy's model's place, told of episodes
problems.py             batches with exact solutions
formats.py, weights.py  emulated number formats; kinds of weights
certificates.py         FP8's certificates at full size, without a checkpoint: no question, a tool
"""

import importlib
from collections.abc import Iterable
from typing import TYPE_CHECKING

from turbopi.support.errors import ConfigError

if TYPE_CHECKING:
    from turbopi_lab.studies.study import Study

STUDIES: dict[str, str] = {  # name -> what it asks, in a few words; modules are imported when they are asked for
    "steps": "how few denoising steps are enough, and with which solver",
    "distillation": "one denoising step by distillation",
    "kv_reuse": "keys and values of old images, reused while new ones look alike",
    "fp8_and_fp4": "numbers of eight and four bits",
    "noise_choice": "noise chosen so that a chunk continues the running one",
    "pipelining": "the next observation encoded beside this one's denoising",
    "steps_libero": "steps on LIBERO (any checkpoint for it; else the small policy)",
    "kv_reuse_libero": "kv_reuse on LIBERO",
    "fp8_and_fp4_libero": "fp8_and_fp4 on LIBERO",
    "mask_libero": "mask on LIBERO",
    "mask": "a padded cache without its mask (any checkpoint, and toy tasks)",
    "precision": "attention and precisions inside TensorRT (any checkpoint)",
    "actions": "what backends do to actions (any checkpoint; TensorRT)",
    "throughput": "several observations in flight (any checkpoint; TensorRT)",
}
OF_CHECKPOINTS = ("mask", "precision", "actions", "throughput")


def check_names(names: Iterable[str]) -> None:
    """Raises ConfigError, listing the choices, for a name that no study has."""
    for name in names:
        if name not in STUDIES:
            raise ConfigError(f"unknown study {name!r}; choose of {', '.join(STUDIES)}")


def load(name: str) -> "Study":
    """The study called `name`, one of STUDIES."""
    study: Study = importlib.import_module(f"turbopi_lab.studies.{name}").STUDY
    return study
