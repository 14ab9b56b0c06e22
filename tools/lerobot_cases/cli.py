"""LeRobot's own commands, with the small tokenizer and the hardware that isn't there of lerobot_cases.fake:

    python -m lerobot_cases.cli rollout --robot.type=fake_arm --policy.type=turbopi --policy.checkpoint=… --duration=2
    python -m lerobot_cases.cli eval --env.type=fake --policy.type=turbopi --policy.checkpoint=…

What runs is the command's own `main`, which finds the plugin as it finds every plugin: by the installed package's name.
"""

import importlib
import sys

import lerobot_cases.fake  # noqa: F401 - registers the types
from lerobot_cases.small import shrink


def main() -> None:
    shrink()
    command = sys.argv.pop(1)
    sys.argv[0] = f"lerobot-{command}"
    importlib.import_module(f"lerobot.scripts.lerobot_{command}").main()


if __name__ == "__main__":
    main()
