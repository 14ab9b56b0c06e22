"""Robots: keys in, keys out. The built-in ones have openpi's and LeRobot's keys; docs/robots.md describes one's own."""

import dataclasses
import importlib
import traceback
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from turbopi.robots.aloha import Aloha
from turbopi.robots.base import Robot, RobotInputs, find, has, optional_prompt, read_prompt, read_state, require
from turbopi.robots.described import Described, load_robot, robot_from_dict
from turbopi.robots.droid import Droid
from turbopi.robots.images import parse_chw_image, parse_image, parse_unit_image
from turbopi.robots.lerobot import LeRobot
from turbopi.robots.libero import Libero
from turbopi.robots.plain import Plain
from turbopi.robots.raw_keys import ROBOT_TYPES, raw_description
from turbopi.support.errors import ConfigError

__all__ = [
    "ROBOTS",
    "Described",
    "Plain",
    "Robot",
    "RobotInputs",
    "create_robot",
    "find",
    "has",
    "import_robot",
    "load_robot",
    "optional_prompt",
    "parse_chw_image",
    "parse_image",
    "parse_unit_image",
    "read_prompt",
    "read_state",
    "require",
    "robot_from_dict",
]

ROBOTS: dict[str, type] = {"libero": Libero, "droid": Droid, "aloha": Aloha, "lerobot": LeRobot, "plain": Plain}


def robot_for(robot: str | Path | Robot, own: str, own_options: Mapping[str, object]) -> Robot:
    """A policy's robot: its config's `own` one with the options there, or another one that is asked for.

    A robot that sends LeRobot's raw keys stands on a LeRobot checkpoint's own. Raises ConfigError as `create_robot`.
    """
    if robot == own:
        return create_robot(robot, own_options)
    raw = raw_description(robot)
    if raw is None:
        return create_robot(robot)
    if own != "lerobot":
        raise ConfigError(
            f"robot {robot} puts LeRobot's raw keys into a LeRobot checkpoint's, but this one is for robot {own}. "
            "Describe its cameras and state in a .json (docs/robots.md): the keys there may be raw ones, too"
        )
    checkpoint = create_robot(own, own_options)
    assert isinstance(checkpoint, LeRobot)
    return raw.on(checkpoint)


def create_robot(robot: str | Path | Robot, options: Mapping[str, object] | None = None) -> Robot:
    """A robot from its name, from the path of its description (.json), or the robot itself.

    options   of a built-in robot: its class's fields

    Raises ConfigError for an unknown name or option, or a description that isn't right. A name never imports code, so
    that no file can make it run: see `import_robot`.
    """
    options = dict(options or {})
    if not isinstance(robot, str | Path):
        _refuse_options(options, "a robot given as an object")
        return _checked(robot)
    described = str(robot).endswith(".json")
    if described:
        _refuse_options(options, "a robot described by a file")
    if raw_description(robot) is not None:
        raise ConfigError(
            f"robot {robot} sends LeRobot's raw keys, which only a LeRobot checkpoint's own description can place: "
            "name it with --robot, or robot=, for such a checkpoint, and not in a turbopi.json"
        )
    if described:
        return load_robot(robot)
    cls = ROBOTS.get(str(robot))
    if cls is None:
        hint = "; robots in Python code are given as objects" if ":" in str(robot) else ""
        raise ConfigError(
            f"unknown robot {str(robot)!r}; choose one of {', '.join((*ROBOTS, *ROBOT_TYPES))}, or a .json description"
            f"{hint}"
        )
    fields = [field.name for field in dataclasses.fields(cls)]
    required = [field.name for field in dataclasses.fields(cls) if field.default is dataclasses.MISSING]
    unknown, missing = sorted(set(options) - set(fields)), [name for name in required if name not in options]
    if unknown:
        raise ConfigError(f"robot {robot} has no option {', '.join(unknown)}; it has {', '.join(fields) or 'none'}")
    if missing:
        raise ConfigError(f"robot {robot} needs the option {', '.join(missing)}")
    for field in dataclasses.fields(cls):
        value = options.get(field.name, field.default)
        if isinstance(field.default, bool) and not isinstance(value, bool):
            raise ConfigError(f"robot {robot}: the option {field.name} is {value!r}; expected true or false")
    created: Robot = cls(**options)
    return created


def import_robot(path: str) -> Robot:
    """The robot at "module:Name", a class without arguments or an object. It runs that module's code.

    Only for a path that a person gives on purpose. Raises ConfigError if it can't be imported or isn't a robot.
    """
    module_name, _, name = path.partition(":")
    if not module_name or not name:
        raise ConfigError(f"a robot's path is module:Class, got {path!r}")
    try:
        found = getattr(importlib.import_module(module_name), name)
    except (ImportError, AttributeError, ValueError, TypeError) as error:
        raise ConfigError(f"can't import the robot {path!r}: {error}") from error
    except (Exception, SystemExit) as error:  # whatever the module's own code does
        raise ConfigError(f"can't import the robot {path!r}: {module_name} failed: {_what(error)}") from error
    try:
        return _checked(found() if isinstance(found, type) else found)
    except ConfigError:
        raise
    except TypeError as error:  # abstract methods, or arguments that it needs
        raise ConfigError(f"can't make the robot {path!r}: {error}") from error
    except (Exception, SystemExit) as error:
        raise ConfigError(f"can't make the robot {path!r}: {_what(error)}") from error


def _what(error: BaseException) -> str:
    """An error of the user's own code, and where in it; --debug shows the rest."""
    frames = traceback.extract_tb(error.__traceback__)
    where = f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
    return f"{type(error).__name__}: {error}{where}"


def _refuse_options(options: Mapping[str, object], what: str) -> None:
    if options:
        raise ConfigError(f"{what} takes no robot_options, got {', '.join(options)}")


def _checked(robot: Any) -> Robot:
    needed = ("inputs", "outputs", "example")
    attributes = ("name", "state_dim", "action_dim", "delta_mask", "reset_pose", "default_prompt")
    missing = [name for name in (*needed, *attributes) if not hasattr(robot, name)]
    if missing or isinstance(robot, type):
        problem = "is a class; pass an instance" if isinstance(robot, type) else f"has no {', '.join(missing)}"
        raise ConfigError(f"robot {robot!r} {problem}. Subclass turbopi.robots.Robot, which has defaults")
    checked: Robot = robot
    return checked
