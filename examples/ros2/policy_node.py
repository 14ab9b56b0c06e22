"""A ROS 2 node between a robot and `turbopi serve`: images and joint states in, a joint trajectory out.

    turbopi serve CHECKPOINT --robot my_arm.json &
    python examples/ros2/policy_node.py --ros-args --params-file examples/ros2/my_arm.yaml

It needs a sourced ROS 2 (Humble or newer) and, in the same Python, what docs/real_time.md names for a robot's computer.
In every control step `RealTimeExecutor` gives a command: an action goes out as a JointTrajectory of one point, one step
ahead. When there is none (the server was killed, hangs, is late; an image is old) nothing goes out, and the trajectory
controller holds the last point. docs/ros2.md says the rest. Before the arm has power, read docs/safety.md.
"""

import contextlib
import time
from typing import Any

import numpy as np
import rclpy
from builtin_interfaces.msg import Duration
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, JointState
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from turbopi.realtime import RealTimeClient, RealTimeExecutor
from turbopi.support.errors import TurboPiError

CHANNELS = {  # of sensor_msgs/Image: bytes of a pixel, and which of them are red, green, blue
    "rgb8": (3, [0, 1, 2]),
    "bgr8": (3, [2, 1, 0]),
    "rgba8": (4, [0, 1, 2]),
    "bgra8": (4, [2, 1, 0]),
    "mono8": (1, [0, 0, 0]),
}


def rgb(image: Image) -> np.ndarray:
    """uint8[h, w, 3], RGB whatever the encoding. Raises ValueError for an image without 8 bits a channel, or torn."""
    if image.encoding not in CHANNELS:
        raise ValueError(f"its encoding is {image.encoding!r}; expected one of {', '.join(CHANNELS)}")
    size, order = CHANNELS[image.encoding]
    data = np.frombuffer(image.data, np.uint8)
    if len(data) != image.height * image.step or image.step < image.width * size:
        raise ValueError(f"{len(data)} bytes for {image.width} x {image.height} pixels in rows of {image.step} bytes")
    rows = data.reshape(image.height, image.step)[:, : image.width * size]  # rows may be padded
    return np.ascontiguousarray(rows.reshape(image.height, image.width, size)[..., order])


