"""Which moments are taken, and what a policy does with each of them."""

import itertools
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from turbopi.checkpoint.norm_stats import NormStats
from turbopi.policy.history import refuse_memory
from turbopi.policy.policy import UnifiedPolicy
from turbopi.policy.ranges import range_of
from turbopi.policy.readings import Checks
from turbopi.policy.watch import Sample
from turbopi.preprocess.normalize import pad_last
from turbopi.replay.document import Broken
from turbopi.replay.episodes import Dataset, Episode, Moment, Selection
from turbopi.replay.keys import KeyMap, join_keys
from turbopi.support.errors import ActionError, ConfigError, ObservationError
from turbopi.verify.demo import action_units

SECONDS = 60.0  # that a run takes, unless --every says how many moments
LEAST, MOST = 24, 4096  # moments, whatever the time
OF_AN_EPISODE = 8  # moments at least, before episodes are left out
BATCH = 8
CHANGED = 12  # moments at which inputs are also changed on purpose


@dataclass(frozen=True)
class Variation:
    """A mistake in the inputs, made on purpose: what it is, and the observation with it."""

    name: str
    change: Callable[[Mapping[str, Any]], dict[str, Any]]


@dataclass(frozen=True)
class Replayed:
    """A policy over the moments that it answered, N of them.

    about        its metadata
    keys         how the dataset's keys were read
    moments      (episode, step) of each
    predicted    float64[N, H, d]  in the robot's units
    recorded     float64[N, H, d]  NaN behind an episode's end
    previous     float64[N, d]     the action before; NaN where there is none
    units        float64[d]        how far each action moves with one unit of the model's normalised actions
    middle       float64[N, d]     the action that a normalised 0 is, which depends on the state for relative actions
    ends         float64[2, N, d]  the training range's (policy/ranges.py), which for those depend on it, too
    states       float64[N, s]     as the model reads them, before normalisation
    state_range  (low, high)       float64[≤ s], the training's; of no numbers without statistics
    call_ms      of each call of the policy, a batch's counted once
    variations   {name: float64[n, H, d]}, the chunks of `changed`, indices of moments
    cameras      a few pixels of every moment's images, by the robot's own key
    broken       the moments whose answer no robot may be given (ActionError), which aren't among the N
    """

    about: Mapping[str, Any]
    keys: KeyMap
    moments: Sequence[tuple[Episode, int]]
    predicted: np.ndarray
    recorded: np.ndarray
    previous: np.ndarray
    units: np.ndarray
    middle: np.ndarray
    ends: np.ndarray
    states: np.ndarray
    state_range: tuple[np.ndarray, np.ndarray]
    call_ms: Sequence[float]
    changed: Sequence[int]
    variations: Mapping[str, np.ndarray]
    cameras: Mapping[str, Sequence[Sample]]
    broken: Sequence[Broken] = ()

    def only(self, rows: Sequence[int]) -> "Replayed":
        """The same of these of the N moments alone."""
        kept = [number for number, moment in enumerate(self.changed) if moment in rows]
        arrays = {name: getattr(self, name)[rows] for name in ("predicted", "recorded", "previous", "middle", "states")}
        return replace(
            self,
            **arrays,
            ends=self.ends[:, rows],
            moments=[self.moments[row] for row in rows],
            changed=[rows.index(self.changed[number]) for number in kept],
            variations={name: chunks[kept] for name, chunks in self.variations.items() if kept},
        )

    @property
    def moved(self) -> tuple[np.ndarray, np.ndarray]:
        """(predicted, recorded) from the middle on: for relative actions the motion from the state. The state itself is
        in what any such policy predicts, so it would make a chunk of nonsense look near.
        """
        return self.predicted - self.middle[:, None], self.recorded - self.middle[:, None]


def ends_of(policy: UnifiedPolicy) -> np.ndarray:
    """float32[2, action_dim], the training range's ends as the model has them; ±1 without statistics."""
    scale, width = policy.pipeline.action_scale, policy.config.model.action_dim
    _, *ends = range_of(policy._checkpoint.norm_stats.actions)
    if not len(ends[0]):
        return np.repeat(np.array([[-1], [1]], np.float32), width, 1)
    return np.stack([pad_last(scale.normalize(end), width)[:width] for end in ends]).astype(np.float32)


