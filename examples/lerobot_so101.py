"""An SO-101 of LeRobot's that asks a Turbo-Pi server, with the keys that LeRobot's robot has.

    turbopi serve CHECKPOINT --robot so101_follower &                       # a LeRobot checkpoint (pi05 or pi0)
    python examples/lerobot_so101.py --arm /dev/ttyACM0 --camera front=0 --task "put the cube into the box"

Without an arm and a checkpoint, to try it:

    turbopi serve --random-weights pi05_tiny --robot examples/so101.json &  # openpi's checkpoints need such a file
    python examples/lerobot_so101.py

It runs in LeRobot's environment, with Turbo-Pi beside it for its messages (openpi's client wants an older NumPy). With
the GPU in the same machine no server is needed: docs/lerobot.md.
"""

import argparse
import time
from typing import Any

import numpy as np
from websockets.sync.client import ClientConnection, connect

from turbopi.realtime.wire import pack, unpack

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
HZ = 30
EXECUTED = 8  # actions of a chunk, before the next one is asked for


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


def connected(server: str, patience_s: float) -> ClientConnection:
    """A server takes connections once it is warm: some seconds to a minute after its start."""
    end = time.monotonic() + patience_s
    while True:
        try:
            return connect(server, max_size=None, compression=None, proxy=None)
        except ConnectionRefusedError:
            if time.monotonic() > end:
                raise SystemExit(f"no server answers at {server}; start one with: turbopi serve CHECKPOINT") from None
            time.sleep(1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--server", default="ws://localhost:8000")
    parser.add_argument("--arm", metavar="PORT", help="of the motors' bus; without it a fake arm moves")
    parser.add_argument("--camera", action="append", default=[], metavar="NAME=INDEX")
    parser.add_argument("--task", default="put the cube into the box")
    parser.add_argument("--chunks", type=int, default=10)
    parser.add_argument(
        "--patience", type=float, default=120, metavar="S", help="seconds that the server may take to start"
    )
    options = parser.parse_args()
    cameras = {name: int(index) for name, _, index in (camera.partition("=") for camera in options.camera)}
    robot = so101(options.arm, cameras) if options.arm else FakeSO101()
    robot.connect()
    try:
        with connected(options.server, options.patience) as server:
            server.recv()  # the policy's metadata
            for _ in range(options.chunks):
                server.send(pack({**robot.get_observation(), "task": options.task}))
                answer: Any = server.recv()
                if isinstance(answer, str):  # why there are no actions
                    raise SystemExit(answer)
                chunk = unpack(answer)["named_actions"]  # {"shoulder_pan.pos": float64[H], …}
                for step in range(min(EXECUTED, len(chunk["gripper.pos"]))):
                    robot.send_action({key: float(values[step]) for key, values in chunk.items()})
                    time.sleep(1 / HZ)
            print("the arm is at", {key: round(float(values[step]), 2) for key, values in chunk.items()})
    finally:
        robot.disconnect()


if __name__ == "__main__":
    main()
