"""rcl_interfaces.msg, as far as examples/ros2 needs it."""

from dataclasses import dataclass


@dataclass
class ParameterDescriptor:
    dynamic_typing: bool = False
