"""Small Pi0 and Pi0.5 checkpoints of LeRobot, and what its own pipelines and model compute with them on a CPU.

Runs in an environment that has LeRobot (scripts/lerobot_env makes one), and doesn't import Turbo-Pi. From the root:

    PYTHONPATH=tools .venv-lerobot/bin/python -m lerobot_cases FOLDER [CASE ...]

The cases are in cases.py. Each one leaves

    FOLDER/CASE/checkpoint/   as LeRobot's save_pretrained left it, without model.safetensors
    FOLDER/CASE/case.json     what was called, with which versions
    FOLDER/CASE/inputs.npz    {observation}/{key}, noise [H, action_dim]
    FOLDER/CASE/expected.npz  {run}/tokens, token_mask, normalized_state, images (every eighth row and column),
                              image_mask, keys and values (of every sixteenth token), v_1 (the first velocity),
                              normalized_actions, actions; and selected_actions, one by one from select_action
    FOLDER/weights/HASH.safetensors.xz   shared by the cases that name it ("weights", or "base_weights" for an adapter)

A case with an adapter has the base model's files, without its weights, in base/.
"""

import argparse
import sys
from pathlib import Path

from lerobot_cases.cases import CASES
from lerobot_cases.record import record


def main() -> int:
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_cases", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("cases", nargs="*", metavar="CASE", help=f"all of {', '.join(CASES)} unless given")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.cases if name not in CASES]
    if unknown:
        parser.error(f"unknown: {', '.join(unknown)}; the cases are {', '.join(CASES)}")
    for name in arguments.cases or CASES:
        record(arguments.folder.absolute() / name, CASES[name])
        print(name, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
