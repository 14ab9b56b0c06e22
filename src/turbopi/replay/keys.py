"""A dataset's keys to the robot's: which camera is which, where the state is, what the task is called.

A key that both have is taken as it is. Others are joined by `--rename`, or where the last part of their name is the
same ("observation.images.wrist_image" and "observation/wrist_image"), or where there is one state on either side.
Cameras are never joined by their order.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from turbopi.policy.policy import UnifiedPolicy
from turbopi.replay.episodes import PROMPT
from turbopi.robots.base import find, has, keys_of, listed
from turbopi.support.errors import ConfigError, ObservationError

_STATES = ("state", "proprio", "qpos")  # what a state of all numbers is called
_PROMPTS = (PROMPT, "task")


@dataclass(frozen=True)
class KeyMap:
    """robot's key -> the dataset's, and what neither has.

    cameras    the robot's keys of images, in its order
    channels_first   which of them take [3, h, w]
    prompt     the robot's key of the task
    unread     cameras of the dataset that the robot doesn't read
    absent     keys of the robot that the dataset's first observation lacks
    """

    joined: Mapping[str, str]
    cameras: tuple[str, ...]
    channels_first: frozenset[str]
    prompt: str
    unread: tuple[str, ...]
    absent: tuple[str, ...]

    def observation(self, recorded: Mapping[str, Any], task: str | None) -> dict[str, Any]:
        """A recorded observation under the robot's keys, those that it has; `task` instead of the recorded one.

        A key that the first observation lacks is read by its own name.
        """
        made: dict[str, Any] = {}
        for key, source in {**dict(zip(self.absent, self.absent, strict=True)), **self.joined}.items():
            if not has(recorded, source):
                continue
            value = find(recorded, source)
            if key in self.channels_first and np.ndim(value) == 3 and value.shape[-1] == 3:
                value = np.ascontiguousarray(value.transpose(2, 0, 1))
            made[key] = value
        prompt = task if task is not None else next((recorded[name] for name in _PROMPTS if name in recorded), None)
        return made if prompt is None else {**made, self.prompt: prompt}

    @property
    def described(self) -> list[str]:
        """ "observation.images.top -> observation/image", for keys that differ."""
        return [f"{source} -> {key}" for key, source in self.joined.items() if source != key]


def parse_renames(texts: Iterable[str]) -> dict[str, str]:
    """{robot's key: dataset's} of ["DATASET_KEY=ROBOT_KEY", …], the dataset's in full or its last part alone. Raises
    ConfigError.
    """
    found: dict[str, str] = {}
    for text in texts:
        source, equals, key = text.partition("=")
        if not equals or not source or not key or key in found:
            problem = f"names {key} twice" if key in found else "is no pair"
            raise ConfigError(f"--rename {text} {problem}; expected DATASET_KEY=ROBOT_KEY, each robot's key once")
        found[key] = source
    return found


def join_keys(
    policy: UnifiedPolicy, recorded: Mapping[str, Any], renames: Mapping[str, str], task: str | None
) -> KeyMap:
    """How the observations of a dataset, of which `recorded` is one, are read by a policy.

    Raises ObservationError, with both sides' keys and what to do, if the policy can't use what comes of it.
    """
    example = policy.example_observation()
    keys = [key for key in keys_of(example) if key not in _PROMPTS or not isinstance(find(example, key), str)]
    prompt = next((key for key in keys_of(example) if isinstance(find(example, key), str)), PROMPT)
    keys = [key for key in keys if key != prompt]
    theirs = [key for key in keys_of(recorded) if key not in _PROMPTS]
    cameras = tuple(key for key in keys if np.ndim(find(example, key)) == 3)
    known = [*keys, prompt]
    given = dict[str, str]()
    for key, source in renames.items():
        if key not in known:
            raise ConfigError(f"--rename {source}={key}: robot {_robot(policy)} has no {key}; it has {listed(known)}")
        meant = source if source in theirs else _same(source, theirs)
        if meant is None:
            raise ConfigError(f"--rename {source}={key}: the dataset has no {source}; it has {listed(theirs)}")
        given[key] = meant
    joined = {key: given.get(key) or _same(key, theirs) for key in keys}
    _join_state(joined, cameras, recorded, theirs)
    taken = {source for source in joined.values() if source is not None}
    unread = tuple(key for key in theirs if key not in taken and _is_image(find(recorded, key)))
    made = KeyMap(
        {key: source for key, source in joined.items() if source is not None},
        tuple(key for key in cameras if joined[key] is not None),
        frozenset(key for key in cameras if find(example, key).shape[0] == 3),
        prompt,
        unread,
        tuple(key for key, source in joined.items() if source is None),
    )
    try:
        policy.pipeline.before(made.observation(recorded, task))
    except ObservationError as error:
        raise ObservationError(_advice(policy, made, recorded, theirs, str(error))) from error
    return made


def _robot(policy: UnifiedPolicy) -> str:
    return str(policy.metadata["robot"])


def _is_image(value: object) -> bool:
    return isinstance(value, np.ndarray) and value.ndim == 3


def _same(key: str, theirs: Iterable[str]) -> str | None:
    """The dataset's key that is called the same, or, if there is one, whose last part is."""
    theirs = list(theirs)
    if key in theirs:
        return key
    alike = [one for one in theirs if _last(one) == _last(key)]
    return alike[0] if len(alike) == 1 else None


def _last(key: str) -> str:
    return key.replace("/", ".").rsplit(".", 1)[-1]


def _join_state(
    joined: dict[str, str | None], cameras: Iterable[str], recorded: Mapping[str, Any], theirs: Iterable[str]
) -> None:
    """The robot's only key of numbers is the dataset's state, whatever either is called."""
    numbers = [key for key in joined if key not in tuple(cameras)]
    states = _states(recorded, theirs)
    if len(numbers) == 1 and joined[numbers[0]] is None and len(states) == 1:
        joined[numbers[0]] = states[0]


def _states(recorded: Mapping[str, Any], theirs: Iterable[str]) -> list[str]:
    return [key for key in theirs if _last(key) in _STATES and np.ndim(find(recorded, key)) == 1]


def _advice(policy: UnifiedPolicy, made: KeyMap, recorded: Mapping[str, Any], theirs: list[str], problem: str) -> str:
    text = f"the dataset's observations don't fit robot {_robot(policy)}: {problem}"
    if not made.absent:
        return text
    example, key = policy.example_observation(), made.absent[0]
    absent, states = [find(example, one) for one in made.absent], _states(recorded, theirs)
    numbers = sum(np.size(one) for one in absent)
    if len(absent) > 1 and len(states) == 1 and np.size(find(recorded, states[0])) == numbers:
        return (
            f"{text}. The dataset seems to have {listed(made.absent)} in one array, {states[0]}. Describe the robot "
            f'once more, with "state": {{"{_last(states[0])}": {numbers}}}, and give that file as --robot '
            "(docs/replay.md)"
        )
    free = made.unread if np.ndim(find(example, key)) == 3 else ()
    return (
        f"{text}. The dataset has {listed(theirs)}; nothing in it is called {listed(made.absent)}. Say which is which: "
        f"--rename {free[0] if free else 'DATASET_KEY'}={key}"
    )
