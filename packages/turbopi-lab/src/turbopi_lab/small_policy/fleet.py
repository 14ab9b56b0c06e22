"""The worker processes, and the thread that serves them: frames into memory, chunks out to those who ask."""

import json
import multiprocessing
import os
import threading
import time
from collections import defaultdict, deque
from collections.abc import Sequence
from multiprocessing import connection
from pathlib import Path
from typing import Any

import numpy as np

from turbopi.preprocess.normalize import Normalizer
from turbopi_lab.small_policy.actor import Actor
from turbopi_lab.small_policy.collect import Mix, run_worker
from turbopi_lab.small_policy.episodes import IMAGE_PX, Record, Tape
from turbopi_lab.small_policy.memory import Memory
from turbopi_lab.small_policy.scenes import NUM_TASKS

HARDER = (4, 9, 0, 7, 2, 6)  # scenes that get a further worker first
_GATHER_S = 0.008  # how long a question waits for company


def scene_of(worker: int) -> int:
    """Every scene has as many workers as any other, but for the last few."""
    round_, index = divmod(worker, NUM_TASKS)
    return index if round_ % 2 == 0 else [*HARDER, *(s for s in range(NUM_TASKS) if s not in HARDER)][index]


def shared_out(tapes: Sequence[Tape], scenes: Sequence[int]) -> list[list[Tape]]:
    """Each worker's tapes: those of its scene, shared with the other workers of that scene."""
    shares: list[list[Tape]] = [[] for _ in scenes]
    for number, tape in enumerate(tapes):
        workers = [worker for worker, scene in enumerate(scenes) if scene == tape.record.setting.scene]
        if workers:
            shares[workers[number % len(workers)]].append(tape)
    return shares


class Fleet(threading.Thread):
    """Runs until `stop`. `log` receives one JSON line for each episode.

    tapes      whose frames the workers of their scenes draw before they play
    draw_gpus  numbers of the GPUs that draw, shared out among the workers; none: EGL's first
    """

    def __init__(
        self,
        workers: int,
        seed: int,
        memory: Memory,
        actor: Actor,
        scale: Normalizer,
        log: Path,
        output: Path,
        tapes: Sequence[Tape] = (),
        draw_gpus: Sequence[int] = (),
    ) -> None:
        super().__init__(daemon=True)
        self.memory, self.actor, self.scale, self.log = memory, actor, scale, log
        self.stopping = False
        self.error: BaseException | None = None
        self.ready = self.episodes = 0
        self.trials: dict[int, deque[bool]] = defaultdict(lambda: deque(maxlen=12))
        self.counts: dict[str, int] = defaultdict(int)
        self._mix: Mix | None = None
        self._weights_lock = threading.Lock()
        context = multiprocessing.get_context("spawn")
        self._pipes, self._processes = [], []
        shares = shared_out(tapes, [scene_of(worker) for worker in range(workers)])
        for worker in range(workers):
            ours, theirs = context.Pipe()
            gpu = draw_gpus[worker % len(draw_gpus)] if draw_gpus else None
            arguments = (theirs, scene_of(worker), seed * 1000 + worker, str(output), shares[worker], gpu)
            process = context.Process(target=_main, args=arguments, daemon=True)
            process.start()
            theirs.close()
            self._pipes.append(ours)
            self._processes.append(process)

    def set_mix(self, mix: Mix) -> None:
        self._mix = mix
        for pipe in self._pipes:
            try:
                pipe.send(("mix", mix))
            except OSError:
                continue

    def give(self, weights: dict[str, Any]) -> None:
        """Newer weights for the learner at the wheel."""
        with self._weights_lock:
            self.actor.take(weights)

    def stop(self) -> None:
        self.stopping = True
        self.join(timeout=10)
        for process in self._processes:
            process.kill()

    def run(self) -> None:
        try:
            with self.log.open("a") as log:
                self._serve(log)
        except BaseException as error:
            self.error = error
            raise

    def _serve(self, log: Any) -> None:
        live = list(self._pipes)
        requested: list[tuple[Any, np.ndarray, int, np.ndarray]] = []
        since = 0.0
        while not self.stopping and live:
            ready: list[Any] = connection.wait(live, timeout=0.002 if requested else 0.1)
            for pipe in ready:
                try:
                    message = pipe.recv()
                    if message[0] == "frames":
                        self._take(message[1], pipe.recv_bytes(), log)
                except (EOFError, OSError):
                    live.remove(pipe)
                    self.counts["lost workers"] += 1
                    continue
                if message[0] == "look":
                    since = since if requested else time.monotonic()
                    requested.append((pipe, *message[1:]))
                elif message[0] == "ready":
                    self.ready += 1
            full = len(requested) >= self.actor.rows
            if requested and (full or time.monotonic() - since > _GATHER_S):
                self._answer(requested[: self.actor.rows])
                requested = requested[self.actor.rows :]

    def _answer(self, requested: list[tuple[Any, np.ndarray, int, np.ndarray]]) -> None:
        pipes, camera_images, prompts, held = zip(*requested, strict=True)
        with self._weights_lock:
            chunks = self.actor.chunks(self.scale, np.stack(camera_images), list(prompts), held)
        for pipe, chunk in zip(pipes, chunks, strict=True):
            try:
                pipe.send(("chunk", chunk))
            except OSError:
                continue

    def _take(self, record: Record, payload: bytes, log: Any) -> None:
        n = len(record.chunks)
        if n:
            camera_images = np.frombuffer(bytearray(payload), np.uint8).reshape(n, 2, IMAGE_PX, IMAGE_PX, 3)
            self.counts[f"{record.kind} frames"] += self.memory.add(record, camera_images)
        self.counts[record.kind] += 1
        self.counts[f"{record.kind} solved"] += record.success
        if record.kind == "trial":
            self.trials[record.setting.prompt].append(record.success)
        setting = record.setting
        line = {
            "kind": record.kind,
            "scene": setting.scene,
            "prompt": setting.prompt,
            "initial_state": setting.initial_state,
            "moved_seed": setting.moved_seed,
            "success": record.success,
            "steps": record.steps,
            "learner_steps": record.learner_steps,
            "frames": n,
        }
        log.write(json.dumps(line) + "\n")
        log.flush()


def _main(pipe: Any, scene: int, seed: int, output: str, tapes: list[Tape], gpu: int | None) -> None:
    with open(output, "ab") as file:  # simulators print
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    os.environ["OMP_NUM_THREADS"] = "1"
    if gpu is not None:
        os.environ["MUJOCO_EGL_DEVICE_ID"] = str(gpu)  # robosuite reads it
    run_worker(pipe, scene, seed, tapes)
