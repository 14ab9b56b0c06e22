"""examples/ros2 against a stand-in of rclpy: its messages reach the policy as it expects, and trajectories come out."""

import importlib.util
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from serve_fakes import wait_for

from turbopi.serve import running

ROOT = Path(__file__).parents[1]
STAND_IN = ROOT / "tests" / "rclpy_stand_in"
PATIENCE = 60.0
JOINTS = [f"joint_{number}" for number in range(1, 8)]
RED = np.full((2, 3, 3), (200, 100, 0), np.uint8)


class Policy:
    """Answers with a chunk of zeros; `open` lets it. `seen` is the last observation."""

    def __init__(self) -> None:
        self.metadata: dict[str, Any] = {"robot": "my_arm"}
        self.seen: dict[str, Any] = {}
        self.open = threading.Event()
        self.open.set()

    def infer(self, obs: dict[str, Any]) -> dict[str, Any]:
        assert self.open.wait(PATIENCE)
        self.seen = dict(obs)
        return {"actions": np.tile(np.arange(7.0), (10, 1))}


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(STAND_IN))
    described = importlib.util.spec_from_file_location("policy_node", ROOT / "examples" / "ros2" / "policy_node.py")
    assert described is not None and described.loader is not None
    module = importlib.util.module_from_spec(described)
    described.loader.exec_module(module)
    return module


def parameters() -> dict[str, Any]:
    """Those of my_arm.yaml, without a YAML reader: one `key: value` or `- item` a line."""
    found: dict[str, Any] = {}
    key = ""
    for line in (ROOT / "examples" / "ros2" / "my_arm.yaml").read_text(encoding="utf-8").splitlines()[2:]:
        text = line.split(" #")[0].strip()
        if text.startswith("- "):
            found[key] = [*(found[key] or []), text[2:]]
            continue
        key, _, value = text.partition(":")
        value = value.strip()
        if value.startswith("["):
            found[key] = value.strip("[]").split(", ")
        else:
            found[key] = float(value) if value.replace(".", "").isdigit() else value
    return found


def image(example: ModuleType, encoding: str, pixels: np.ndarray, padding: int = 0, taken: float = 0.0) -> Any:
    """sensor_msgs/Image of RGB pixels."""
    size, order = example.CHANNELS[encoding]
    stored = np.zeros((*pixels.shape[:2], size), np.uint8)
    for channel, place in enumerate(order):
        stored[..., place] = pixels[..., channel]
    rows = stored.reshape(len(pixels), -1)
    step = rows.shape[1] + padding
    message = example.Image(*pixels.shape[:2], encoding, step, np.pad(rows, ((0, 0), (0, padding))).tobytes())
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(int(1e9 * taken), 10**9)
    return message


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_every_encoding_is_rgb_in_the_end(example: ModuleType, encoding: str, padding: int) -> None:
    np.testing.assert_array_equal(example.rgb(image(example, encoding, RED, padding)), RED)


def test_grey_images_have_three_channels(example: ModuleType) -> None:
    grey = np.full((2, 3, 3), 7, np.uint8)
    np.testing.assert_array_equal(example.rgb(image(example, "mono8", grey)), grey)


def test_images_that_are_no_colours_or_torn_are_refused(example: ModuleType) -> None:
    depth = example.Image(2, 3, "16UC1", 6, bytes(12))
    with pytest.raises(ValueError, match="its encoding is '16UC1'; expected one of rgb8, bgr8"):
        example.rgb(depth)
    with pytest.raises(ValueError, match="17 bytes for 3 x 2 pixels in rows of 9 bytes"):
        example.rgb(example.Image(2, 3, "rgb8", 9, bytes(17)))


class Robot:
    """The node with its topics."""

    def __init__(self, example: ModuleType, monkeypatch: pytest.MonkeyPatch, port: int, **changed: Any) -> None:
        import rclpy

        chosen = parameters() | {"server": f"ws://127.0.0.1:{port}", "max_age": 30.0} | changed
        monkeypatch.setattr(rclpy, "PARAMETERS", chosen)
        self.example = example
        self.node: Any = example.PolicyNode()
        self.node.connect()

    def send(self, topic: str, message: Any) -> None:
        self.node.subscriptions_by_topic[topic](message)

    def see(self, encoding: str = "bgr8", taken: float = 0.0) -> None:
        for topic in ("/front/image_raw", "/wrist/image_raw"):
            self.send(topic, image(self.example, encoding, RED, taken=taken))
        self.send("/joint_states", self.example.JointState(["gripper", *reversed(JOINTS)], [0.5, *range(7, 0, -1)]))

    def run_until(self, done: Callable[[], bool]) -> None:
        """With new images in each step: where one takes long, as on a busy machine, those from before are refused."""
        end = time.monotonic() + PATIENCE
        while not done():
            assert time.monotonic() < end, self.node.logged
            self.see()
            self.node.control_step()
            time.sleep(0.005)


