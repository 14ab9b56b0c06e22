"""Prints the keys of LeRobot's robots as JSON, {type: [keys of numbers in observations, keys of actions]}.

Nothing is connected, but LeRobot wants the motors' libraries installed (its extras feetech and dynamixel).
"""

import json

from lerobot.robots.bi_so_follower import BiSOFollower, BiSOFollowerConfig
from lerobot.robots.koch_follower import KochFollower, KochFollowerConfig
from lerobot.robots.lekiwi import LeKiwi, LeKiwiConfig
from lerobot.robots.omx_follower import OmxFollower, OmxFollowerConfig
from lerobot.robots.so_follower import SO100Follower, SO101Follower, SO101FollowerConfig
from lerobot.robots.so_follower.config_so_follower import SOFollowerConfig


def main() -> None:
    port, arm = "/dev/null", SO101FollowerConfig(port="/dev/null")
    side = SOFollowerConfig(port=port)
    robots = {
        "so100_follower": SO100Follower(arm),
        "so101_follower": SO101Follower(arm),
        "koch_follower": KochFollower(KochFollowerConfig(port=port)),
        "omx_follower": OmxFollower(OmxFollowerConfig(port=port)),
        "bi_so_follower": BiSOFollower(BiSOFollowerConfig(left_arm_config=side, right_arm_config=side)),
        "lekiwi": LeKiwi(LeKiwiConfig(port=port, cameras={})),
    }
    keys = {name: [list(robot.observation_features), list(robot.action_features)] for name, robot in robots.items()}
    print(json.dumps(keys))


if __name__ == "__main__":
    main()
