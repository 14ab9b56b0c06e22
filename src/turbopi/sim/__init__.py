"""Simulators by name. Each one's module is imported when it is asked for, so that its libraries hurt only its users."""

import importlib
from typing import Any

from turbopi.sim.base import Environment, SimSettings, Simulator, SimulatorUnavailable, Task
from turbopi.support.errors import ConfigError

__all__ = ["SIMULATORS", "Environment", "SimSettings", "Simulator", "SimulatorUnavailable", "Task", "create"]

SIMULATORS: dict[str, str] = {
    "libero": "turbopi.sim.libero:LiberoSimulator",
    "reacher": "turbopi.sim.reacher:ReacherSimulator",
    "chase": "turbopi.sim.chase:ChaseSimulator",
}

_PARTS = (*Simulator.__annotations__, "check", "tasks", "open", "example", "versions")


def create(name: str) -> Simulator:
    """The simulator called `name`, one of SIMULATORS, or "module:Class" for one of your own, whose code is run.

    Raises ConfigError for an unknown name, and for a class that can't be imported or made, or isn't a simulator.
    Nothing of one of ours is imported yet: see `Simulator.check`.
    """
    target = SIMULATORS.get(name, name)
    module, _, cls = target.partition(":")
    if not cls:
        raise ConfigError(f"unknown simulator {name!r}; choose one of {', '.join(SIMULATORS)}")
    try:
        made: Any = getattr(importlib.import_module(module), cls)()
    except Exception as error:  # whatever code of the user's own raises
        raise ConfigError(f"the simulator {name!r} can't be imported: {type(error).__name__}: {error}") from error
    missing = [part for part in _PARTS if not hasattr(made, part)]
    if missing:
        raise ConfigError(f"{name!r} is no simulator: it has no {', '.join(missing)}; see turbopi.sim.base.Simulator")
    if not made.suites:
        raise ConfigError(f"{name!r} has no suites: it should have the name of one suite of tasks or more")
    simulator: Simulator = made
    return simulator
