"""What examples/ros2 calls of rclpy: one node at a time, whose callbacks a test calls."""

from typing import Any

PARAMETERS: dict[str, Any] = {}  # as of a --params-file


def init() -> None: ...


def spin(node: Any) -> None: ...
