"""Simulators by name. Each one's module is imported when it is asked for, so that its libraries hurt only its users."""

import importlib
from typing import Any

from turbopi.errors import ConfigError
from turbopi.sim.base import Environment, SimSettings, Simulator, SimulatorUnavailable, Task

__all__ = ["SIMULATORS", "Environment", "SimSettings", "Simulator", "SimulatorUnavailable", "Task", "create"]

SIMULATORS: dict[str, str] = {
    "libero": "turbopi.sim.libero:LiberoSimulator",
    "reacher": "turbopi.sim.reacher:ReacherSimulator",
}


def create(name: str) -> Simulator:
    """The simulator called `name`, one of SIMULATORS, or "module:Class" for one of your own, whose code is run.

    Raises ConfigError for an unknown name. Nothing of the simulator itself is imported yet: see `Simulator.check`.
    """
    target = SIMULATORS.get(name, name)
    module, _, cls = target.partition(":")
    if not cls:
        raise ConfigError(f"unknown simulator {name!r}; choose one of {', '.join(SIMULATORS)}")
    try:
        made: Any = getattr(importlib.import_module(module), cls)()
    except (ImportError, AttributeError) as error:
        raise ConfigError(f"the simulator {name!r} can't be imported: {error}") from error
    simulator: Simulator = made
    return simulator
