"""A robot's control loop over openpi's own client: ask for a chunk, carry out its first actions, ask again.

    turbopi serve --random-weights pi05_tiny &       # or your checkpoint
    python examples/robot_loop.py

The client's environment needs `pip install openpi-client typing_extensions` alone (it wants numpy < 2). The arm here is
made up, with LIBERO's keys; put your own into `Arm`. Before it has power, read docs/safety.md.
"""

import argparse
import time

import numpy as np
from openpi_client.websocket_client_policy import WebsocketClientPolicy

HZ = 20  # control steps a second
EXECUTED = 5  # actions of a chunk, before the next one is asked for


class Arm:
    """What a robot must be able to do: look, and carry out one action."""

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


def connected(host: str, port: int, patience_s: float) -> WebsocketClientPolicy:
    """A server takes connections once it is warm: some seconds to a minute after its start."""
    end = time.monotonic() + patience_s
    while True:
        try:
            return WebsocketClientPolicy(host, port)
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise SystemExit(
                    f"no server answers at {host}:{port}; start one with: turbopi serve CHECKPOINT"
                ) from None
            time.sleep(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--chunks", type=int, default=4)
    parser.add_argument(
        "--patience", type=float, default=120, metavar="S", help="seconds that the server may take to start"
    )
    options = parser.parse_args()
    policy, arm = connected(options.host, options.port, options.patience), Arm()
    print("connected to a policy for", policy.get_server_metadata()["robot"])
    for _ in range(options.chunks):
        requested = time.monotonic()
        try:
            answer = policy.infer(arm.observe())
        except RuntimeError as error:  # the server says why there are no actions
            arm.hold()
            raise SystemExit(f"no actions: {error}") from error
        print(f"{len(answer['actions'])} actions after {1e3 * (time.monotonic() - requested):.0f} ms")
        for action in answer["actions"][:EXECUTED]:
            arm.move(action)
            time.sleep(1 / HZ)
    arm.hold()


if __name__ == "__main__":
    main()