@dataclass(frozen=True)
class Settings:
    """What a run is given besides policy and dataset: see `turbopi replay --help`."""

    renames: Mapping[str, str]
    task: str | None = None
    seed: int = 0
    changed: int = CHANGED


# --- which moments ----------------------------------------------------------------------------------------------------


def chosen_episodes(dataset: Dataset, wanted: Sequence[int] | None) -> tuple[Episode, ...]:
    """The episodes of these numbers, or all. Raises ConfigError for a number that isn't there."""
    if wanted is None:
        return tuple(dataset.episodes)
    by_number = {episode.number: episode for episode in dataset.episodes}
    missing = [number for number in wanted if number not in by_number]
    if missing:
        raise ConfigError(
            f"--episodes: there is no episode {missing[0]}; {dataset.path} has {len(by_number)}, from {min(by_number)} "
            f"to {max(by_number)}"
        )
    return tuple(by_number[number] for number in dict.fromkeys(wanted))


def select(episodes: Sequence[Episode], every: int | None, affordable: int) -> Selection:
    """Moments spread evenly: every `every`-th, or about as many as are affordable.

    If that would be less than OF_AN_EPISODE an episode, evenly chosen episodes are taken instead of all.
    """
    total, there = sum(episode.length for episode in episodes), len(episodes)
    chosen = tuple(episodes)
    if every is None:
        most = max(1, affordable // OF_AN_EPISODE)
        if there > most:
            chosen = tuple(episodes[int(i)] for i in np.linspace(0, there - 1, most).round())
        every = max(1, -(-sum(episode.length for episode in chosen) // affordable))
    return Selection(chosen, every, there, total)


def affordable(seconds: float, changes: int) -> int:
    """How many moments fit into SECONDS, if one takes so many, and `changes` more calls are made on purpose."""
    return int(np.clip(SECONDS / max(seconds, 1e-6) - changes, LEAST, MOST))


# --- a policy ---------------------------------------------------------------------------------------------------------


class Replay:
    """A policy that is to go over a dataset: keys joined, warmed up.

    Raises ConfigError or ObservationError if they don't fit each other.
    """

    def __init__(
        self, policy: UnifiedPolicy, dataset: Dataset, episodes: Sequence[Episode], settings: Settings
    ) -> None:
        refuse_memory(policy.metadata, "a replay")
        self.policy, self.dataset, self.settings = policy, dataset, settings
        self.horizon = policy.config.model.action_horizon
        self._checks = Checks(policy.pipeline, NormStats())  # for its readings of the images
        self._ends = ends_of(policy)
        dataset.wanted = None
        self._first = self._read_first(episodes[0])
        self.keys = join_keys(policy, self._first.observation, settings.renames, settings.task)
        dataset.wanted = frozenset(self.keys.joined.values())
        self.width = self._check_width(self._first.recorded.shape[1])
        self.variations = variations_of(self.keys) if settings.changed else []

    def _read_first(self, episode: Episode) -> Moment:
        begin = time.perf_counter()
        (moment,) = self.dataset.moments(episode, [0], self.horizon)
        self._reading = time.perf_counter() - begin
        return moment

    def _check_width(self, recorded: int) -> int:
        """How many actions a step are compared. Raises ConfigError."""
        about = self.policy.metadata
        width = int(about["robot_action_dim"])
        if recorded < width and about["robot"] == "plain":  # which has all of the model's, padding among them
            return recorded
        if recorded != width:
            names = f" ({', '.join(self.dataset.action_names)})" if self.dataset.action_names else ""
            raise ConfigError(
                f"the dataset has {recorded} actions a step{names}, but robot {about['robot']} has {width}. Is this "
                "the checkpoint's robot (--robot)? If the dataset has several kinds of actions, say which: --rename "
                "KEY=actions"
            )
        return width

    @property
    def notes(self) -> list[str]:
        """Keys that one side has and the other doesn't."""
        found = []
        if self.keys.absent:
            unread = f"; cameras of it that aren't read: {', '.join(self.keys.unread)}" if self.keys.unread else ""
            found.append(
                f"the first observation has nothing called {', '.join(self.keys.absent)}, which the policy does "
                f"without{unread}. --rename says which is which"
            )
        elif self.keys.unread:
            found.append(f"cameras of the dataset that the policy doesn't read: {', '.join(self.keys.unread)}")
        return found

    def warm_up(self) -> float:
        """Warm up, and return the seconds that a moment takes, reading included."""
        self.policy.warmup(batches=BATCH if self.policy.runs_batches else None)
        observation = self._observation(self._first)
        rows = BATCH if self.policy.runs_batches else 1
        begin = time.perf_counter()
        self._infer([observation] * rows, [self.settings.seed] * rows)  # whether it is broken, `run` says
        return (time.perf_counter() - begin) / rows + self._reading

    @property
    def changes(self) -> int:
        """Calls besides those at the moments, at most."""
        return self.settings.changed * len(self.variations)

    def run(self, selection: Selection, advance: Callable[[], None]) -> Replayed:
        """Every moment of the selection, each with its own noise: the seed's, the seed + 1's, …

        Raises ActionError if no answer is a chunk.
        """
        count = selection.count
        to_change = {int(i) for i in np.linspace(0, count - 1, min(self.settings.changed, count)).round()}
        found: list[_Answer] = []
        broken: list[Broken] = []
        changed: list[int] = []
        varied: dict[str, list[np.ndarray]] = {variation.name: [] for variation in self.variations}
        batches = _batches(self._moments(selection), BATCH if self.policy.runs_batches else 1)
        call_ms = []
        for batch in batches:
            observations = [self._observation(moment) for moment in batch]
            first = len(found) + len(broken)
            seeds = [self.settings.seed + first + row for row in range(len(batch))]
            with self._naming(batch):
                begin = time.perf_counter()
                chunks = self._infer(observations, seeds)
                call_ms.append((time.perf_counter() - begin) * 1e3)
                for row, (moment, observation, chunk) in enumerate(zip(batch, observations, chunks, strict=True)):
                    if isinstance(chunk, ActionError):
                        broken.append(Broken(moment.episode.name, moment.step, str(chunk)))
                    else:
                        own = self._varied(observation, seeds[row]) if first + row in to_change else None
                        if own is not None:
                            changed.append(len(found))
                            for variation, other in zip(self.variations, own, strict=True):
                                varied[variation.name].append(other)
                        found.append(self._answer(moment, observation, chunk))
                    advance()
        if not found:
            raise ActionError(
                f"{self.dataset.path}: none of the policy's {len(broken)} answers is a chunk that a robot may be "
                f"given. The first: {broken_text(broken[0])}"
            )
        _, low, high = range_of(self.policy._checkpoint.norm_stats.state)
        return Replayed(
            self.policy.metadata,
            self.keys,
            [one.at for one in found],
            np.stack([one.chunk for one in found]),
            np.stack([one.recorded for one in found]),
            np.stack([one.previous for one in found]),
            action_units(self.policy, self._observation(self._first))[: self.width],
            np.stack([one.middle for one in found]),
            np.stack([one.ends for one in found], axis=1),
            states := np.stack([one.state for one in found]),
            (low[: states.shape[1]], high[: states.shape[1]]),
            call_ms,
            changed,
            {name: np.stack(chunks) for name, chunks in varied.items() if chunks},
            _by_camera(found),
            broken,
        )

    @contextmanager
    def _naming(self, batch: Sequence[Moment]) -> Iterator[None]:
        """What the policy can't use is named with where it is."""
        try:
            yield
        except ObservationError as error:
            first, more = batch[0], f" and the {len(batch) - 1} after it" if len(batch) > 1 else ""
            where = f"{self.dataset.path}: episode {first.episode.name}, step {first.step}{more}"
            raise type(error)(f"{where}: {error}") from error

    def _moments(self, selection: Selection) -> Iterator[Moment]:
        for episode in selection.episodes:
            yield from self.dataset.moments(episode, selection.steps(episode), self.horizon)

    def _observation(self, moment: Moment) -> dict[str, Any]:
        return self.keys.observation(moment.observation, self.settings.task)

    def _infer(self, observations: Sequence[Mapping[str, Any]], seeds: Sequence[int]) -> list[np.ndarray | ActionError]:
        """Each one's chunk, or why its answer is none."""
        try:
            if len(observations) == 1:
                results = [self.policy.infer(observations[0], seed=seeds[0])]
            else:
                results = self.policy.infer_batch(observations, seed=seeds)
        except ActionError as error:
            if len(observations) == 1:
                return [error]
            each = zip(observations, seeds, strict=True)  # the others' are good
            return [self._infer([observation], [seed])[0] for observation, seed in each]
        return [result["actions"][:, : self.width] for result in results]

    def _varied(self, observation: Mapping[str, Any], seed: int) -> list[np.ndarray] | None:
        """The chunk with each variation of the inputs; None if one of them is none, or a camera is missing."""
        if not all(key in observation for key in self.keys.cameras):
            return None
        chunks = []
        for variation in self.variations:
            (chunk,) = self._infer([variation.change(observation)], [seed])
            if isinstance(chunk, ActionError):
                return None
            chunks.append(chunk)
        return chunks

    def _answer(self, moment: Moment, observation: Mapping[str, Any], chunk: np.ndarray) -> "_Answer":
        pipeline, model = self.policy.pipeline, self.policy.config.model
        one = pipeline.see(observation, resize=False)
        reading = self._checks.reading(one)
        pipeline.read(one)
        constant = np.zeros((3, model.action_horizon, model.action_dim), np.float32)
        constant[1:] = self._ends[:, None]
        made = pipeline.after_all(constant, [one.state] * 3)
        middle, *ends = (chunk["actions"][0, : self.width] for chunk in made)
        return _Answer(
            (moment.episode, moment.step),
            self._padded(moment.recorded),
            self._before(moment),
            chunk,
            middle,
            np.sort(ends, axis=0),  # some joints turn the other way
            np.array(one.robot.state, np.float64),
            {} if reading is None else {name: Sample(each.shape, each.pixels) for name, each in reading.images.items()},
        )

    def _padded(self, recorded: np.ndarray) -> np.ndarray:
        if recorded.shape[1] < self.width:
            raise ObservationError(f"{self.dataset.path}: an episode has {recorded.shape[1]} actions, not {self.width}")
        padded = np.full((self.horizon, self.width), np.nan)
        padded[: len(recorded)] = recorded[:, : self.width]
        return padded

    def _before(self, moment: Moment) -> np.ndarray:
        return np.full(self.width, np.nan) if moment.previous is None else moment.previous[: self.width]


@dataclass(frozen=True)
class _Answer:
    """What is kept of a moment: not its images."""

    at: tuple[Episode, int]
    recorded: np.ndarray
    previous: np.ndarray
    chunk: np.ndarray
    middle: np.ndarray
    ends: np.ndarray
    state: np.ndarray
    images: Mapping[str, Sample]


def broken_text(one: Broken) -> str:
    """Where it is, and why."""
    return f"episode {one.episode}, step {one.step}: {one.why}"


def _by_camera(answers: Sequence[_Answer]) -> dict[str, list[Sample]]:
    found: dict[str, list[Sample]] = {}
    for answer in answers:
        for name, each in answer.images.items():
            found.setdefault(name, []).append(each)
    return found


def _batches(moments: Iterator[Moment], size: int) -> Iterator[list[Moment]]:
    while batch := list(itertools.islice(moments, size)):
        yield batch


def variations_of(keys: KeyMap) -> list[Variation]:
    """Mistakes that are easily made with cameras: exchanged, BGR for RGB, turned."""

    def of_all(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
        """`change` of every image, as [h, w, 3]."""

        def changed(observation: Mapping[str, Any]) -> dict[str, Any]:
            images = {}
            for key in keys.cameras:
                first = observation[key].shape[-1] != 3
                image = observation[key].transpose(1, 2, 0) if first else observation[key]
                image = change(image)
                images[key] = np.ascontiguousarray(image.transpose(2, 0, 1) if first else image)
            return {**observation, **images}

        return changed

    def exchanged(one: str, other: str) -> Callable[[Mapping[str, Any]], dict[str, Any]]:
        return lambda observation: {**observation, one: observation[other], other: observation[one]}

    found = [Variation(f"{a} and {b} exchanged", exchanged(a, b)) for a, b in itertools.combinations(keys.cameras, 2)]
    if keys.cameras:
        found.append(Variation("red and blue exchanged", of_all(lambda image: image[..., ::-1])))
        found.append(Variation("images turned by 180 degrees", of_all(lambda image: image[::-1, ::-1])))
    return found
