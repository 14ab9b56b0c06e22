"""FlashRT's Pi0.5 for RTX GPUs, built for this one: `Pi05TorchFrontendRtx.infer`.

It supports no Hopper officially and loads its weights from a checkpoint, so its class is given random weights in the
layout that its converter writes; FP8 weights are in the layout `nk`.
"""

import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from peers.drivers.rounds import Built, clocked, random_images, serve

VISION, GEMMA, EXPERT = (27, 1152, 4304), (18, 2048, 16_384), (18, 1024, 4096)  # layers, width, mlp_dim
QKV, HEADS = 2560, 2048
VOCABULARY = 257_152


def weights() -> dict[str, torch.Tensor]:
    """Random ones by the converter's names; a norm's scales are 1, biases 0."""
    (vl, vd, vh), (gl, gd, gh), (el, ed, eh) = VISION, GEMMA, EXPERT
    matrices = {
        "vision_patch_embedding_w": (14, 14, 3, vd),
        "vision_position_embedding": (256, vd),
        "vision_attn_qkv_w": (vl, vd, 3 * vd),
        "vision_attn_o_w": (vl, vd, vd),
        "vision_ffn_up_w": (vl, vd, vh),
        "vision_ffn_down_w": (vl, vh, vd),
        "encoder_multi_modal_projector_w": (vd, gd),
        "encoder_attn_qkv_w": (gl, gd, QKV),
        "encoder_attn_o_w": (gl, HEADS, gd),
        "encoder_ffn_gate_w": (gl, gd, gh),
        "encoder_ffn_up_w": (gl, gd, gh),
        "encoder_ffn_down_w": (gl, gh, gd),
        "decoder_attn_qkv_w": (el, ed, QKV),
        "decoder_attn_o_w": (el, HEADS, ed),
        "decoder_ffn_gate_w": (el, ed, eh),
        "decoder_ffn_up_w": (el, ed, eh),
        "decoder_ffn_down_w": (el, eh, ed),
        "decoder_pre_attn_norm_mod_w": (el, ed, 3 * ed),
        "decoder_pre_ffn_norm_mod_w": (el, ed, 3 * ed),
        "decoder_final_norm_mod_w": (ed, 3 * ed),
        "decoder_time_mlp_in_w": (ed, ed),
        "decoder_time_mlp_out_w": (ed, ed),
        "decoder_time_embeds": (10, ed),
        "decoder_action_in_proj_w": (32, ed),
        "decoder_action_out_proj_w": (ed, 32),
        "embedding_weight": (VOCABULARY, gd),
    }
    biases = {
        "vision_patch_embedding_b": (vd,),
        "vision_attn_qkv_b": (vl, 3 * vd),
        "vision_attn_o_b": (vl, vd),
        "vision_ffn_up_b": (vl, vh),
        "vision_ffn_down_b": (vl, vd),
        "vision_pre_attn_norm_b": (vl, vd),
        "vision_pre_ffn_norm_b": (vl, vd),
        "vision_final_norm_b": (vd,),
        "encoder_multi_modal_projector_b": (gd,),
        "decoder_pre_attn_norm_mod_b": (el, 3 * ed),
        "decoder_pre_ffn_norm_mod_b": (el, 3 * ed),
        "decoder_final_norm_mod_b": (3 * ed,),
        "decoder_time_mlp_in_b": (ed,),
        "decoder_time_mlp_out_b": (ed,),
        "decoder_action_in_proj_b": (ed,),
        "decoder_action_out_proj_b": (32,),
    }
    scales = {
        "vision_pre_attn_norm_w": (vl, vd),
        "vision_pre_ffn_norm_w": (vl, vd),
        "vision_final_norm_w": (vd,),
    }
    made: Any = {"dtype": torch.bfloat16, "device": "cuda"}
    found = {name: torch.empty(shape, **made).normal_(std=shape[-2] ** -0.5) for name, shape in matrices.items()}
    found |= {name: torch.zeros(shape, **made) for name, shape in biases.items()}
    return found | {name: torch.ones(shape, **made) for name, shape in scales.items()}


@contextmanager
def torchs_cuda_runtime() -> Iterator[None]:
    """FlashRT opens "libcudart.so", which PyTorch's wheels don't have by that name: it gets the one that is loaded."""
    load, name = ctypes.CDLL, f"libcudart.so.{(torch.version.cuda or '').partition('.')[0]}"

    def opened(wanted: str, *arguments: Any, **options: Any) -> ctypes.CDLL:
        return load(name if wanted == "libcudart.so" else wanted, *arguments, **options)

    ctypes.CDLL = opened  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        ctypes.CDLL = load  # type: ignore[misc]


def build(job: dict[str, Any]) -> Built:
    precision, _, autotune = job["setting"].partition(" nt_autotune=")
    if autotune:
        os.environ["FLASHRT_FP8_NT_AUTOTUNE"] = autotune
    os.environ["FVK_PI05_RTX_FORCE_BF16"] = "1" if precision == "bf16" else "0"
    sys.path.insert(0, job["src"])
    with torchs_cuda_runtime():
        from flash_rt.frontends.torch import pi05_rtx

    torch.manual_seed(0)

    class RandomWeights(pi05_rtx.Pi05TorchFrontendRtx):
        def _load_norm_stats(self, checkpoint_dir: Path) -> None:
            self.norm_stats: dict[str, Any] = {}

    pi05_rtx.convert_pi05_safetensors = lambda path: weights()
    pi05_rtx.unnormalize_actions = lambda actions, stats: actions
    pi05_rtx.LIBERO_ACTION_DIM = 32
    tokens = torch.randint(1, VOCABULARY, (job["prompt_tokens"],), device="cuda")

    def embedded(prompt: str, table: torch.Tensor, **_: Any) -> tuple[torch.Tensor, int]:
        return table[tokens] * table.shape[1] ** 0.5, len(tokens)

    pi05_rtx._embed_prompt = embedded
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "model.safetensors").touch()  # it only looks whether there is one
        model = RandomWeights(
            folder,
            num_views=job["cameras"],
            chunk_size=job["horizon"],
            num_steps=job["steps"],
            use_fp8=precision == "fp8",
            fp8_layout="nk",
        )
    model.set_prompt("")
    images = random_images(job)
    model.calibrate([{"images": images()}])
    stream = ctypes.c_void_p(model._graph_torch_stream.cuda_stream)

    def whole() -> Any:
        return model.infer({"images": images()})["actions"]

    def replay() -> Any:
        model.pipeline.forward()
        model._cudart.cudaStreamSynchronize(stream)

    def last_actions(_: Any) -> Any:
        return model._noise_out.float().cpu()

    parts = {"whole call": clocked(whole), "on the GPU": clocked(replay, last_actions)}
    note = (
        f"the prompt's {len(tokens)} embeddings are on the GPU; on the GPU: its graph; without tokenising and resizing"
    )
    return Built(parts, note, ("torch",), {"FlashRT": job["commit"]})


if __name__ == "__main__":
    serve(build)
