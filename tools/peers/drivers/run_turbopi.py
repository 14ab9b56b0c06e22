"""Turbo-Pi: `UnifiedPolicy.infer`, from images, state and prompt on the host to actions on the host."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import torch
from peers.drivers.rounds import Built, serve

from turbopi.bench.measure import Observations, bench_policy
from turbopi.bench.work import Job
from turbopi.checkpoint import open_checkpoint, random_checkpoint
from turbopi.policy.shipped import SMALL_POLICY

PRESET = "pi05_libero"
STAGES = ("vision_ms", "prefix_ms", "denoise_ms")


def build(job: dict[str, Any]) -> Built:
    gpu, fp8 = job["device"] == "cuda", job["setting"] == "fp8"
    quantization = str(Path(job["shared"]) / "quantization.json") if fp8 else None
    if quantization and not Path(quantization).exists():  # once in a run: it is the same for each job
        calibrate = ("calibrate", "--random-weights", PRESET, "--count", "8", "--out", quantization)
        subprocess.run([sys.executable, "-m", "turbopi", *calibrate], check=True)
    checkpoint = open_checkpoint(SMALL_POLICY) if job["small"] else random_checkpoint(PRESET)
    shape = Job(job["cameras"], job["prompt_tokens"], job["horizon"], job["steps"])
    policy = bench_policy(
        checkpoint,
        "fused" if gpu else "pytorch",
        job["setting"],
        torch.device("cuda:0" if gpu else "cpu"),
        shape,
        quantization=quantization,
    )
    observations = Observations(policy, shape)

    def whole() -> tuple[float, Any]:
        answer = policy.infer(next(observations), num_steps=shape.steps)
        return answer["policy_timing"]["total_ms"], answer["actions"]

    def device() -> tuple[float, Any]:
        answer = policy.infer(next(observations), num_steps=shape.steps)
        return sum(answer["policy_timing"][stage] for stage in STAGES), answer["actions"]

    note = "a whole call tokenises, resizes and copies; on the GPU: the stages' sum"
    return Built({"whole call": whole, "on the GPU": device}, note, ("turbopi", "torch", "triton"))


if __name__ == "__main__":
    serve(build)
