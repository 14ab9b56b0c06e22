"""CPU time of what judges a call (policy/readings.py, policy/watch.py), in microseconds.

PYTHONPATH=src:tools python -m watch_cost

Two cameras of 224 x 224 whose images move, eight values of state, a chunk of ten actions; nothing to note. Printed are
the least and the median of 100 runs of 64 calls, in the thread's own CPU time, as other programs may run beside.
"""

import statistics
import time

import numpy as np

from turbopi import open_checkpoint
from turbopi.policy.readings import Checks
from turbopi.policy.shipped import SMALL_POLICY, load_frames
from turbopi.policy.watch import Watch
from turbopi.preprocess.pipeline import Pipeline

CALLS, RUNS = 64, 100


def main() -> None:
    checkpoint, no_tokenizer, frame = open_checkpoint(SMALL_POLICY), None, load_frames()[0]
    pipeline = Pipeline(checkpoint.config, checkpoint.norm_stats, no_tokenizer, "go")  # type: ignore[arg-type]
    checks, watch = Checks(pipeline, checkpoint.norm_stats), Watch()
    chunk = np.zeros((1, 10, checkpoint.config.model.action_dim), np.float32)
    seen = [
        pipeline.see(
            {
                "observation/image": np.roll(frame.base, call, 1)[:224, :224].copy(),
                "observation/wrist_image": np.roll(frame.wrist, call, 1)[:224, :224].copy(),
                "observation/state": frame.state,
            },
            resize=False,
        )
        for call in (*range(CALLS // 2), *range(CALLS // 2, 0, -1))
    ]
    took = []
    for _ in range(RUNS):
        began = time.thread_time()
        for one in seen:
            _, (reading,) = checks.judge(chunk, [checks.reading(one)])
            assert reading is not None and not watch.notes(reading)
        took.append((time.thread_time() - began) / CALLS * 1e6)
    print(f"{min(took):.1f} us a call at least, median {statistics.median(took):.1f}")


if __name__ == "__main__":
    main()
