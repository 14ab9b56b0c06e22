"""A robot's control loop at a fixed rate, which never waits for the policy: RealTimeExecutor over a server.

    turbopi serve --random-weights pi05_tiny &   # or your checkpoint
    python examples/robot_loop.py                # --execution rtc joins chunks (docs/real_time.md)

A server that is killed, hangs, is late or can't be reached makes the arm hold, and go on with a new observation once it
answers again. The robot's computer needs no PyTorch: docs/real_time.md says what to install there. With the GPU in the
same machine, put a UnifiedPolicy in the client's place. The arm here is made up, with LIBERO's keys; put your own into
`Arm`. Before it has power, read docs/safety.md.
"""

import argparse
import contextlib
import time

import numpy as np

from turbopi.realtime import RealTimeClient, RealTimeExecutor, ServerLost
from turbopi.support.errors import TurboPiError

# What to command when there is no action. LIBERO's actions are movements, so the arm stays where it is with zeros; NaN
# keeps the gripper's last command. For absolute positions leave hold_action out, and give the executor max_jump.
HOLD = np.array([0.0] * 6 + [np.nan])


class Arm:
    """What a robot must be able to do: look, carry out one action, and stay where it is."""

    LOWEST, HIGHEST = np.full(6, -2.0), np.full(6, 2.0)  # your limits: nobody else knows them

    def __init__(self) -> None:
        self._random = np.random.default_rng(0)
        self._pose = np.zeros(6)

    def observe(self) -> dict[str, object]:
        return {
            "observation/image": self._random.integers(0, 256, (224, 224, 3), dtype=np.uint8),
            "observation/wrist_image": self._random.integers(0, 256, (224, 224, 3), dtype=np.uint8),
            "observation/state": np.concatenate([self._pose, [0.02, -0.02]]),
            "prompt": "pick up the black bowl",
        }

    def move(self, action: np.ndarray) -> None:
        self._pose = np.clip(self._pose + 0.01 * np.clip(action[:6], -1, 1), self.LOWEST, self.HIGHEST)

    def hold(self) -> None:
        """Stay where it is."""


def connected(host: str, port: int, patience_s: float, answer_s: float) -> RealTimeClient:
    """A server takes connections once it is warm: some seconds to a minute after its start."""
    end = time.monotonic() + patience_s
    while True:
        try:
            return RealTimeClient(host, port, answer_s=answer_s)
        except ServerLost:
            if time.monotonic() > end:
                raise SystemExit(
                    f"no server answers at {host}:{port}; start one with: turbopi serve CHECKPOINT"
                ) from None
            time.sleep(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--host", default="localhost")
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--execution", default="async", help="a way to run of docs/real_time.md")
    parser.add_argument("--hz", type=float, default=20, help="control steps a second")
    parser.add_argument("--steps", type=int, default=100, help="control steps until it ends")
    parser.add_argument("--age", type=float, default=5, metavar="S", help="oldest image that may act; with a GPU: 1")
    parser.add_argument(
        "--patience", type=float, default=120, metavar="S", help="seconds that the server may take to start"
    )
    options = parser.parse_args()
    arm = Arm()
    try:
        with (
            connected(options.host, options.port, options.patience, options.age) as policy,
            RealTimeExecutor(
                policy,
                control_hz=options.hz,
                execution=options.execution,
                hold_action=HOLD,
                hold_on=[f"camera_{how}" for how in ("black", "frozen", "missing", "exchanged", "channels", "turned")],
                max_observation_age_s=options.age,
            ) as executor,
            contextlib.suppress(KeyboardInterrupt),
        ):
            print(f"warm after {executor.warm_up(arm.observe()):.1f} s")  # the arm stands still here
            tick, kind = time.monotonic(), ""
            for step in range(options.steps):
                if executor.wants_observation:  # the images of other steps wouldn't be used
                    executor.observe(arm.observe())
                command = executor.next_action()  # never waits for the policy; the log says why there is no action
                if command.kind != kind:
                    kind = command.kind
                    print(f"step {step}: commands are {kind}")
                if command.action is not None:
                    arm.move(command.action)
                tick += 1 / options.hz
                time.sleep(max(0.0, tick - time.monotonic()))
    except TurboPiError as error:  # before the first action: the wrong robot, a policy that is too slow
        raise SystemExit(str(error)) from error
    finally:
        arm.hold()  # after Ctrl-C, too
    report = executor.report()
    print(f"{report['chunks']} chunks, commands {report['commands']}, dropped {report['dropped']}")


if __name__ == "__main__":
    main()
