"""The policy's two edges: a robot's observation to the model's inputs, and the model's actions to the robot's.

Each edge is a list of steps, in openpi's order; the second undoes the first. Two facts that are easy to get wrong: the
state goes into the prompt normalised but not padded, and relative actions are added to the un-normalised state.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from turbopi.checkpoint.norm_stats import NormStats
from turbopi.config import CAMERAS, PolicyConfig
from turbopi.errors import ConfigError, ObservationError
from turbopi.images import check_hwc, resize_into, resize_unit_into, to_uint8
from turbopi.normalize import Normalizer, absolute_actions, pad_last
from turbopi.observation import ModelInputs
from turbopi.robots import Robot, RobotInputs, create_robot
from turbopi.robots.base import read_prompt, read_state
from turbopi.tokenizer import PromptTokenizer


@dataclass
class _Sample:
    """One observation on its way in."""

    observation: Mapping[str, Any]
    robot: RobotInputs = field(init=False)
    prompt: str = field(init=False)
    state: np.ndarray = field(init=False)  # float64, normalised, then padded
    images: np.ndarray = field(init=False)
    image_mask: np.ndarray = field(init=False)
    tokens: np.ndarray = field(init=False)
    token_mask: np.ndarray = field(init=False)


@dataclass
class _Result:
    """One action chunk on its way out."""

    actions: np.ndarray  # [H, d]
    state: np.ndarray  # [action_dim]


class Pipeline:
    """What happens before and after the model, for one policy.

    config          the model's sizes, the robot, how to normalise and resize
    stats           the checkpoint's statistics
    tokenizer       see `turbopi.tokenizer.load_tokenizer`
    default_prompt  for observations without one; before the config's and the robot's
    robot           instead of the config's: a name, a description's path, or an object (its options are its own)

    Raises ConfigError if these don't fit each other. Calls change nothing in it but which long prompt was warned about.
    """

    def __init__(
        self,
        config: PolicyConfig,
        stats: NormStats,
        tokenizer: PromptTokenizer,
        default_prompt: str | None = None,
        robot: str | Robot | None = None,
    ) -> None:
        self.config, self.tokenizer = config, tokenizer
        self.robot = create_robot(config.robot, config.robot_options) if robot is None else create_robot(robot)
        prompts = (default_prompt, config.default_prompt, self.robot.default_prompt)
        self.default_prompt = next((prompt for prompt in prompts if prompt is not None), None)
        self.state_scale = Normalizer(config.normalization.state, stats.state, "state")
        self.action_scale = Normalizer(config.normalization.actions, stats.actions, "actions")
        self._check()
        self.before_model: tuple[Callable[[_Sample], None], ...] = (
            self._read_observation,
            self._choose_prompt,
            self._normalize_state,
            self._resize_images,
            self._tokenize,
            self._pad_state,
        )
        self.after_model: tuple[Callable[[_Result], None], ...] = (
            self._unnormalize,
            self._make_absolute,
            self._write_actions,
        )

    def before(self, observation: Mapping[str, Any]) -> tuple[ModelInputs, np.ndarray]:
        """The model's inputs, and the state float64[action_dim] (normalised, padded) that `after` needs.

        The observation isn't changed, and nothing returned shares memory with it. Raises ObservationError if it can't
        be used.
        """
        if not isinstance(observation, Mapping):
            raise ObservationError(f"an observation is a dict, got {type(observation).__name__}")
        sample = _Sample(observation)
        for step in self.before_model:
            step(sample)
        with np.errstate(over="ignore"):
            state = sample.state.astype(np.float32)
        if not np.isfinite(state).all():
            at = int(np.flatnonzero(~np.isfinite(state))[0])
            raise ObservationError(f"state value {at} is {sample.state[at]:g} once normalised, too large for the model")
        inputs = ModelInputs(sample.images, sample.image_mask, sample.tokens, sample.token_mask, state)
        return inputs, sample.state

    def after(self, model_actions: np.ndarray, state: np.ndarray) -> dict[str, np.ndarray]:
        """{"actions": float64[H, d]} in the robot's units.

        model_actions  float32[H, action_dim]
        state          as `before` returned it
        """
        assert model_actions.shape[1:] == (self.config.model.action_dim,), model_actions.shape
        result = _Result(model_actions, state)
        for step in self.after_model:
            step(result)
        return {"actions": np.array(result.actions, np.float64)}

    def example(self, seed: int = 0) -> dict[str, Any]:
        """A random valid observation in the robot's own keys; the same for the same seed."""
        return self.robot.example(np.random.default_rng(seed))

    @property
    def metadata(self) -> dict[str, Any]:
        """What a client may want to know of the robot, in plain values; `reset_pose` only if the robot has one."""
        described: dict[str, Any] = {
            "robot": self.robot.name,
            "robot_state_dim": self.robot.state_dim,
            "robot_action_dim": self.robot.action_dim or self.config.model.action_dim,
            "default_prompt": self.default_prompt,
        }
        if self.robot.reset_pose is not None:
            described["reset_pose"] = list(self.robot.reset_pose)
        return described

    # Before the model

    def _read_observation(self, sample: _Sample) -> None:
        sample.robot = self.robot.inputs(sample.observation)

    def _choose_prompt(self, sample: _Sample) -> None:
        prompt = sample.robot.prompt if sample.robot.prompt is not None else self.default_prompt
        if prompt is None:
            raise ObservationError("the observation has no prompt, and the policy no default prompt; give one of them")
        sample.prompt = read_prompt(prompt)

    def _normalize_state(self, sample: _Sample) -> None:
        state, limit = read_state(sample.robot.state, "state", self.robot.state_dim), self.config.model.action_dim
        if len(state) > limit:
            raise ObservationError(f"the state has {len(state)} values, but the model takes at most {limit}")
        sample.state = self.state_scale.normalize(state)

    def _resize_images(self, sample: _Sample) -> None:
        pictures, present = sample.robot.images, sample.robot.image_mask
        cameras = list(CAMERAS) if set(pictures) <= set(CAMERAS) else list(pictures)
        size = self.config.model.vision.image_size
        shape = (len(cameras), size, size, 3)
        unit = self.config.image_resize == "lerobot"
        black, dtype = (-1, np.float32) if unit else (0, np.uint8)
        sample.images = np.empty(shape, dtype)
        sample.image_mask = np.array([present.get(camera, camera in pictures) for camera in cameras], np.bool_)
        for camera, valid, out in zip(cameras, sample.image_mask, sample.images, strict=True):
            if not valid:
                out.fill(black)
                continue
            picture = check_hwc(pictures.get(camera), camera)
            if picture.shape != out.shape:
                out.fill(black)  # what stays of it is the padding
            if unit:
                resize_unit_into(picture, out)
            else:
                resize_into(to_uint8(picture, camera), out)

    def _tokenize(self, sample: _Sample) -> None:
        state = sample.state if self.config.discrete_state_input else None
        sample.tokens, sample.token_mask = self.tokenizer.tokenize(
            sample.prompt, state, max_tokens=self.config.model.max_prompt_tokens
        )

    def _pad_state(self, sample: _Sample) -> None:
        sample.state = pad_last(sample.state, self.config.model.action_dim)

    # After the model

    def _unnormalize(self, result: _Result) -> None:
        result.actions = self.action_scale.unnormalize(result.actions)
        result.state = self.state_scale.unnormalize(result.state)

    def _make_absolute(self, result: _Result) -> None:
        if self.robot.delta_mask is not None:
            result.actions = absolute_actions(result.actions, result.state, self.robot.delta_mask)

    def _write_actions(self, result: _Result) -> None:
        result.actions = self.robot.outputs(result.actions)

    def _check(self) -> None:
        """Refuse now what would otherwise fail, or go wrong in silence, at the first observation."""
        config, robot, limit = self.config, self.robot, self.config.model.action_dim
        if config.discrete_state_input and config.model.kind != "pi05":
            raise ConfigError(f"{config.name}: only Pi0.5 reads the state from the prompt; Pi0 needs it set to false")
        if config.image_resize not in ("openpi", "lerobot"):
            raise ConfigError(f"{config.name}: image_resize is openpi or lerobot, not {config.image_resize!r}")
        dims = (("state", robot.state_dim, self.state_scale), ("actions", robot.action_dim, self.action_scale))
        for name, width, scale in dims:
            if width is not None and width > limit:
                raise ConfigError(f"robot {robot.name} has {width} values of {name}, but the model takes {limit}")
            if scale.width is None:
                continue
            if scale.width > limit:
                raise ConfigError(f"the statistics cover {scale.width} values of {name}, but the model has {limit}")
            if width is not None and width > scale.width:
                raise ConfigError(
                    f"robot {robot.name} has {width} values of {name}, but the statistics cover {scale.width}; "
                    f"are they this robot's?"
                )
