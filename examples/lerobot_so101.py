"""An SO-101 of LeRobot's that asks a Turbo-Pi server, with the keys that LeRobot's robot has.

    turbopi serve CHECKPOINT --robot so101_follower &                       # a LeRobot checkpoint
    python examples/lerobot_so101.py --arm /dev/ttyACM0 --camera front=0 --task "put the cube into the box"

Without an arm and a checkpoint, to try it:

    turbopi serve --random-weights pi05_tiny --robot examples/so101.json &  # openpi's checkpoints need such a file
    python examples/lerobot_so101.py

A server that is killed, hangs, is late or can't be reached leaves the arm where it is (its motors hold the last
position), until the server answers again. It runs in LeRobot's environment, with Turbo-Pi beside it. With the GPU in
the same machine no server is needed: docs/lerobot.md.
"""

import argparse
import contextlib
import time
from typing import Any

import numpy as np

from turbopi.realtime import RealTimeClient, RealTimeExecutor, ServerLost
from turbopi.support.errors import TurboPiError

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
HZ = 30


class FakeSO101:
    """LeRobot's interface without an arm."""

    def __init__(self) -> None:
        self._positions = {f"{joint}.pos": 0.0 for joint in JOINTS}

    def connect(self) -> None: ...

    def get_observation(self) -> dict[str, Any]:
        camera_images = {name: np.full((480, 640, 3), 128, np.uint8) for name in ("front", "wrist")}
        return {**self._positions, **camera_images}

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        self._positions.update(action)
        return action

    def disconnect(self) -> None: ...


def so101(port: str, cameras: dict[str, int]) -> Any:
    """LeRobot's own robot. It limits how far one action may move a joint."""
    from lerobot.cameras.opencv import OpenCVCameraConfig
    from lerobot.robots.so_follower import SO101Follower, SO101FollowerConfig

    configs = {name: OpenCVCameraConfig(index, fps=HZ, width=640, height=480) for name, index in cameras.items()}
    return SO101Follower(SO101FollowerConfig(port=port, cameras=configs, max_relative_target=10.0))


def connected(server: str, patience_s: float, answer_s: float) -> RealTimeClient:
    """A server takes connections once it is warm: some seconds to a minute after its start."""
    end = time.monotonic() + patience_s
    while True:
        try:
            return RealTimeClient(server, answer_s=answer_s)
        except ServerLost:
            if time.monotonic() > end:
                raise SystemExit(f"no server answers at {server}; start one with: turbopi serve CHECKPOINT") from None
            time.sleep(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="ws://localhost:8000")
    parser.add_argument("--arm", metavar="PORT", help="of the motors' bus; without it a fake arm moves")
    parser.add_argument("--camera", action="append", default=[], metavar="NAME=INDEX")
    parser.add_argument("--task", default="put the cube into the box")
    parser.add_argument("--steps", type=int, default=300, help="control steps until it ends")
    parser.add_argument("--age", type=float, default=5, metavar="S", help="oldest image that may act; with a GPU: 1")
    parser.add_argument(
        "--patience", type=float, default=120, metavar="S", help="seconds that the server may take to start"
    )
    options = parser.parse_args()
    cameras = {name: int(index) for name, _, index in (camera.partition("=") for camera in options.camera)}
    robot = so101(options.arm, cameras) if options.arm else FakeSO101()

    def observe() -> dict[str, Any]:
        return {**robot.get_observation(), "task": options.task}

    robot.connect()
    sent: dict[str, float] = {}
    try:
        with (
            connected(options.server, options.patience, options.age) as policy,
            RealTimeExecutor(
                policy, control_hz=HZ, execution="async", max_observation_age_s=options.age
            ) as executor,  # without hold_action: motors hold their last position
            contextlib.suppress(KeyboardInterrupt),
        ):
            named = policy.infer(observe()).get("named_actions")  # {"shoulder_pan.pos": float64[H], …}
            if named is None:
                raise SystemExit("the server names no actions: start it with --robot so101_follower")
            executor.warm_up(observe())
            tick = time.monotonic()
            for _ in range(options.steps):
                if executor.wants_observation:  # the images of other steps wouldn't be used
                    executor.observe(observe())
                command = executor.next_action()  # never waits for the policy; the log says why there is no action
                if command.action is not None:
                    sent = robot.send_action(dict(zip(named, map(float, command.action), strict=True)))
                tick += 1 / HZ
                time.sleep(max(0.0, tick - time.monotonic()))
    except TurboPiError as error:  # before the first action: keys of another robot, a policy that is too slow
        raise SystemExit(str(error)) from error
    finally:
        robot.disconnect()
    print(f"commands {executor.report()['commands']}; the arm is at", {key: round(at, 2) for key, at in sent.items()})


if __name__ == "__main__":
    main()
