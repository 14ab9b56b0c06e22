"""Statistics to normalise with, from demonstrations that are played without images."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from turbopi.checkpoint.norm_stats import FeatureStats, NormStats, dump_norm_stats
from turbopi.evaluate.plan import parse_numbers
from turbopi.sim.libero import openpi_state
from turbopi_lab.small_policy.expert import Expert
from turbopi_lab.small_policy.scenes import MAX_STEPS, TRAINING_STATES, PracticeScene, Setting

NOISE = 0.2


def play(tasks: str, episodes: int) -> tuple[np.ndarray, np.ndarray]:
    """States float[n, 8] and the expert's actions float[n, 7] of noisy episodes, half of them with objects moved."""
    states, actions = [], []
    for task in parse_numbers("--tasks", tasks):
        scene, rng = PracticeScene(task), np.random.default_rng(task)
        for number in range(episodes):
            moved = int(rng.integers(2**31)) if number % 2 else None
            setting = Setting(task, int(rng.choice(TRAINING_STATES)), number % 3 == 2, moved)
            scene.begin(setting)
            expert = Expert(scene.domain, setting.bowl)
            for _ in range(MAX_STEPS):
                action = expert.act()
                states.append(openpi_state(scene._obs))
                actions.append(action)
                noise = rng.normal(0, NOISE, 7) * [1, 1, 1, 0.3, 0.3, 0.3, 0]
                scene.step(np.clip(action + noise, -1, 1), look=False)
                if scene.solved(setting):
                    break
        scene.close()
    return np.array(states), np.array(actions)


def merged(files: Sequence[Path]) -> tuple[np.ndarray, np.ndarray]:
    loaded = [np.load(file) for file in files]
    return np.concatenate([one["states"] for one in loaded]), np.concatenate([one["actions"] for one in loaded])


def write(file: Path, states: np.ndarray, actions: np.ndarray) -> None:
    """openpi's norm_stats.json: mean, standard deviation, 1 % and 99 % quantiles."""
    stats = NormStats(state=_of(states), actions=_of(actions))
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(dump_norm_stats(stats) + "\n")
    print(f"{file}: {len(states)} steps")


def _of(values: np.ndarray) -> FeatureStats:
    low, high = np.quantile(values, 0.01, axis=0), np.quantile(values, 0.99, axis=0)
    return FeatureStats(mean=values.mean(0), std=values.std(0), q01=low, q99=high)
