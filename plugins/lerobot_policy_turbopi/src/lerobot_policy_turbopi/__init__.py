"""`--policy.type=turbopi` for LeRobot: its Pi0.5 and Pi0 checkpoints, run by Turbo-Pi.

LeRobot imports this package at the start of its commands, which registers the type. The policy and its processors are
imported by LeRobot when they are used, by the names that it expects of their files.
"""

from lerobot_policy_turbopi.configuration_turbopi import TurboPiConfig

__all__ = ["TurboPiConfig"]
