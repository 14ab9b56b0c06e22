"""How surely known images (policy/known_cameras.py) show mistakes with cameras that were planted in LIBERO's images.

    MUJOCO_GL=osmesa PYTHONPATH=src:tools:packages/turbopi-lab/src python -m camera_mistakes --out FILE

The small policy's expert plays libero_spatial's ten tasks from three initial states; a moment is every twelfth step,
and the two behind the first. It needs turbopi-lab and turbopi[libero], and takes some minutes.
"""

import argparse
import json
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from turbopi.policy.known_cameras import KnownCameras
from turbopi.policy.readings import sample
from turbopi.policy.watch import Sample
from turbopi.support.files import write_whole
from turbopi.support.provenance import provenance
from turbopi.support.reading import plain_document
from turbopi_lab.small_policy.expert import Expert
from turbopi_lab.small_policy.scenes import BOWL, MAX_STEPS, NUM_TASKS, PracticeScene

STATES = (30, 31, 32)
EVERY = 12  # steps


class Moment(NamedTuple):
    task: int
    state: int
    step: int
    base: Sample
    wrist: Sample


Pair = tuple[Sample, Sample]


def changed(of: Sample, change: Callable[[np.ndarray], np.ndarray]) -> Sample:
    pixels = np.frombuffer(of.pixels, np.uint8).reshape(-1, 3)
    return Sample(of.shape, change(pixels).tobytes())


def bgr(of: Sample) -> Sample:
    return changed(of, lambda pixels: pixels[:, ::-1])


def turned(of: Sample) -> Sample:
    return changed(of, lambda pixels: pixels[::-1])


PLANTED: dict[str, Callable[[Sample, Sample], Pair]] = {
    "nothing": lambda base, wrist: (base, wrist),
    "cameras exchanged": lambda base, wrist: (wrist, base),
    "both BGR": lambda base, wrist: (bgr(base), bgr(wrist)),
    "the wrist camera BGR": lambda base, wrist: (base, bgr(wrist)),
    "both turned by 180 degrees": lambda base, wrist: (turned(base), turned(wrist)),
    "the wrist camera turned": lambda base, wrist: (base, turned(wrist)),
    "exchanged and BGR": lambda base, wrist: (bgr(wrist), bgr(base)),
}
KNOWN: dict[str, Callable[[Moment, int, int], bool]] = {  # of which moments, for an episode of a task and a state
    "other initial states of all tasks": lambda one, task, state: one.state != state,
    "other initial states of other tasks": lambda one, task, state: one.state != state and one.task != task,
    "one episode of another task": lambda one, task, state: (
        one.task == (task + 1) % NUM_TASKS and one.state == STATES[(STATES.index(state) + 1) % len(STATES)]
    ),
}


def episode(task: int, state: int) -> list[Moment]:
    scene, moments, solved, step = PracticeScene(task), list[Moment](), False, 0
    scene.reset(state)
    expert = Expert(scene.domain, BOWL)
    while not solved and step < MAX_STEPS:
        action = expert.act()
        if is_seen(step):
            images = scene.observation()
            both = [sample(images[key]) for key in ("observation/image", "observation/wrist_image")]
            moments.append(Moment(task, state, step, *(Sample(one.shape, one.pixels) for one in both)))
        step += 1
        solved = scene.step(action, look=is_seen(step))
    scene.close()
    print(f"task {task}, initial state {state}: {'solved' if solved else 'failed'}, {step} steps", flush=True)
    return moments


def is_seen(step: int) -> bool:
    return step % EVERY == 0 or step in (1, 2)


def found(moments: list[Moment], known: Callable[[Moment, int, int], bool]) -> dict[str, dict[str, int]]:
    """By what was planted, at how many moments a note said something, at all and at episodes' first ones."""
    counts = {name: {"first": 0, "all": 0} for name in PLANTED}
    for task, state in sorted({(one.task, one.state) for one in moments}):
        right = [one for one in moments if known(one, task, state)]
        cameras = KnownCameras.of_samples({"base": [one.base for one in right], "wrist": [one.wrist for one in right]})
        assert cameras is not None
        for one in moments:
            if (one.task, one.state) == (task, state):
                for name, plant in PLANTED.items():
                    noted = bool(cameras.notes(dict(zip(("base", "wrist"), plant(one.base, one.wrist), strict=True))))
                    counts[name]["all"] += noted
                    counts[name]["first"] += noted and one.step == 0
    return counts


def main() -> None:
    parser = argparse.ArgumentParser(description="Mistakes with cameras that known images show.")
    parser.add_argument("--out", type=Path, metavar="FILE", required=True)
    given = parser.parse_args()
    moments = [one for state in STATES for task in range(NUM_TASKS) for one in episode(task, state)]
    document = {
        "provenance": plain_document(provenance(torch.device("cpu"))),
        "moments": {"first": sum(one.step == 0 for one in moments), "all": len(moments)},
        "found": {name: found(moments, known) for name, known in KNOWN.items()},
    }
    write_whole(given.out, json.dumps(document, indent=1) + "\n")


if __name__ == "__main__":
    main()
