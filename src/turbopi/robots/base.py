"""What a robot is to the policy, and the helpers that read its observations.

A robot names its cameras, state and prompt in its own keys, and cuts the model's actions to what it can execute. Every
reader raises ObservationError with the key, what was found and what was expected; none changes the observation.
"""

import functools
import itertools
from abc import abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import numpy as np

from turbopi.config import CAMERAS
from turbopi.support.errors import ObservationError
from turbopi.support.text import kind_of


@dataclass(frozen=True)
class RobotInputs:
    """An observation in the model's terms.

    images      camera -> uint8[h, w, 3] in [0, 255], or float32[h, w, 3] in [0, 1] (LeRobot); RGB
    image_mask  camera -> whether it is valid; left out: if `images` has it
    state       float[s]       in the robot's units, before normalisation
    prompt      the task, or None if the observation has none
    in_order    whether `images` has all of the model's cameras, in its order, whatever their names
    missing     keys of cameras that didn't come
    unread      keys of cameras that came and aren't read: with `missing`, one may be misspelt

    Cameras are the model's (`base_0_rgb`, `left_wrist_0_rgb`, `right_wrist_0_rgb`; their order here doesn't matter and
    those left out are masked), or, for models trained with other names, names in the model's order.
    """

    images: dict[str, np.ndarray]
    image_mask: dict[str, bool]
    state: np.ndarray
    prompt: str | None = None
    in_order: bool = False
    missing: tuple[str, ...] = ()
    unread: tuple[str, ...] = ()


class Example(dict[str, Any]):
    """A made-up observation: its state and images say nothing of any robot, so there is no note on them."""


@runtime_checkable
class Robot(Protocol):
    """A robot's side of the pipeline. Subclass it and override what differs; only its three methods have no default.

    name            for people and metadata
    state_dim       width of its state, action_dim of its actions; None: whatever comes
    delta_mask      per action dimension: True where the model's action is relative to the state; None: nowhere
    reset_pose      joint positions to start from, for clients that ask for them; part of the policy's metadata
    default_prompt  for observations without one
    camera_counts   how many cameras an observation may have, for warm-up; None: as many as `example` has
    action_keys     the robot's name of each action: answers then hold the actions under these, too; None: they don't
    """

    name: str = "custom"
    state_dim: int | None = None
    action_dim: int | None = None
    delta_mask: tuple[bool, ...] | None = None
    reset_pose: list[float] | None = None
    default_prompt: str | None = None
    camera_counts: tuple[int, ...] | None = None
    action_keys: tuple[str, ...] | None = None

    @abstractmethod
    def inputs(self, observation: Mapping[str, object]) -> RobotInputs:
        """The observation that a client sent, in the model's terms. Raises ObservationError."""
        ...

    @abstractmethod
    def outputs(self, actions: np.ndarray) -> np.ndarray:
        """float64[H, D] un-normalised absolute actions of the model to the robot's own float[H, d]."""
        ...

    @abstractmethod
    def example(self, rng: np.random.Generator) -> dict[str, Any]:
        """A random valid observation in the robot's own keys, for warm-up and tests."""
        ...


def action_mask(dims: Sequence[int]) -> tuple[bool, ...]:
    """openpi's shorthand for a mask: n times True, or for -n as often False; (2, -1) is (True, True, False)."""
    return tuple(flag for n in dims for flag in [n > 0] * abs(n))


def find(observation: Mapping[str, object], key: str) -> Any:
    """The value at `key`, flat (`{"a/b": x}`) or nested (`{"a": {"b": x}}`); KeyError if there is none.

    openpi's clients nest some keys and flatten others, and an .npz file can only be flat, so both are read everywhere.
    """
    if key in observation:
        return observation[key]
    head, _, rest = key.partition("/")
    inner = observation[head]  # KeyError
    if not rest or not isinstance(inner, Mapping):
        raise KeyError(key)
    return find(inner, rest)


def has(observation: Mapping[str, object], key: str) -> bool:
    """Whether `find` would find it."""
    try:
        find(observation, key)
    except KeyError:
        return False
    return True


def require(observation: Mapping[str, object], key: str, expected: tuple[str, ...]) -> Any:
    """The value at `key`. Raises ObservationError, listing the keys given and the `expected` ones, if absent."""
    try:
        return find(observation, key)
    except KeyError:
        given = listed(keys_of(observation))
        raise ObservationError(
            f"the observation has no {key!r}. It has {given}; expected {', '.join(expected)}"
        ) from None


def keys_of(observation: Mapping[str, object], depth: int = 3) -> Iterator[str]:
    """All keys, those of nested mappings joined with "/", down to `depth`."""
    for key, value in observation.items():
        if isinstance(value, Mapping) and value and depth > 1:
            yield from (f"{key}/{inner}" for inner in keys_of(value, depth - 1))
        else:
            yield str(key)


