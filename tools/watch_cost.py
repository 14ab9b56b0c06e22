"""CPU time of what judges a call (policy/readings.py, policy/watch.py), in microseconds.

PYTHONPATH=src:tools python -m watch_cost

Two cameras of 224 x 224 whose images move, eight values of state, a chunk of ten actions; nothing to note. Printed are
the least and the median of 100 runs of 64 calls, in the thread's own CPU time, as other programs may run beside; then
that of one comparison with known images (policy/known_cameras.py), which one call in sixteen makes.
"""

import statistics
import time
from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

from turbopi import open_checkpoint
from turbopi.policy.known_cameras import KnownCameras
from turbopi.policy.readings import Checks
from turbopi.policy.shipped import SMALL_POLICY, load_frames
from turbopi.policy.watch import Watch
from turbopi.preprocess.pipeline import Incoming, Pipeline

CALLS, RUNS = 64, 100
One = TypeVar("One")


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

    def judged(one: Incoming) -> None:
        _, (reading,) = checks.judge(chunk, [checks.reading(one)])
        assert reading is not None and not watch.notes(reading)

    print(f"a call: {measured(judged, seen)}")
    images = [reading.images for one in seen if (reading := checks.reading(one)) is not None]
    known = KnownCameras.of_samples({name: [one[name] for one in images] for name in images[0]})
    assert known is not None
    print(f"a comparison with known images: {measured(known.notes, images)}")


def measured(call: Callable[[One], object], given: Sequence[One]) -> str:
    took = []
    for _ in range(RUNS):
        began = time.thread_time()
        for one in given:
            call(one)
        took.append((time.thread_time() - began) / CALLS * 1e6)
    return f"{min(took):.1f} us at least, median {statistics.median(took):.1f}"


if __name__ == "__main__":
    main()
