"""An arm and an environment without hardware, for LeRobot's own commands:

--robot.type=fake_arm   seven joints, eight numbers of state, random images; it is at once where it is sent
--env.type=fake         eight numbers of state and two cameras; five steps an episode
"""

from dataclasses import dataclass, field
from typing import Any

import gymnasium as gym
import numpy as np
from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.robots import Robot, RobotConfig

STEPS = 5
CAMERAS = {"top": (72, 96), "wrist": (80, 60)}


@RobotConfig.register_subclass("fake_arm")
@dataclass
class FakeArmConfig(RobotConfig):
    joints: list[str] = field(default_factory=lambda: [f"joint_{i}.pos" for i in range(7)])


class FakeArm(Robot):
    config_class = FakeArmConfig
    name = "fake_arm"

    def __init__(self, config: FakeArmConfig) -> None:
        super().__init__(config)
        self._positions = dict.fromkeys(config.joints, 0.0)
        self._rng, self._connected, self.sent = np.random.default_rng(0), False, 0

    @property
    def observation_features(self) -> dict[str, Any]:
        numbers = dict.fromkeys((*self._positions, "base.vel"), float)
        return numbers | {name: (*size, 3) for name, size in CAMERAS.items()}

    @property
    def action_features(self) -> dict[str, Any]:
        return dict.fromkeys(self._positions, float)

    @property
    def is_connected(self) -> bool:
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        camera_images = {
            name: self._rng.integers(256, size=(*size, 3), dtype=np.uint8) for name, size in CAMERAS.items()
        }
        return {**self._positions, "base.vel": 0.1, **camera_images}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        assert action.keys() == self._positions.keys(), action.keys()
        assert all(np.isfinite(value) for value in action.values())
        self._positions.update(action)
        self.sent += 1
        return action

    def disconnect(self) -> None:
        print(f"fake_arm was sent {self.sent} actions; it is at {list(self._positions.values())}", flush=True)
        self._connected = False


@EnvConfig.register_subclass("fake")
@dataclass
class FakeEnvConfig(EnvConfig):
    task: str | None = "v0"
    features: dict[str, PolicyFeature] = field(
        default_factory=lambda: {
            "action": PolicyFeature(FeatureType.ACTION, (7,)),
            "agent_pos": PolicyFeature(FeatureType.STATE, (8,)),
            **{f"pixels/{name}": PolicyFeature(FeatureType.VISUAL, (*size, 3)) for name, size in CAMERAS.items()},
        }
    )
    features_map: dict[str, str] = field(
        default_factory=lambda: {
            "action": "action",
            "agent_pos": "observation.state",
            **{f"pixels/{name}": f"observation.images.{name}" for name in CAMERAS},
        }
    )

    @property
    def gym_id(self) -> str:
        return "turbopi_fake/v0"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        return {"max_episode_steps": STEPS}


class FakeEnv(gym.Env[dict[str, Any], np.ndarray]):
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 - gymnasium's own form
    render_mode = "rgb_array"
    task_description = "pick up the black bowl"
    _max_episode_steps = STEPS

    def __init__(self) -> None:
        camera_images: dict[str, Any] = {
            name: gym.spaces.Box(0, 255, (*size, 3), np.uint8) for name, size in CAMERAS.items()
        }
        state = gym.spaces.Box(-10, 10, (8,), np.float64)
        self.observation_space = gym.spaces.Dict({"agent_pos": state, "pixels": gym.spaces.Dict(camera_images)})
        self.action_space = gym.spaces.Box(-100, 100, (7,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict[str, Any], dict[str, Any]]:
        super().reset(seed=seed)
        return self._seen(), {"is_success": False}

    def step(self, action: np.ndarray) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        assert action.shape == (7,) and np.isfinite(action).all(), action
        return self._seen(), float(np.abs(action).mean()), False, False, {"is_success": False}

    def render(self) -> np.ndarray:
        return np.zeros((*CAMERAS["top"], 3), np.uint8)

    def _seen(self) -> dict[str, Any]:
        camera_images = {
            name: self.np_random.integers(256, size=(*size, 3), dtype=np.uint8) for name, size in CAMERAS.items()
        }
        return {"agent_pos": self.np_random.uniform(-1, 1, 8), "pixels": camera_images}


made_by: Any = FakeEnv  # gymnasium's type of it wants arguments that this one doesn't take
gym.register("turbopi_fake/v0", entry_point=made_by)