class PolicyNode(Node):  # type: ignore[misc]
    """Parameters are in my_arm.yaml, each with its meaning."""

    def __init__(self) -> None:
        super().__init__("turbopi_policy")
        self.prompt = str(self._parameter("prompt", "fold the towel"))
        self.state = pairs(self._parameter("state", ["observation/state=joint_1"]))
        self.action_joints = list(self._parameter("action_joints", ["joint_1"]))
        self.max_age = self._positive("max_age", 1.0)
        self.step = 1 / self._positive("control_hz", 30.0)
        self.server = str(self._parameter("server", "ws://localhost:8000"))
        self.execution: Any = self._parameter("execution", "async")
        jump = float(self._parameter("max_jump", 0.0))
        self.max_jump = jump or None
        self.cameras = {key: names[0] for key, names in pairs(self._parameter("cameras", ["image=/image_raw"])).items()}
        self.images: dict[str, tuple[Image, float]] = {}  # key -> the newest, and when it was taken
        self.positions: dict[str, tuple[float, float]] = {}  # joint -> its position, and when it was measured
        self.chunks: RealTimeExecutor | None = None
        self.kind = self.complaint = ""
        self.error: BaseException | None = None  # of the policy, which is over
        for key, topic in self.cameras.items():
            self.create_subscription(
                Image, topic, lambda image, key=key: self._take_image(key, image), qos_profile_sensor_data
            )
        self.joint_states = str(self._parameter("joint_states", "/joint_states"))
        self.create_subscription(JointState, self.joint_states, self._take_joints, qos_profile_sensor_data)
        self.trajectory = self.create_publisher(
            JointTrajectory, str(self._parameter("trajectory", "/arm_controller/joint_trajectory")), 1
        )
        self.create_timer(self.step, self.control_step)
        self.create_timer(1.0, self.connect)

    def _parameter(self, name: str, default: Any) -> Any:
        """Of any type: 20 is a rate as 20.0 is."""
        return self.declare_parameter(name, default, ParameterDescriptor(dynamic_typing=True)).value

    def _positive(self, name: str, default: float) -> float:
        value = float(self._parameter(name, default))
        if not 0 < value < float("inf"):
            raise ValueError(f"the parameter {name} is {value}; expected a number above 0")
        return value

    def connect(self) -> None:
        """Until the server is there for the first time; afterwards the client connects again by itself."""
        if self.chunks is not None:
            return
        client = None
        try:
            client = RealTimeClient(self.server, connect_s=self.max_age, answer_s=self.max_age)
            self.chunks = RealTimeExecutor(
                client,
                control_hz=1 / self.step,
                execution=self.execution,
                max_observation_age_s=self.max_age,
                max_jump=self.max_jump,
            )  # without hold_action: the trajectory controller holds the last point
        except TurboPiError as error:
            if client is not None:
                client.close()  # it is tried again every second, and the server lets so many clients in
            self._complain(str(error))

    def _take_image(self, key: str, image: Image) -> None:
        self.images[key] = image, self._taken_at(image.header.stamp)

    def _take_joints(self, joints: JointState) -> None:
        taken = self._taken_at(joints.header.stamp)
        self.positions.update((name, (at, taken)) for name, at in zip(joints.name, joints.position, strict=False))

    def _taken_at(self, stamp: Any) -> float:
        """A message's moment on the executor's clock; of one without a stamp: now."""
        taken = stamp.sec * 10**9 + stamp.nanosec
        age = 1e-9 * (self.get_clock().now().nanoseconds - taken) if taken else 0.0
        return time.monotonic() - max(0.0, age)

    def observation(self) -> tuple[dict[str, Any], float] | None:
        """The newest images and joints under the policy's keys, and when the oldest was taken.

        None until all have come, for a wrong image, and while one is too old.
        """
        missing = [self.cameras[key] for key in self.cameras if key not in self.images]
        missing += [] if self.positions else [self.joint_states]
        if missing:
            self._complain(f"nothing has come yet from {', '.join(missing)}")
            return None
        needed = [name for names in self.state.values() for name in names]
        if unknown := [name for name in (*needed, *self.action_joints) if name not in self.positions]:
            named, there = ", ".join(dict.fromkeys(unknown)), ", ".join(self.positions)
            self._complain(f"{self.joint_states} has no {named}; it has {there}. Look at state and action_joints")
            return None
        taken = {self.cameras[key]: at for key, (_, at) in self.images.items()}
        taken |= {name: self.positions[name][1] for name in needed}
        source, oldest = min(taken.items(), key=lambda one: one[1])
        if time.monotonic() - oldest > self.max_age:
            self._complain(f"what came last from {source} is older than max_age, {self.max_age:g} s: nothing goes out")
            return None
        state = {key: np.array([self.positions[name][0] for name in names]) for key, names in self.state.items()}
        pixels = {}
        for key, (image, _) in self.images.items():
            try:
                pixels[key] = rgb(image)
            except ValueError as error:
                self._complain(f"the image of {self.cameras[key]}: {error}")
                return None
        return {**pixels, **state, "prompt": self.prompt}, oldest

    def control_step(self) -> None:
        """One command: a point of a trajectory, or nothing."""
        executor = self.chunks
        if executor is None:
            return
        try:
            if executor.wants_observation and (seen := self.observation()) is not None:
                executor.observe(*seen)
            command = executor.next_action()
        except TurboPiError as error:  # this policy can't be run in this way
            self._complain(str(error))
            return
        if command.kind != self.kind:
            self.kind = command.kind
            if self.kind == "fresh":
                self.complaint, self.error = "", executor.last_error  # the same complaint later is news, not the error
            self.get_logger().info(f"commands are {command.kind}")
        if command.kind != "fresh" and executor.last_error is not self.error:
            self._complain(str(executor.last_error))
        if command.action is not None:
            if len(command.action) != len(self.action_joints):
                self._complain(f"an action has {len(command.action)} numbers, action_joints {len(self.action_joints)}")
                return
            ahead = Duration(sec=int(self.step), nanosec=int(1e9 * (self.step % 1)))
            point = JointTrajectoryPoint(positions=command.action.tolist(), time_from_start=ahead)
            self.trajectory.publish(JointTrajectory(joint_names=self.action_joints, points=[point]))

    def _complain(self, text: str) -> None:
        """Into the log, once for as long as it is the same."""
        if text != self.complaint:
            self.complaint = text
            self.get_logger().warning(text)


def pairs(texts: list[str]) -> dict[str, list[str]]:
    """["key=a,b"] as {"key": ["a", "b"]}."""
    return {key: names.split(",") for key, _, names in (text.partition("=") for text in texts)}


def main() -> None:
    rclpy.init()
    node = PolicyNode()
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        rclpy.spin(node)
    node.destroy_node()


if __name__ == "__main__":
    main()
