"""NVFP4 in one product, right and wrong; and what weights of fewer bits would save, by arithmetic."""

from collections.abc import Sequence

import torch
from msgspec import Struct
from torch import Tensor

from turbopi.bench.work import Job, stage_work
from turbopi.config import preset
from turbopi.models.pi0.reference import Pi0Model
from turbopi.models.pi0.sites import linears
from turbopi.quantization.fp8 import E4M3_MAX
from turbopi.quantization.nvfp4 import round_e2m1, round_nvfp4
from turbopi.quantization.sites import sites
from turbopi_lab.studies.formats import nvfp4_with_swizzled_scales, nvfp4_without_scales, round_mxfp4
from turbopi_lab.studies.report import Cell, Grid

# Bytes a weight: NVFP4 has a byte of scale for 16 numbers, MXFP4 for 32; FP8 has a scale a channel, which is nothing
BYTES = {"bf16": 2.0, "FP8": 1.0, "NVFP4": 0.5 + 1 / 16, "MXFP4": 0.5 + 1 / 32}
# Vendors' memory bandwidth, TB/s, and what their tensor cores multiply
GPUS = {
    "Jetson AGX Thor (11.0)": (0.273, "NVFP4, MXFP4 × MXFP8"),
    "RTX 5090 (12.0)": (1.79, "NVFP4, MXFP4 × MXFP8"),
    "H100 SXM (9.0)": (3.35, "FP8; four bits only unpacked"),
    "H200 (9.0)": (4.8, "FP8; four bits only unpacked"),
    "B200 (10.0)": (8.0, "NVFP4, MXFP4 × MXFP8"),
}


class ProductCosine(Struct, frozen=True):
    """Of products of random inputs with a model's matrices: cosine with the exact ones, the median and the worst."""

    how: str
    median: float
    worst: float


def scales_overflow(x: Tensor) -> Tensor:
    """NVFP4 without the tensor's float32 scale: block scales as E4M3 holds them alone, so that small ones vanish."""
    blocks = x.float().view(*x.shape[:-1], -1, 16)
    scale = (blocks.abs().amax(-1, keepdim=True) / 6).clamp(max=E4M3_MAX).to(torch.float8_e4m3fn).float()
    return (round_e2m1(torch.where(scale > 0, blocks / scale.clamp(min=1e-30), 0.0)) * scale).flatten(-2).to(x.dtype)


UNREAD = "scales ignored where the product reads"
UNSCALED = "no scale at all: numbers rounded to E2M1 as they are"
HOW = {
    "NVFP4, right": round_nvfp4,
    "MXFP4, right": round_mxfp4,
    UNREAD: nvfp4_without_scales,
    "scales read in another order (128 × 4 tiles)": nvfp4_with_swizzled_scales,
    "no scale of the tensor: block scales in E4M3 alone": scales_overflow,
    UNSCALED: round_e2m1,
}


def matrices(model: Pi0Model, most: int = 24) -> list[Tensor]:
    """Those of the model's sites whose inputs fit blocks of 32, from the first to the last, at most so many."""
    found = [linear.weight for site in sites(model.config) for linear in linears(model, site)]
    found = [weight for weight in found if weight.shape[1] % 32 == 0]
    return [weight.float() for weight in found[:: -(-len(found) // most)]]


def normal_matrices(count: int = 4) -> list[Tensor]:
    """Normal numbers with deviation 0.02, as many weights are; E2M1's smallest number but 0 is 0.5."""
    generator = torch.Generator().manual_seed(1)
    return [0.02 * torch.randn(512, 512, generator=generator) for _ in range(count)]


def product_cosines(weights: Sequence[Tensor]) -> list[ProductCosine]:
    generator = torch.Generator().manual_seed(0)
    inputs = [torch.randn(64, weight.shape[1], generator=generator).to(weight.device) for weight in weights]
    found = []
    for how, rounding in HOW.items():
        cosines = torch.tensor([_cosine(x @ rounding(w).T, x @ w.T) for x, w in zip(inputs, weights, strict=True)])
        found.append(ProductCosine(how, float(cosines.median()), float(cosines.min())))
    return found


def _cosine(ours: Tensor, exact: Tensor) -> float:
    """0 for zeros: they point nowhere."""
    size = ours.norm() * exact.norm()
    return float((ours * exact).sum() / size) if size > 0 else 0.0


def savings() -> Grid:
    """Least time to read the weights of a call of pi05_libero, ten steps, by GPU and format. Arithmetic."""
    config, job = preset("pi05_libero").planned_model, Job()
    read = {name: stage_work(config, job, 1)[name].bytes for name in ("vision", "prefix", "denoise")}
    rows: list[list[Cell]] = []
    for gpu, (bandwidth, multiplies) in GPUS.items():
        times: list[Cell] = [round(sum(read.values()) * size / bandwidth / 1e9, 2) for size in BYTES.values()]
        rows.append([gpu, bandwidth, *times, multiplies])
    sizes = ", ".join(f"{name} {sum(read.values()) * size / 1e9:.2f} GB" for name, size in BYTES.items())
    note = (
        f"Arithmetic, not measured: bytes over the vendor's bandwidth, the expert's weights ten times ({sizes} a "
        "call). Keys and values are counted in the same format."
    )
    return Grid("Least time to read a call's weights, ms", ["GPU", "TB/s", *BYTES, "tensor cores multiply"], rows, note)
