"""realtime-vla's Pi0.5 in Triton: `Pi05Inference`, one CUDA graph. Its prompt is given as embeddings."""

import sys
from typing import Any

import torch
from peers.drivers.rounds import Built, clocked, random_images, serve

GEMMA_WIDTH = 2048
STEPS = 10  # fixed in its code


def build(job: dict[str, Any]) -> Built:
    if job["steps"] != STEPS:
        raise ValueError(f"realtime-vla always takes {STEPS} steps, not {job['steps']}")
    sys.path.insert(0, f"{job['src']}/server")
    from pi05_infer import Pi05Inference

    torch.manual_seed(0)
    embeds = torch.randn(job["prompt_tokens"], GEMMA_WIDTH, dtype=torch.bfloat16, device="cuda")
    # Its constructor takes its weights from memory that nothing was written to: they are drawn into it instead.
    empty = torch.empty

    def drawn(*shape: Any, **options: Any) -> torch.Tensor:
        found = empty(*shape, **options)
        if found.is_floating_point():
            found.detach().normal_(std=0.02)  # what it compiles makes some, too, which may require gradients
        return found

    torch.empty = drawn
    model = Pi05Inference({"language_embeds": embeds}, job["cameras"], job["horizon"], discrete_state_input=False)
    torch.empty = empty
    images = random_images(job)

    def seen() -> torch.Tensor:
        return torch.stack([torch.from_numpy(image) for image in images()]).to("cuda").to(torch.bfloat16) / 127.5 - 1

    def noise() -> torch.Tensor:
        return torch.randn(job["horizon"], 32, dtype=torch.bfloat16, device="cuda")

    def whole() -> Any:
        return model.forward(seen(), noise()).float().cpu()

    ready = seen(), noise()

    def on_the_gpu() -> Any:
        actions = model.forward(*ready)
        torch.cuda.synchronize()
        return actions

    parts = {"whole call": clocked(whole), "on the GPU": clocked(on_the_gpu, lambda actions: actions.float().cpu())}
    note = f"the prompt's {job['prompt_tokens']} embeddings are on the GPU; without tokenising and resizing"
    return Built(parts, note, ("torch", "triton"), {"realtime-vla-v2": job["commit"]})


if __name__ == "__main__":
    serve(build)
