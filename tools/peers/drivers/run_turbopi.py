"""Turbo-Pi: `UnifiedPolicy.infer`, from images, state and prompt on the host to actions on the host."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import torch
from peers.drivers.rounds import Built, serve

from turbopi.bench.measure import Observations, bench_policy
from turbopi.bench.work import Job
from turbopi.checkpoint import Checkpoint, open_checkpoint, random_checkpoint
from turbopi.config import GemmaConfig, VisionConfig
from turbopi.models.smolvla.config import SIGLIP, TextConfig
from turbopi.policy.shipped import SMALL_POLICY

MODELS = {  # preset and backend
    "pi05": ("pi05_libero", "fused"),
    "smolvla": ("smolvla_base", "fused"),
    "pi0_fast": ("pi0_fast_base", "cuda_graph"),
}
SMALL: dict[str, dict[str, Any]] = {  # of the model: few layers and words
    "smolvla": {"vision": replace(SIGLIP, depth=1), "text": TextConfig(vocab_size=1024, depth=2), "expert_depth": 2},
    "pi0_fast": {"vision": VisionConfig(depth=1), "vlm": GemmaConfig(2048, 2048, depth=1), "vocab_size": 1024},
}
STAGES = ("vision_ms", "prefix_ms", "denoise_ms")


def checkpoint_of(model: str, small: bool) -> Checkpoint:
    if small and model == "pi05":
        return open_checkpoint(SMALL_POLICY)
    full = random_checkpoint(MODELS[model][0])
    return random_checkpoint(full.config.with_model(**SMALL[model])) if small else full


def build(job: dict[str, Any]) -> Built:
    gpu, fp8 = job["device"] == "cuda", job["setting"] == "fp8"
    quantization = str(Path(job["shared"]) / "quantization.json") if fp8 else None
    if quantization and not Path(quantization).exists():  # once in a run: it is the same for each job
        calibrate = ("calibrate", "--random-weights", MODELS["pi05"][0], "--count", "8", "--out", quantization)
        subprocess.run([sys.executable, "-m", "turbopi", *calibrate], check=True)
    checkpoint = checkpoint_of(job["model"], job["small"])
    shape = msgspec.convert({name: job[name] for name in Job.__struct_fields__ if name in job}, Job)
    policy = bench_policy(
        checkpoint,
        MODELS[job["model"]][1] if gpu else "pytorch",
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
