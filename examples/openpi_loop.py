"""A robot's control loop over openpi's own client, which has no timeout: it runs on a thread, and the loop never waits.

    turbopi serve --random-weights pi05_tiny &       # or your checkpoint
    python examples/openpi_loop.py

robot_loop.py does more, with Turbo-Pi's client; this one is for an environment that has openpi's alone (`pip install
openpi-client "websockets>=15" typing_extensions`; it wants numpy < 2). A server that is killed, hangs or is late makes
the arm hold, and go on with a new observation once it answers again. A silent network is noticed by websockets, from 15
on, after 40 s; the arm holds meanwhile. The arm here is made up, with LIBERO's keys; put your own into `Arm`. Before it
has power, read docs/safety.md.
"""

import argparse
import contextlib
import queue
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

HZ = 20  # control steps a second
EXECUTED = 5  # actions of a chunk, before the next one is requested


class Arm:
    """What a robot must be able to do: look, carry out one action, and stay where it is."""

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._state = np.zeros(8)

    def observe(self) -> dict[str, object]:
        return {
            "observation/image": self._random.integers(0, 256, (224, 224, 3), dtype=np.uint8),
            "observation/wrist_image": self._random.integers(0, 256, (224, 224, 3), dtype=np.uint8),
            "observation/state": self._state.copy(),
            "prompt": "pick up the black bowl",
        }

    def move(self, action: np.ndarray) -> None:
        self._state[:7] += 0.01 * np.clip(action, -1, 1)  # your limits: nobody else knows them

    def hold(self) -> None:
        """Stay where it is."""


class Policy:
    """openpi's client on a thread of its own, which connects again whenever the connection is lost."""

    def __init__(self, host: str, port: int) -> None:
        self._observations: queue.SimpleQueue[dict[str, object]] = queue.SimpleQueue()
        self._events: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._ready, self._taken_at = False, 0.0
        threading.Thread(target=self._run, args=(host, port), daemon=True).start()

    def _run(self, host: str, port: int) -> None:
        while True:
            try:
                client = WebsocketClientPolicy(host, port)
                self._events.put(("connected", client.get_server_metadata()))
                while True:
                    observation = self._observations.get()
                    try:
                        self._events.put(("chunk", client.infer(observation)["actions"]))
                    except RuntimeError as error:  # the server says why there are no actions
                        self._events.put(("refused", str(error)))
            except Exception as error:
                self._events.put(("lost", f"{type(error).__name__}: {error}"))
                time.sleep(1)

    def connected(self, patience_s: float) -> dict[str, Any]:
        """The server's metadata. A server takes connections once it is warm: seconds to a minute after its start."""
        end, what = time.monotonic() + patience_s, ""
        while what != "connected":
            try:
                what, value = self._events.get(timeout=max(0.0, end - time.monotonic()))
            except queue.Empty:
                raise SystemExit("no server answers there; start one with: turbopi serve CHECKPOINT") from None
        self._ready = True
        return dict(value)

    def actions(self, observe: Callable[[], dict[str, object]], oldest_s: float) -> list[np.ndarray]:
        """The next actions, or none. Never waits. An answer to an image older than `oldest_s` is dropped."""
        actions: list[np.ndarray] = []
        while not self._events.empty():
            what, value = self._events.get()
            self._ready = what != "lost"
            age = time.monotonic() - self._taken_at
            if what == "chunk" and age <= oldest_s and np.isfinite(value).all():
                return list(value[:EXECUTED])
            if what != "connected":
                print(f"no actions: {what} ({f'after {age:.1f} s' if what == 'chunk' else value})")
        if self._ready:
            self._ready, self._taken_at = False, time.monotonic()
            self._observations.put(observe())
        return actions


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--steps", type=int, default=100, help="control steps until it ends")
    parser.add_argument("--age", type=float, default=5, metavar="S", help="oldest image that may act; with a GPU: 1")
    parser.add_argument(
        "--patience", type=float, default=120, metavar="S", help="seconds that the server may take to start"
    )
    options = parser.parse_args()
    policy, arm = Policy(options.host, options.port), Arm()
    print("connected to a policy for", policy.connected(options.patience)["robot"])
    actions: list[np.ndarray] = []
    commands: Counter[str] = Counter()
    try:
        with contextlib.suppress(KeyboardInterrupt):
            tick = time.monotonic()
            for _ in range(options.steps):
                actions = actions or policy.actions(arm.observe, options.age)
                commands["fresh" if actions else "held"] += 1
                if actions:
                    arm.move(actions.pop(0))
                else:
                    arm.hold()
                tick += 1 / HZ
                time.sleep(max(0.0, tick - time.monotonic()))
    finally:
        arm.hold()  # after Ctrl-C, too
    print(f"commands {dict(commands)}")


if __name__ == "__main__":
    main()
