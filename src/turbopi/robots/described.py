"""A robot described by a small JSON file; docs/robots.md has an example and says what each field means."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from turbopi.config import CAMERAS, LIMITS
from turbopi.robots.base import (
    Robot,
    RobotInputs,
    action_mask,
    optional_prompt,
    random_image,
    read_state,
    require,
    with_missing_cameras,
)
from turbopi.robots.images import parse_image
from turbopi.support.errors import ConfigError
from turbopi.support.reading import is_finite, is_integer, listing, read_json, shown

REQUIRED = ("name", "cameras", "state", "action_dim")
_MOST = LIMITS["action_dim"]  # numbers in a state or an action: no model takes more
OPTIONAL = ("delta_action_dims", "prompt_key", "default_prompt", "reset_pose", "action_keys")


@dataclass(frozen=True)
class Described(Robot):
    """A robot as a file describes it.

    cameras   observation key -> the model's camera; images (uint8|float)[h, w, 3] or [3, h, w], all required
    state     observation key -> its width, concatenated in this order; a scalar counts as width 1
    action_dim, delta_mask, prompt_key, default_prompt, reset_pose, action_keys   see `Robot` and docs/robots.md
    """

    name: str = field()  # field(): no default, where the protocol has one
    cameras: Mapping[str, str] = field()
    state: Mapping[str, int] = field()
    action_dim: int = field()
    delta_mask: tuple[bool, ...] | None = None
    prompt_key: str = "prompt"
    default_prompt: str | None = None
    reset_pose: list[float] | None = None
    action_keys: tuple[str, ...] | None = None

    @property
    def state_dim(self) -> int:  # type: ignore[override]
        return sum(self.state.values())

    @property
    def camera_counts(self) -> tuple[int, ...]:  # type: ignore[override]
        return (len(self.cameras),)

    @cached_property
    def _keys(self) -> tuple[str, ...]:
        return (*self.cameras, *self.state, self.prompt_key)

    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        camera_images = {
            camera: parse_image(require(observation, key, self._keys), key) for key, camera in self.cameras.items()
        }
        images, mask = with_missing_cameras(camera_images, like=next(iter(camera_images)))
        parts = [read_state(require(observation, key, self._keys), key, width) for key, width in self.state.items()]
        return RobotInputs(images, mask, np.concatenate(parts), optional_prompt(observation, self.prompt_key))

    def outputs(self, actions: np.ndarray) -> np.ndarray:
        return actions[:, : self.action_dim]

    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        camera_images = {key: random_image(rng) for key in self.cameras}
        state = {key: rng.uniform(-1, 1, width) for key, width in self.state.items()}
        return {**camera_images, **state, self.prompt_key: self.default_prompt or "pick up the red block"}


def load_robot(path: str | Path) -> Described:
    """The robot that the JSON file at `path` describes.

    Raises ConfigError, naming the file and the field, if it can't be read, or has a field that is unknown, missing or
    not what it should be.
    """
    path = Path(path).expanduser()
    described = read_json(path, ConfigError)
    try:
        return robot_from_dict(described)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from None


def robot_from_dict(described: Any) -> Described:
    """A robot from the fields of its description. Raises ConfigError, naming the field that is wrong."""
    _expect(isinstance(described, dict), "the description", "an object", described)
    unknown = sorted(set(described) - {*REQUIRED, *OPTIONAL})
    missing = [name for name in REQUIRED if name not in described]
    if unknown:
        raise ConfigError(f"unknown field {listing(unknown)}; a robot has {', '.join((*REQUIRED, *OPTIONAL))}")
    if missing:
        raise ConfigError(f"{', '.join(missing)} missing; a robot needs {', '.join(REQUIRED)}")
    for name in ("name", "prompt_key"):
        value = described.get(name, "prompt")
        _expect(isinstance(value, str) and value != "", name, "text", value)
    _check_cameras(described["cameras"])
    _check_state(described["state"])
    action_dim = described["action_dim"]
    _expect(_is_count(action_dim), "action_dim", f"a whole number from 1 to {_MOST}", action_dim)
    prompt, pose = described.get("default_prompt"), described.get("reset_pose")
    _expect(prompt is None or isinstance(prompt, str), "default_prompt", "text", prompt)
    pose_is_right = isinstance(pose, list) and all(map(is_finite, pose))
    _expect(pose is None or pose_is_right, "reset_pose", "a list of numbers", pose)
    keys = described.get("action_keys")
    keys_are_right = isinstance(keys, list) and all(isinstance(key, str) for key in keys)
    right = keys is None or (keys_are_right and len(set(keys)) == len(keys) == action_dim)
    _expect(right, "action_keys", f"a list of {action_dim} different names, one for each action", keys)
    fields = {name: value for name, value in described.items() if name not in ("delta_action_dims", "action_keys")}
    return Described(
        **fields,
        delta_mask=_delta_mask(described.get("delta_action_dims"), described),
        action_keys=None if keys is None else tuple(keys),
    )


def _check_cameras(cameras: Any) -> None:
    _expect(isinstance(cameras, dict) and len(cameras) > 0, "cameras", "an object: key -> the model's camera", cameras)
    for key, camera in cameras.items():
        _expect(camera in CAMERAS, f"cameras[{key!r}]", f"one of {', '.join(CAMERAS)}", camera)
    if len(set(cameras.values())) < len(cameras):
        raise ConfigError(f"cameras gives one of the model's cameras to two keys: {shown(cameras)}")


def _check_state(state: Any) -> None:
    _expect(isinstance(state, dict) and len(state) > 0, "state", "an object: key -> width", state)
    for key, width in state.items():
        _expect(_is_count(width), f"state[{key!r}]", f"a whole number from 1 to {_MOST}", width)


def _delta_mask(dims: Any, described: dict[str, Any]) -> tuple[bool, ...] | None:
    if dims is None:
        return None
    is_dims = isinstance(dims, list) and all(is_integer(n) and n for n in dims)
    _expect(is_dims, "delta_action_dims", "a list such as [6, -1]: six relative, one absolute", dims)
    covered = sum(map(abs, dims))
    widths = {"action_dim": described["action_dim"], "the state's width": sum(described["state"].values())}
    for name, width in widths.items():
        if covered > width:
            raise ConfigError(f"delta_action_dims {shown(dims)} covers {covered} dimensions, but {name} is {width}")
    return action_mask(dims)


def _is_count(value: object) -> TypeGuard[int]:
    return is_integer(value) and 1 <= value <= _MOST


def _expect(right: bool, name: str, expected: str, got: object) -> None:
    if not right:
        raise ConfigError(f"{name} must be {expected}, got {shown(got)}")
