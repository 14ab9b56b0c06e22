"""From what a robot saw to FP8: record → calibrate → verify → serve.

    python examples/fp8_from_recordings.py                     # the small policy that ships with Turbo-Pi, its images
    python examples/fp8_from_recordings.py --backend fused     # on an H100 or H200, which have FP8

FP8 needs scales that are measured on real observations. `emulated_fp8` computes its roundings on any machine, slowly.
For your own checkpoint the steps are these commands:

    turbopi serve CHECKPOINT --record recordings               # let the robot work for a while
    turbopi calibrate CHECKPOINT --observations recordings --out fp8.json
    turbopi verify CHECKPOINT --observations recordings --backend fused --precision fp8 --quantization fp8.json
    turbopi serve CHECKPOINT --precision fp8 --quantization fp8.json
"""

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from websockets.sync.client import connect

from turbopi import UnifiedPolicy, serve
from turbopi.policy.shipped import SMALL_POLICY, load_frames, observations
from turbopi.realtime.wire import pack, unpack


def ask(url: str, seen: list[dict[str, object]]) -> Any:
    """Send observations to a server, as a robot does; the last answer."""
    with connect(url, max_size=None, proxy=None) as client:
        client.recv()  # the policy's metadata
        for observation in seen:
            client.send(pack(observation))
            answer: Any = client.recv()
            if isinstance(answer, str):
                raise SystemExit(answer)
    return unpack(answer)


def turbopi(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "turbopi", *map(str, arguments)], check=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--backend", default="emulated_fp8")
    parser.add_argument("--folder", type=Path, default=Path("fp8_example"), help="of the recording and the calibration")
    parser.add_argument("--frames", type=int, default=8)
    options = parser.parse_args()
    recordings, fp8 = options.folder / "recordings", options.folder / "fp8.json"
    options.folder.mkdir(parents=True, exist_ok=True)

    policy = UnifiedPolicy(SMALL_POLICY)
    frames = observations(policy, load_frames()[: options.frames])
    with serve.running(policy, record_dir=recordings) as server:  # 1. record
        ask(server.url, frames)

    turbopi("calibrate", SMALL_POLICY, "--observations", recordings, "--out", fp8)  # 2. calibrate

    judged = ("--backend", options.backend, "--precision", "fp8", "--quantization", fp8)  # 3. verify
    turbopi("verify", SMALL_POLICY, "--observations", recordings, "--count", "2", "--noises", "1", *judged)

    policy = UnifiedPolicy(SMALL_POLICY, backend=options.backend, precision="fp8", quantization=fp8)  # 4. serve
    with serve.running(policy) as server:
        answer = ask(server.url, frames[:1])
    print(f"{options.backend} in FP8 answers with actions {list(answer['actions'].shape)}")


if __name__ == "__main__":
    main()
