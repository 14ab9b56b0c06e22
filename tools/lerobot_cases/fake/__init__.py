"""Hardware that isn't there, for LeRobot's own commands. LeRobot looks for a config's robot in its file's package."""

from lerobot_cases.fake.hardware import FakeArm

__all__ = ["FakeArm"]