def test_a_robot_gets_a_trajectory_and_the_policy_rgb_and_joints_in_its_order(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = Policy()
    with running(policy) as server:
        robot = Robot(example, monkeypatch, server.port, max_jump=0.0)
        node = robot.node
        node.control_step()
        assert node.logged[0] == "nothing has come yet from /front/image_raw, /wrist/image_raw, /joint_states"
        robot.run_until(lambda: len(node.published) >= 3)
        node.chunks.close()
    np.testing.assert_array_equal(policy.seen["front_camera"], RED)
    np.testing.assert_array_equal(policy.seen["joint_position"], np.arange(1.0, 8.0))
    assert policy.seen["gripper_position"] == [0.5] and policy.seen["prompt"] == "fold the towel"
    for trajectory in node.published:
        assert trajectory.joint_names == JOINTS
        (point,) = trajectory.points
        assert point.positions == list(np.arange(7.0))
        assert point.time_from_start.nanosec == int(1e9 / 30)


def test_without_a_server_nothing_goes_out_and_it_goes_on_with_the_next(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = Policy()
    with running(policy) as server:
        port = server.port
        robot = Robot(example, monkeypatch, port)
        robot.run_until(lambda: len(robot.node.published) > 0)
    robot.run_until(lambda: "commands are held" in robot.node.logged)
    robot.run_until(lambda: any("no policy server" in line or "went away" in line for line in robot.node.logged))
    before = len(robot.node.published)
    robot.node.control_step()
    assert len(robot.node.published) == before, "a held command is none"
    with running(policy, port=port):
        robot.run_until(lambda: len(robot.node.published) > before)
        robot.node.chunks.close()


def test_old_images_move_nothing(example: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    policy = Policy()
    with running(policy) as server:
        robot = Robot(example, monkeypatch, server.port)
        robot.see(taken=time.time() - 60)
        for _ in range(50):
            robot.node.control_step()
        robot.node.chunks.close()
    assert not robot.node.published and not policy.seen
    (said,) = (line for line in robot.node.logged if "older" in line)
    assert re.fullmatch(
        r"what came last from /(front|wrist)/image_raw is older than max_age, 30 s: nothing goes out", said
    )


def test_one_joint_that_no_longer_comes_is_named_and_moves_nothing(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(Policy()) as server:
        robot = Robot(example, monkeypatch, server.port, max_age=0.2)
        robot.see()
        time.sleep(0.3)
        for topic in ("/front/image_raw", "/wrist/image_raw"):
            robot.send(topic, image(example, "rgb8", RED))
        robot.send("/joint_states", example.JointState(["gripper", *JOINTS[:-1]], [0.5, *range(1, 7)]))
        robot.node.control_step()
        robot.node.chunks.close()
    assert not robot.node.published
    assert "what came last from joint_7 is older than max_age, 0.2 s: nothing goes out" in robot.node.logged


@pytest.mark.parametrize("where", ["state", "action_joints"])
def test_a_misspelt_joint_is_named_and_moves_nothing(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, where: str
) -> None:
    right = parameters()[where]
    wrong = [one.replace("joint_2", "jiont_2") for one in right]
    policy = Policy()
    with running(policy) as server:
        robot = Robot(example, monkeypatch, server.port, **{where: wrong})
        robot.see()
        for _ in range(5):
            robot.node.control_step()
        robot.node.chunks.close()
    assert not robot.node.published and not policy.seen
    (said,) = (line for line in robot.node.logged if "jiont_2" in line)
    assert said.startswith("/joint_states has no jiont_2; it has gripper, joint_7") and "action_joints" in said


@pytest.mark.parametrize("name", ["control_hz", "max_age"])
def test_a_rate_or_an_age_of_nothing_is_refused_by_name_and_whole_numbers_do(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    with pytest.raises(ValueError, match=rf"the parameter {name} is 0\.0; expected a number above 0"):
        Robot(example, monkeypatch, 1, **{name: 0})
    assert Robot(example, monkeypatch, 1, control_hz=20, max_age=1, max_jump=0).node.step == 0.05


def test_an_image_of_another_kind_is_named_once(example: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Policy()) as server:
        robot = Robot(example, monkeypatch, server.port)
        robot.see()
        robot.send("/wrist/image_raw", example.Image(2, 3, "16UC1", 6, bytes(12)))
        for _ in range(3):
            robot.node.control_step()
        robot.node.chunks.close()
    said = [line for line in robot.node.logged if "16UC1" in line]
    assert len(said) == 1 and said[0].startswith("the image of /wrist/image_raw: its encoding is '16UC1'")


def test_a_way_to_run_that_the_policy_lacks_is_named_and_leaves_no_connection(
    example: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    with running(Policy()) as server:
        robot = Robot(example, monkeypatch, server.port, execution="rtc")
        for _ in range(3):  # every second
            robot.node.connect()
        assert (
            len(robot.node.logged) == 1 and "execution 'rtc' needs a policy that joins chunks" in robot.node.logged[0]
        )
        wait_for(lambda: "turbopi_clients 0.0" in server.metrics.text())


def test_a_node_waits_for_its_server(example: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    with running(Policy()) as server:
        port = server.port
    robot = Robot(example, monkeypatch, port)
    robot.node.control_step()
    assert not robot.node.published and "no policy server at" in robot.node.logged[0]
    with running(Policy(), port=port):
        robot.node.connect()
        robot.run_until(lambda: len(robot.node.published) > 0)
        robot.node.chunks.close()
