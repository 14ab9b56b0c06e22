"""rclpy.node, as far as examples/ros2 needs it."""

import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

from rcl_interfaces.msg import ParameterDescriptor

import rclpy


class Node:
    def __init__(self, name: str) -> None:
        self.subscriptions_by_topic: dict[str, Callable[[Any], None]] = {}
        self.published: list[Any] = []
        self.logged: list[str] = []

    def declare_parameter(self, name: str, default: Any, descriptor: ParameterDescriptor) -> Any:
        value = rclpy.PARAMETERS.get(name, default)
        same = type(value) is type(default)
        assert same or descriptor.dynamic_typing, f"{name}: rclpy refuses a value of another type"
        return SimpleNamespace(value=value)

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], qos: Any) -> None:
        self.subscriptions_by_topic[topic] = callback

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        def publish(message: Any) -> None:
            assert type(message) is kind
            self.published.append(message)

        return SimpleNamespace(publish=publish)

    def create_timer(self, seconds: float, callback: Callable[[], None]) -> None: ...

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=time.time_ns()))

    def get_logger(self) -> Any:
        return SimpleNamespace(info=self.logged.append, warning=self.logged.append)

    def destroy_node(self) -> None: ...
