"""`turbopi serve` with its policy replaced: everything else is the command as users have it.

    python -m attack.fake --milliseconds 20 -- --port 0 --queue-limit 16

The policy takes a fixed time without using the CPU, as a GPU would, and answers with the digest of the observation.
"""

import argparse
import sys
import time
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np

from attack.judging import digest_actions

NAME = "attack-fake"


class DigestPolicy:
    """actions float64 [4, 8]: the digest of the observation that arrived (judging.digest_actions).

    An observation with the integer `attack_reply_bytes` is answered with as many bytes more: a big answer.
    """

    pipelined = False

    def __init__(self, milliseconds: float) -> None:
        self.metadata: dict[str, Any] = {"policy": NAME, "milliseconds": milliseconds}
        self._seconds = milliseconds / 1e3

    def infer(self, obs: dict[str, Any], /) -> dict[str, Any]:
        started = time.perf_counter()
        actions = digest_actions(obs)
        extra = obs.get("attack_reply_bytes")
        more = {"extra": np.zeros(extra, np.uint8)} if type(extra) is int and 0 < extra <= 2**26 else {}
        time.sleep(max(self._seconds - (time.perf_counter() - started), 0.0))
        return {"actions": actions, **more, "policy_timing": {"infer_ms": (time.perf_counter() - started) * 1e3}}


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m attack.fake", description=__doc__)
    parser.add_argument("--milliseconds", type=float, default=20.0)
    parser.add_argument("serve", nargs="*", help="options of `turbopi serve`, behind --")
    arguments = parser.parse_args()
    policy = DigestPolicy(arguments.milliseconds)

    from turbopi.cli import main as turbopi
    from turbopi.cli.options import PolicyOptions, WeightOptions

    sys.argv = ["turbopi", "serve", "--random-weights", "pi05_tiny", *arguments.serve]
    with (
        mock.patch.object(WeightOptions, "open", return_value=SimpleNamespace(format="fake", stored_bytes=0)),
        mock.patch.object(WeightOptions, "tell_if_random"),
        mock.patch.object(PolicyOptions, "make_policy", return_value=policy),
    ):
        turbopi()


if __name__ == "__main__":
    main()
