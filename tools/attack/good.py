"""The good client: asks all the time, as a robot does, and checks every answer. A process of its own.

    python -m attack.good 8000 --out latencies.txt

Each request becomes two lines, when it is asked and when it is answered: the time it was asked (seconds of the
monotonic clock), milliseconds, and "?", then "ok" or what was wrong. It goes on until it is killed.
"""

import argparse
import time
from pathlib import Path

import numpy as np

from attack.fake import NAME
from attack.judging import decode, judge, shape_fault
from attack.websocket import Blocking, HandshakeRefused
from turbopi.realtime.wire import pack

PAUSE_S = 0.005  # what a robot does between its calls
RETRY_S = 0.1


def observation(number: int, camera_image: np.ndarray) -> dict[str, object]:
    """LIBERO's keys, and a prompt that makes each observation another."""
    return {
        "observation/image": camera_image,
        "observation/wrist_image": camera_image[::-1],
        "observation/state": np.linspace(-0.5, 0.5, 8),
        "prompt": f"pick up the bowl {number}",
    }


def ask(client: Blocking, number: int, camera_image: np.ndarray, digests: bool) -> tuple[float, str]:
    """Milliseconds, and "ok" or what was wrong. Raises OSError."""
    message = pack(observation(number, camera_image))
    started = time.monotonic()
    client.send(message)
    reply = client.receive()
    milliseconds = (time.monotonic() - started) * 1e3
    if digests or reply.kind != "binary":
        judged = judge(message, reply, valid=True)
        return milliseconds, judged.fault or ("ok" if judged.outcome == "result" else judged.outcome)
    return milliseconds, shape_fault(reply.data) or "ok"


def run(port: int, out: Path, pixels: int, headers: list[str]) -> None:
    camera_image = np.random.default_rng(0).integers(0, 256, (pixels, pixels, 3), np.uint8)
    client: Blocking | None = None
    digests, number = False, 0
    with out.open("a", buffering=1, encoding="utf-8") as lines:
        while True:
            requested = time.monotonic()
            lines.write(f"{requested:.4f}\t0\t?\n")
            try:
                if client is None:
                    client = Blocking(port, *headers)
                    digests = decode(client.greeting).get("policy") == NAME
                milliseconds, said = ask(client, number, camera_image, digests)
                if said.startswith("closed"):
                    client.close()
                    client = None
            except (OSError, HandshakeRefused) as error:
                milliseconds, said = (time.monotonic() - requested) * 1e3, f"lost: {type(error).__name__} {error}"
                if client is not None:
                    client.close()
                client = None
            lines.write(f"{requested:.4f}\t{milliseconds:.3f}\t{' '.join(said.split())}\n")
            number += 1
            time.sleep(PAUSE_S if client is not None else RETRY_S)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m attack.good", description=__doc__)
    parser.add_argument("port", type=int)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pixels", type=int, default=224, help="of its two images")
    parser.add_argument("--header", action="append", default=[])
    arguments = parser.parse_args()
    run(arguments.port, arguments.out, arguments.pixels, arguments.header)


if __name__ == "__main__":
    main()
