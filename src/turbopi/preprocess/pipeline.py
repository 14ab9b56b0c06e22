"""The policy's two edges: a robot's observation to the model's inputs, and the model's actions to the robot's.

Each edge is a list of steps, in openpi's order; the second undoes the first. Facts that are easy to get wrong: the
state goes into the prompt normalised but not padded (but by LeRobot 0.4), and relative actions are added to the state
un-normalised: openpi un-normalises what it has normalised, LeRobot has kept what came.
"""

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from turbopi.checkpoint.norm_stats import NormStats
from turbopi.config import CAMERAS, PolicyConfig
from turbopi.models import family_of
from turbopi.models.observation import ModelInputs
from turbopi.preprocess.images import RESIZES, WAYS, all_fitted, fitted, placement
from turbopi.preprocess.normalize import Normalizer, pad_last
from turbopi.preprocess.relative_actions import add_state, reanchored
from turbopi.preprocess.robot_checks import (
    check_shape,
    notes_on_statistics,
    read_observation,
    width_of_outputs,
)
from turbopi.preprocess.text_prompts import action_text
from turbopi.preprocess.tokenizer import PromptTokenizer, Write
from turbopi.robots import Robot, RobotInputs, robot_for
from turbopi.robots.aloha import smolvla_actions, smolvla_state
from turbopi.robots.base import Example, all_finite, keys_of, listed, read_prompt, read_state
from turbopi.robots.images import check_hwc, is_rgb8, to_uint8
from turbopi.robots.lerobot import LeRobot
from turbopi.robots.plain import Plain
from turbopi.support.errors import ActionError, ConfigError, ObservationError

_CAMERAS = frozenset(CAMERAS)


@dataclass
class Incoming:
    """One observation on its way in: `Pipeline.see` fills the first half, `Pipeline.read` the rest.

    resize          False: images in uint8 keep their size, for a backend that resizes them
    guidance        scale of guidance by the pipeline's tag: 0 is the prompt alone, 1 the one with the tag alone
    cameras         the model's, in its order: keys of the robot's images
    images        (uint8|float32)[224, 224, 3] of each camera that is `valid`; some may be the observation's own
    sent            of each camera, whether the observation has it
    valid           of each camera, whether the model sees an image of it
    prompt_state    float64[s]  normalised, as prompts have it
    state           float64[s]  normalised, padded to action_dim at least; Pi0.5 may have a wider one, for its prompt.
                                In the end what `Pipeline.after` needs: as it came, where LeRobot adds it to actions
    model_state     float32[action_dim]  what fits of it, as the model reads it
    tagged          int64[P]  valid ids of the prompt with the tag, if both prompts count
    """

    observation: Mapping[str, object]
    resize: bool = True
    guidance: float = 0.0
    robot: RobotInputs = field(init=False)
    prompt: str = field(init=False)
    cameras: tuple[str, ...] = field(init=False)
    camera_images: list[np.ndarray] = field(init=False)
    sent: list[bool] = field(init=False)
    valid: list[bool] = field(init=False)

    prompt_state: np.ndarray = field(init=False)
    state: np.ndarray = field(init=False)
    model_state: np.ndarray = field(init=False)
    tokens: np.ndarray = field(init=False)
    token_mask: np.ndarray = field(init=False)
    tagged: np.ndarray | None = None

    @property
    def image_mask(self) -> np.ndarray:  # bool[C]
        return np.array(self.valid, np.bool_)


@dataclass
class _Outgoing:
    """A call's action chunks on their way out, all at once: eight together take twice as long as one alone."""

    actions: np.ndarray  # [B, H, d]
    states: Sequence[np.ndarray]  # of each [s], s from action_dim