def described(observation: Mapping[str, object]) -> dict[str, str]:
    """Each key of an observation, nested ones joined with "/", and what is there: "uint8[224, 224, 3]", "text"."""

    def what(value: object) -> str:
        array = np.asarray(value)
        if array.dtype.kind in "USO":
            return "text" if array.ndim == 0 else "list of text"
        return f"{array.dtype}{list(array.shape) if array.ndim else ''}"

    return {key: what(find(observation, key)) for key in keys_of(observation)}


def listed(names: Iterable[str]) -> str:
    """Names for a message, which must stay short whatever a client sends."""
    shown = [name if len(name) <= 60 else name[:60] + "…" for name in itertools.islice(names, 21)]
    return ", ".join(shown[:20]) + (", …" if len(shown) > 20 else "") or "nothing"


def names_in(observation: Mapping[str, object], folder: str) -> list[str]:
    """The names directly below `folder`, nested or flat: ["cam_high"] for either form of "images/cam_high"."""
    nested = observation.get(folder, {})
    if not isinstance(nested, Mapping):
        raise ObservationError(f"{folder!r} is {kind_of(nested)}, expected a dict of images by camera")
    prefix = folder + "/"
    flat = [str(key)[len(prefix) :] for key in observation if str(key).startswith(prefix)]
    return [*map(str, nested), *flat]


def names_in_prefix(observation: Mapping[str, object], prefix: str) -> list[str]:
    """The keys, as they are, that begin with `prefix`."""
    return [str(key) for key in observation if str(key).startswith(prefix)]


def read_state(value: object, key: str, width: int | None) -> np.ndarray:
    """A float[width] vector of finite numbers, any length if `width` is None.

    Integers become float64; a plain number is a vector of width 1. Raises ObservationError for anything else.
    """
    try:
        state = np.asarray(value)
    except Exception as error:
        raise ObservationError(f"{key} isn't an array of numbers: {error}") from error
    if state.dtype.kind != "f":
        if state.dtype.kind not in "iu":
            raise ObservationError(f"{key} has dtype {state.dtype}; send floats")
        state = state.astype(np.float64)
    if state.ndim == 0 and width == 1:
        state = state[None]
    if state.ndim != 1 or state.size == 0 or (width is not None and len(state) != width):
        expected = "one axis, not empty" if width is None else f"shape ({width},)"
        raise ObservationError(f"{key} has shape {state.shape}, expected {expected}")
    if not all_finite(state):
        at = int(np.flatnonzero(~np.isfinite(state))[0])
        raise ObservationError(f"{key} isn't finite: value {at} is {state[at]}")
    return state


def all_finite(array: np.ndarray) -> bool:
    """Whether no number is NaN or infinite. On short arrays searching bytes takes half the time of `ndarray.all`."""
    return b"\0" not in np.isfinite(array).tobytes()


def read_prompt(value: object, key: str = "prompt") -> str:
    """A prompt as text: str, numpy's str_, UTF-8 bytes, or an array that holds one of them."""
    if type(value) is str:  # nearly always
        return value
    if isinstance(value, np.ndarray) and value.size == 1:
        value = value.item()
    if isinstance(value, bytes):
        try:
            value = value.decode()
        except UnicodeDecodeError as error:
            raise ObservationError(f"{key} is bytes that aren't UTF-8: {error}") from error
    if isinstance(value, str):
        return str(value)
    if value is None:
        raise ObservationError(f"{key} is None; leave the key out to use the default prompt")
    raise ObservationError(f"{key} is {kind_of(value)}, expected text")


def optional_prompt(observation: Mapping[str, object], key: str = "prompt") -> str | None:
    """The prompt at `key`; None if the observation has no such key."""
    try:
        value = find(observation, key)
    except KeyError:
        return None
    return read_prompt(value, key)


def with_missing_cameras(images: dict[str, np.ndarray], like: str) -> tuple[dict[str, np.ndarray], dict[str, bool]]:
    """All of the model's cameras in its order, those not in `images` black (of the size of `like`), and their mask."""
    every: dict[str, np.ndarray] = {}
    mask: dict[str, bool] = {}
    for camera in CAMERAS:
        mask[camera] = given = camera in images
        every[camera] = images[camera] if given else black_like(images[like])
    return every, mask


def black_like(image: np.ndarray) -> np.ndarray:
    """A read-only black image of the shape and dtype of `image`, without its memory."""
    return _black(image.shape, image.dtype)


@functools.lru_cache(maxsize=16)  # the same few in every call
def _black(shape: tuple[int, ...], dtype: np.dtype[Any]) -> np.ndarray:
    return np.broadcast_to(np.zeros((), dtype), shape)


def random_image(rng: np.random.Generator, size: int = 224) -> np.ndarray:
    """uint8[size, size, 3] noise."""
    return rng.integers(256, size=(size, size, 3), dtype=np.uint8)
