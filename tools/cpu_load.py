"""What other programs on the CPU do to a call, with and without OMP_WAIT_POLICY=PASSIVE, which `import turbopi` sets.

    PYTHONPATH=src python tools/cpu_load.py --out FILE [--loads 0,2,10] [--calls 8] [--seconds 20] [--commands 3]

The small policy (bf16, 10 steps, CPU) is called in a process of its own beside so many that only compute. Without the
setting: that process imports torch before turbopi, which leaves OpenMP as it is. The command: `turbopi infer`.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from turbopi.robots import create_robot
from turbopi.support.provenance import provenance
from turbopi.support.reading import plain_document

POLICY = Path(__file__).parents[1] / "src" / "turbopi" / "data" / "small_policy"
CALLS = """
import json, sys, time
{imports}
policy = turbopi.UnifiedPolicy({policy!r}, device="cpu", backend="pytorch")
observation = policy.example_observation()
policy.infer(observation, seed=0)
began, found = time.perf_counter(), []
while len(found) < {calls} and (len(found) < 3 or time.perf_counter() - began < {seconds}):
    found.append(policy.infer(observation, seed=0)["policy_timing"]["total_ms"])
print(json.dumps(found))
"""


@contextmanager
def busy(count: int) -> Iterator[None]:
    """So many processes that compute and never wait."""
    others = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for one in others:
            one.kill()
            one.wait()


def environment() -> dict[str, str]:
    return {name: value for name, value in os.environ.items() if not name.startswith(("OMP_", "MKL_", "KMP_"))}


def python_calls(imports: str, calls: int, seconds: float) -> list[float]:
    """Milliseconds of each call."""
    code = CALLS.format(imports=imports, policy=str(POLICY), calls=calls, seconds=seconds)
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    return [round(one, 1) for one in json.loads(done.stdout.splitlines()[-1])]


def command_calls(observation: Path, calls: int) -> list[float]:
    """The same of `turbopi infer`, one call a process, after its warm-up."""
    words = [sys.executable, "-m", "turbopi", "infer", str(POLICY), str(observation), "--device", "cpu", "--no-plot"]
    words += ["--json", "--out", str(observation.with_name("actions.npz"))]
    found = []
    for _ in range(calls):
        done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment())
        found.append(round(json.loads(done.stdout)["policy_timing"][0]["total_ms"], 1))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--loads", default="0,2,10")
    parser.add_argument("--calls", type=int, default=8)
    parser.add_argument("--commands", type=int, default=3, help="calls of `turbopi infer`")
    parser.add_argument("--seconds", type=float, default=20, help="of a way, though not before three calls")
    given = parser.parse_args()
    import torch

    about, found = plain_document(provenance(torch.device("cpu"))), []
    with tempfile.TemporaryDirectory() as folder:
        observation = Path(folder) / "observation.npz"
        example = create_robot("libero").example(np.random.default_rng(0))
        np.savez(observation, **{key: np.asarray(value) for key, value in example.items()})  # type: ignore[arg-type]
        for load in map(int, given.loads.split(",")):
            ways: dict[str, Callable[[], list[float]]] = {
                "import turbopi": lambda: python_calls("import turbopi", given.calls, given.seconds),
                "import torch, turbopi": lambda: python_calls("import torch, turbopi", given.calls, given.seconds),
                "turbopi infer": lambda: command_calls(observation, given.commands),
            }
            for way, measure in ways.items():
                before = os.getloadavg()[0]
                with busy(load):
                    times = measure()
                row = {"busy_processes": load, "way": way, "load_average_before": round(before, 2)}
                row |= {"minimum_ms": min(times), "median_ms": statistics.median(times), "calls_ms": times}
                found.append(row)
                print(json.dumps(row), flush=True)
                document = {
                    "command": ["python", *sys.argv],
                    "provenance": about,
                    "passive": ["import turbopi", "turbopi infer"],
                    "results": found,
                }
                given.out.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