class Pipeline:
    """What happens before and after the model, for one policy.

    config          the model's sizes, the robot, how to normalise and resize
    stats           the checkpoint's statistics
    tokenizer       see `turbopi.preprocess.tokenizer.load_tokenizer`
    default_prompt  for observations without one; before the config's and the robot's
    robot           instead of the config's: a name, a description's path, or an object. The config's options are for
                    the robot that it names alone

    tag             behind a line of its own in guided prompts (`PromptGuidance`), which then go the prompt's own way
    write           how the family's prompts are written, where it has rules of its own (`Family.prompt`)

    `notes` says what the user had better look at. Raises ConfigError if these don't fit each other. Calls change
    nothing in it but which long prompt was warned about.
    """

    def __init__(
        self,
        config: PolicyConfig,
        stats: NormStats,
        tokenizer: PromptTokenizer,
        default_prompt: str | None = None,
        robot: str | Robot | None = None,
        tag: str | None = None,
    ) -> None:
        self.config, self.tokenizer, self.tag = config, tokenizer, tag
        self.robot = robot_for(config.robot if robot is None else robot, config.robot, config.robot_options)
        prompts = (default_prompt, config.default_prompt, self.robot.default_prompt)
        self.default_prompt = next((prompt for prompt in prompts if prompt is not None), None)
        self.state_scale = Normalizer(config.normalization.state, stats.state, "state")
        self.action_scale = Normalizer(config.normalization.actions, stats.actions, "actions")
        self._check()
        self._action_width = self._dry_run()
        mask = self.robot.delta_mask
        self._delta_mask = None if mask is None else np.array(mask, np.bool_)
        # Whether actions become absolute as in LeRobot: by the state that came, in float32.
        scaled_by_lerobot = self.state_scale.is_lerobot or self.action_scale.is_lerobot
        self._adds_raw_state = mask is not None and scaled_by_lerobot
        self._image_shape = (config.model.image_size,) * 2
        write, acts_on_subtasks = family_of(config.model).prompt, config.text is not None and config.text.subtasks
        self.write: Write | None = action_text if acts_on_subtasks else None
        if write is not None:
            self.write = functools.partial(write, config.model)
        self._float_images = WAYS[config.image_resize].float_images
        self._black = np.zeros((*self._image_shape, 3), np.uint8) if config.missing_cameras == "black" else None
        self.notes = notes_on_statistics(self.robot, self.state_scale, self.action_scale)
        self.before_vision: tuple[Callable[[Incoming], None], ...] = (
            self._read_observation,
            self._choose_prompt,
            self._resize_images,
        )
        self.before_prefix: tuple[Callable[[Incoming], None], ...] = (
            self._normalize_state,
            self._tokenize,
            self._pad_state,
            self._keep_raw_state,
        )
        self.after_model: tuple[Callable[[_Outgoing], None], ...] = (
            self._unnormalize,
            self._make_absolute,
            self._write_actions,
        )

    def before(self, observation: Mapping[str, object]) -> tuple[ModelInputs, np.ndarray]:
        """The model's inputs, and the state float64[s] that `after` needs (normalised and padded, see `Incoming`).

        The observation isn't changed, and nothing returned shares memory with it. Raises ObservationError if it can't
        be used.
        """
        one = self.see(observation)
        return self.complete(one), one.state

    def complete(self, one: Incoming) -> ModelInputs:
        """The model's inputs for an observation of which `see` has made the first half; makes the second."""
        self.read(one)
        black, dtype = (-1, np.float32) if self._float_images else (0, np.uint8)
        images: np.ndarray = np.empty((len(one.valid), *self._image_shape, 3), dtype)
        camera_images = iter(one.camera_images)
        for valid, image in zip(one.valid, images, strict=True):
            image[:] = next(camera_images) if valid else black
        return ModelInputs(images, one.image_mask, one.tokens, one.token_mask, one.model_state)

    def see(self, observation: Mapping[str, object], *, resize: bool = True, guidance: float = 0.0) -> Incoming:
        """The first half of `before`: all that vision needs. `read` is the other. The options: see `Incoming`."""
        if not isinstance(observation, Mapping):
            raise ObservationError(f"an observation is a dict, got {type(observation).__name__}")
        one = Incoming(observation, resize, guidance)
        for step in self.before_vision:
            step(one)
        return one

    def state(self, observation: Mapping[str, object]) -> np.ndarray:
        """The robot's state in an observation, float[s], in the units of the statistics. Raises ObservationError."""
        return read_state(read_observation(self.robot, observation).state, "state", self.robot.state_dim)

    def read(self, one: Incoming) -> None:
        """The second half of `before`: state and prompt."""
        for step in self.before_prefix:
            step(one)

    def after(self, model_actions: np.ndarray, state: np.ndarray) -> dict[str, Any]:
        """{"actions": float64[H, d]} in the robot's units, all finite.

        For a robot with `action_keys` also "named_actions": {key: float64[H]}, the same numbers.

        model_actions  float32[H, action_dim]
        state          as `before` returned it

        Raises ActionError if any of the model's numbers, also of dimensions that the robot doesn't have, or any of the
        robot's is NaN or infinite, and if the robot's `outputs` gives another shape.
        """
        return self.after_all(model_actions[None], [state])[0]

    def after_all(self, model_actions: np.ndarray, states: Sequence[np.ndarray]) -> list[dict[str, Any]]:
        """`after` of each observation of a batch: its chunks are float32[B, H, action_dim].

        An ActionError names the first row that is wrong, if there are several.
        """
        assert model_actions.shape[::2] == (len(states), self.config.model.action_dim), model_actions.shape
        if not all_finite(model_actions):
            raise _not_finite(
                model_actions,
                "the model computed",
                ". Look at the checkpoint's weights (`turbopi inspect`) and, in FP8, at its calibration: `turbopi "
                "verify` compares this backend with the float32 reference",
            )
        out = _Outgoing(model_actions, states)
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            for step in self.after_model:
                step(out)
        if not all_finite(out.actions):
            raise _not_finite(
                out.actions,
                f"un-normalised, robot {self.robot.name} gets",
                ", though the model's numbers are finite. Look at the checkpoint's statistics of actions, and of the "
                "state if actions are relative to it, and at the robot's `outputs`",
            )
        keys = getattr(self.robot, "action_keys", None)
        if keys is None:
            return [{"actions": actions} for actions in out.actions]
        return [
            {"actions": actions, "named_actions": dict(zip(keys, np.ascontiguousarray(actions.T), strict=True))}
            for actions in out.actions
        ]

    def anchor(self, state: np.ndarray) -> np.ndarray | None:
        """What `after` adds to relative actions, float64[len(delta_mask)] in their units; None for absolute ones.

        state   as `before` returned it
        """
        if self._delta_mask is None:
            return None
        return np.array(self._in_units(state)[: len(self._delta_mask)], np.float64)

    def _in_units(self, state: np.ndarray) -> np.ndarray:
        """The state that relative actions are added to, from the one that `before` returned."""
        return state if self._adds_raw_state else self.state_scale.unnormalize(state)

    def reanchored(self, left_over: np.ndarray, anchor: np.ndarray | None, state: np.ndarray) -> np.ndarray:
        """Relative actions float32[K, action_dim], normalised, as seen from another state: the same absolute ones.

        anchor  of the state that they are relative to; `state` is the new one, as `before` returned it. Absolute
                actions are returned as they are

        Raises ObservationError for an anchor of another shape, or one that isn't finite, and if the result isn't.
        """
        mask, new = self._delta_mask, self.anchor(state)
        if mask is None or new is None:
            return left_over
        old = np.asarray(anchor)
        if old.dtype.kind not in "fiu" or old.shape != new.shape or not np.isfinite(old).all():
            raise ObservationError(
                f"the anchor has shape {list(old.shape)} and dtype {old.dtype}; it should be {len(new)} finite "
                'numbers, what came with the left-over under "anchor"'
            )
        with np.errstate(over="ignore", invalid="ignore"):  # refused below
            moved = reanchored(left_over, old.astype(np.float64), new, mask, self.action_scale)
        if not (finite := np.isfinite(moved)).all():
            row, column = (int(axis) for axis in np.argwhere(~finite)[0])
            raise ObservationError(
                f"the left-over, moved from its anchor to the new state, isn't finite in float32 at [{row}, {column}]: "
                f"there it is {left_over[row, column]:.3g}, normalised, the anchor {old[column]:.3g} and the new state "
                f"{new[column]:.3g}. Give the anchor that came with the left-over"
            )
        return moved

    def example(self, seed: int = 0) -> dict[str, Any]:
        """A random valid observation in the robot's own keys; the same for the same seed."""
        made = self.robot.example(np.random.default_rng(seed))
        if isinstance(self.robot, Plain):  # takes any width, the statistics don't
            made["state"] = self.state_scale.fitted(made["state"])
        return Example(made)

    @property
    def metadata(self) -> dict[str, Any]:
        """What a client may want to know of the robot, in plain values; what only some robots have if this one does."""
        described: dict[str, object] = {
            "robot": self.robot.name,
            "robot_state_dim": self.robot.state_dim,
            "robot_action_dim": self._action_width,
            "default_prompt": self.default_prompt,
        }
        if self.tag is not None:
            described["guidance_tag"] = self.tag
        if self.robot.reset_pose is not None:
            described["reset_pose"] = list(self.robot.reset_pose)
        if isinstance(self.robot, LeRobot):
            described |= self.robot.features
        return described

    # Before the model

    def _read_observation(self, sample: Incoming) -> None:
        sample.robot = read_observation(self.robot, sample.observation)

    def _choose_prompt(self, sample: Incoming) -> None:
        prompt = sample.robot.prompt if sample.robot.prompt is not None else self.default_prompt
        if prompt is None:
            key = next((key for key, value in self.example().items() if isinstance(value, str)), "prompt")
            raise ObservationError(
                f"the observation has no prompt. It has {listed(keys_of(sample.observation))}. Send the task as text "
                f"under {key!r}, or give the policy a default one: --default-prompt, or default_prompt in turbopi.json"
            )
        sample.prompt = read_prompt(prompt)

    def _normalize_state(self, sample: Incoming) -> None:
        state, limit = read_state(sample.robot.state, "state", self.robot.state_dim), self.config.model.state_dim
        if len(state) > limit and family_of(self.config.model).reads_state:
            raise ObservationError(f"the state has {len(state)} values, but the model takes at most {limit}")
        sample.state = self.state_scale.normalize(state)
        if self.config.turns_aloha:
            sample.state = smolvla_state(sample.state)

    def _resize_images(self, sample: Incoming) -> None:
        camera_images, present = sample.robot.images, sample.robot.image_mask
        final = sample.robot.in_order or not _CAMERAS.issuperset(camera_images)
        sample.cameras = tuple(camera_images) if final else CAMERAS
        sample.sent = [present.get(camera, camera in camera_images) for camera in sample.cameras]
        sample.valid, checked = [], []
        for camera, sent in zip(sample.cameras, sample.sent, strict=True):
            sample.valid.append(sent or self._black is not None)
            if self._black is not None and not sent:
                checked.append(self._black)
            elif sent:
                camera_image = camera_images.get(camera)
                checked.append(camera_image if is_rgb8(camera_image) else self._checked_image(camera_image, camera))
        shape, resize = self._image_shape, self.config.image_resize
        if sample.resize:
            sample.camera_images = all_fitted(checked, shape[0], resize)
        else:  # the device resizes bytes
            for camera_image in checked:
                placement(camera_image.shape, shape)  # refuses one that is too narrow before anything starts
            if self._float_images:
                checked = [one if one.dtype == np.uint8 else fitted(one, shape[0], resize) for one in checked]
            sample.camera_images = checked

    def _checked_image(self, camera_image: object, camera: str) -> np.ndarray:
        camera_image = check_hwc(camera_image, camera)
        return camera_image if self._float_images else to_uint8(camera_image, camera)

    def _tokenize(self, sample: Incoming) -> None:
        sample.prompt_state = pad_last(sample.state, self.config.prompt_state_dim or 0)
        state = sample.prompt_state if self.config.discrete_state_input else None
        sample.tokens, sample.token_mask = self._ids(sample.prompt, state, tagged=sample.guidance == 1)
        if sample.guidance not in (0, 1):
            ids, there = self._ids(sample.prompt, state, tagged=True)
            sample.tagged = ids[there]

    def _ids(self, prompt: str, state: np.ndarray | None, *, tagged: bool) -> tuple[np.ndarray, np.ndarray]:
        return self.tokenizer.tokenize(
            f"{prompt}\n{self.tag}" if tagged else prompt,
            state,
            max_tokens=self.config.model.max_prompt_tokens,
            as_is=self.config.prompt_as_is,
            labels=self.config.prompt_labels,
            write=self.write,
            tagged=tagged,
            cut=self.write is not action_text,
        )

    def _pad_state(self, sample: Incoming) -> None:
        model = self.config.model
        sample.state = pad_last(sample.state, max(model.action_dim, model.state_dim, self.state_scale.width or 0))
        with np.errstate(over="ignore"):
            state = sample.state.astype(np.float32)
        sample.model_state = state[: model.state_dim]
        if not all_finite(state):
            at = int(np.flatnonzero(~np.isfinite(state))[0])
            raise ObservationError(f"state value {at} is {sample.state[at]:g} once normalised, too large for the model")

    def _keep_raw_state(self, sample: Incoming) -> None:
        if self._adds_raw_state:
            sample.state = pad_last(np.array(sample.robot.state, np.float64), self.config.model.action_dim)

    # After the model

    def _unnormalize(self, out: _Outgoing) -> None:
        actions = smolvla_actions(out.actions) if self.config.turns_aloha else out.actions
        steps = actions.reshape(-1, actions.shape[-1])  # [B * H, d]
        out.actions = self.action_scale.unnormalize(steps).reshape(out.actions.shape)

    def _make_absolute(self, out: _Outgoing) -> None:
        mask = self._delta_mask
        if mask is None:
            return
        used = len(mask) if self._adds_raw_state else max(len(mask), self.state_scale.width or 0)
        states = self._in_units(np.array([state[:used] for state in out.states]))[:, : len(mask)]
        if self._adds_raw_state:  # in float32, as LeRobot
            out.actions, states = out.actions.astype(np.float32), states.astype(np.float32)
        add_state(out.actions, states, mask)  # in place: `_unnormalize` made them

    def _write_actions(self, out: _Outgoing) -> None:
        rows, horizon, _ = out.actions.shape
        written = np.empty((rows, horizon, self._action_width))
        for row, actions in enumerate(out.actions):
            try:
                given = self.robot.outputs(actions)
                check_shape(self.robot, given, written.shape[1:])
            except ActionError as error:
                if rows == 1:
                    raise
                raise ActionError(of_row(row, rows, str(error))) from None
            written[row] = given
        out.actions = written

    def _dry_run(self) -> int:
        """How many actions a step the robot gets. Raises ConfigError if `outputs` isn't what it should be."""
        model = self.config.model
        middle = self.action_scale.unnormalize(np.zeros((model.action_horizon, model.action_dim)))
        return width_of_outputs(self.robot, middle)

    def _check(self) -> None:
        """Refuse now what would otherwise fail, or go wrong in silence, at the first observation."""
        config, robot, limit = self.config, self.robot, self.config.model.action_dim
        family = family_of(config.model)
        if config.discrete_state_input and not family.state_in_prompt:
            raise ConfigError(
                f"{config.name}: only Pi0.5 reads the state from the prompt; {family.label} needs it set to false"
            )
        ways = RESIZES if family.planned else WAYS
        if config.image_resize not in ways:
            raise ConfigError(f"{config.name}: image_resize is {' or '.join(ways)}, not {config.image_resize!r}")
        dims = (("state", robot.state_dim, self.state_scale), ("actions", robot.action_dim, self.action_scale))
        if robot.delta_mask is not None and len(robot.delta_mask) > limit:
            raise ConfigError(
                f"robot {robot.name} has a delta_mask of {len(robot.delta_mask)} dimensions, but the model's actions "
                f"have {limit}"
            )
        for name, width, scale in dims:
            limited = name == "actions" or family.reads_state  # no other weight depends on the width
            limit = config.model.action_dim if name == "actions" else config.model.state_dim
            if width is not None and limited and width > limit:
                raise ConfigError(f"robot {robot.name} has {width} values of {name}, but the model takes {limit}")
            if scale.width is None:
                continue
            if limited and scale.width > limit:
                raise ConfigError(f"the statistics cover {scale.width} values of {name}, but the model has {limit}")
            if width is not None and width > scale.width:
                raise ConfigError(
                    f"robot {robot.name} has {width} values of {name}, but the statistics cover {scale.width}; "
                    f"are they this robot's?"
                )


def _not_finite(batch: np.ndarray, who: str, advice: str) -> ActionError:
    """The error of actions [B, H, d] that aren't all finite: it is of the first observation that has such numbers."""
    row = int(np.argwhere(~np.isfinite(batch))[0, 0])
    actions = batch[row]
    places = np.argwhere(~np.isfinite(actions))
    step, column = map(int, places[0])
    return ActionError(
        of_row(
            row,
            len(batch),
            f"{who} actions that no robot may be given: {len(places)} of {actions.size} numbers aren't finite, the "
            f"first one, {actions[step, column]}, in row {step}, column {column} (both from 0){advice}",
        )
    )


def of_row(row: int, rows: int, message: str) -> str:
    """What is wrong with an observation; if it is one of several, with its number."""
    return message if rows == 1 else f"observation {row} of {rows} (from 0): {message}"
