"""Turbo-Pi from Python: load, warm up, infer, and what else a call can be asked for.

python examples/python_api.py [CHECKPOINT]     # without one: the small policy that ships with Turbo-Pi
"""

import sys

import numpy as np

from turbopi import ObservationError, UnifiedPolicy
from turbopi.policy.shipped import SMALL_POLICY


def main() -> None:
    policy = UnifiedPolicy(sys.argv[1] if len(sys.argv) > 1 else SMALL_POLICY, precision="bf16")
    about = policy.metadata
    print(f"{about['config']} for {about['robot']}: {about['backend']} ({about['backend_reason']})")
    print(f"warm after {policy.warmup():.1f} s")  # later calls compile and capture nothing

    observation = policy.example_observation()  # random, in the robot's own keys; here goes what your robot sees
    answer = policy.infer(observation)
    print("actions", answer["actions"].shape, {key: round(ms, 1) for key, ms in answer["policy_timing"].items()})

    # The same noise gives the same actions; so does the same seed.
    first, second = (policy.infer(observation, seed=7)["actions"] for _ in range(2))
    assert np.array_equal(first, second)

    # Fewer denoising steps are faster. How much they change is a question of the policy: measure it.
    five = policy.infer(observation, seed=7, num_steps=5)["actions"]
    print("five steps instead of ten move the actions by at most", np.abs(five - first).max().round(4))

    # Several observations in one run of the model.
    both = policy.infer_batch([observation, policy.example_observation(seed=1)], seed=7)
    print("a batch of", len(both), "chunks")

    # Whatever is wrong with an observation, the error names it.
    try:
        policy.infer({})
    except ObservationError as error:
        print("refused:", error)


if __name__ == "__main__":
    main()
