"""The process that qualifies a GPU imports this on a machine without one: PyTorch's backend stands for `fused`."""

import sys
from typing import Any

import torch

from turbopi.backends import BACKENDS, BackendSpec
from turbopi.qualify import run
from turbopi.qualify import stages as module

stages: Any = module
stages.check_barrier, stages.barrier_us = lambda device: None, lambda device: 1.25
stages.hopper_kernels = lambda *given: False
stages.RACE_TURNS, stages.CALLS, stages.OBSERVATIONS, stages.NOISES = 2, 1, 1, 1
run.golden = lambda subject: None
for name in ("fused", "cuda_graph"):
    BACKENDS[name] = BackendSpec(name, "turbopi.backends.pytorch", "PyTorchBackend", "a stand-in")
main: Any = sys.modules["__main__"]
usual = main.Subject
main.Subject = lambda model, precision, device, *given, **named: usual(
    model, precision, torch.device("cpu"), *given, **named
)
