"""One target's kernels, compiled: Triton's by `triton.compile` for a GPU that isn't here, CUDA C++ by NVRTC."""

import contextlib
import importlib
import importlib.metadata
import io
import os
import pkgutil
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import machine_code
import triton
from triton.backends.compiler import GPUTarget
from triton.compiler import ASTSource
from triton.runtime.errors import PTXASError
from triton.runtime.jit import JITFunction

from compile_for_all.allowed import allowed
from compile_for_all.calls import SMOLVLA_PLACES, all_calls
from compile_for_all.cubin import used
from compile_for_all.document import Compiled
from compile_for_all.launches import Launch, launches
from compile_for_all.targets import MULTIPROCESSORS, Target, over_limit
from turbopi.config import preset
from turbopi.engine import smolvla
from turbopi.kernels import portable
from turbopi.kernels.portable.denoise import kernel as denoise
from turbopi.kernels.portable.denoise.packing import PI05, Expert, Form, WeightNumbers
from turbopi.kernels.portable.gemm.tiles import fp8_refusal, int8_refusal
from turbopi.kernels.sm90.vjp import products as vjp
from turbopi.models.smolvla.config import SmolVLAConfig
from turbopi.models.smolvla.family import BASE
from turbopi.support.errors import BackendError
from turbopi.support.toolchain import PTXAS_BLACKWELL_VARIABLE, cuda_13_ptxas

HOPPER, THOR = (9, 0), (11, 0)
INSTRUCTIONS = {"nvfp4.product": "kind::mxf4nvf4.block_scale.scale_vec::4X"}  # of tcgen05.mma and mma.sync


def compile_target(target: Target, only: str = "", chosen: bool = False) -> list[Compiled]:
    """A row for each kernel and variant; `only`: of kernels with this in their name."""
    with patch.dict(os.environ, ptxas_of(target)):
        return _compile_target(target, only, chosen)


def ptxas_of(target: Target) -> dict[str, str]:
    """What names the ptxas for a target that Triton's own doesn't know, as `turbopi doctor` says; nothing for others,
    or where one is named already, or that one isn't installed.
    """
    newer = cuda_13_ptxas()
    if target.capability != THOR or PTXAS_BLACKWELL_VARIABLE in os.environ or not newer.is_file():
        return {}
    return {PTXAS_BLACKWELL_VARIABLE: str(newer)}


def _compile_target(target: Target, only: str, chosen: bool) -> list[Compiled]:
    found = [one for one in launches(target, all_calls(target, chosen)) if only in one.name]
    rows = [compiled_launch(target, launch) for launch in found]
    for name, make in cuda_kernels(target):
        if only in name:
            rows.append(compiled_cuda(target, name, make))
    if (why := fp8_refusal(target.capability)) is not None and only in "gemm.kernel.product":
        rows.append(Compiled("gemm.kernel.product, FP8", "", target.arch, refused=why))
    return rows


def compiled_launch(target: Target, launch: Launch) -> Compiled:
    """As `triton.compile` leaves it. A compiler that doesn't know the target is a problem, not a crash."""
    at = {name: (i,) for i, name in enumerate(launch.kernel.arg_names)}
    source = ASTSource(
        launch.kernel,
        dict(launch.signature),
        {at[name]: value for name, value in launch.constants},
        {at[name]: [["tt.divisibility", 16]] for name in launch.divisible},
    )
    row = partial(Compiled, launch.name, launch.variant, target.arch)
    try:
        with contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():  # Triton prints what failed
            warnings.simplefilter("ignore")
            code = triton.compile(source, GPUTarget("cuda", target.number, 32), dict(launch.options))
    except PTXASError as e:
        if f"'{target.arch}' is not defined" in str(e):
            ptxas = versions()["ptxas from 10.0 on" if target.number >= 100 else "ptxas"]
            return row(
                refused=f"Triton's ptxas {ptxas} doesn't know it; pip install --no-deps 'nvidia-cuda-nvcc>=13,<14'"
            )
        return row(problem=next((line for line in str(e).splitlines() if "fatal" in line or "error" in line), str(e)))
    except (triton.CompilationError, RuntimeError, ValueError) as e:
        return row(problem=str(e).strip().splitlines()[-1])
    registers, spilled, _ = used(code.asm["cubin"])
    shared = int(code.metadata.shared)
    problem = over_limit(target, registers, shared, launch.threads) or over_allowed(launch.name, target, spilled)
    problem = problem or without_instruction(launch.name, code.asm["ptx"])
    return row(registers=registers, spilled=spilled, shared=shared, problem=problem)


def without_instruction(kernel: str, ptx: str) -> str | None:
    """That Triton has put something else in place of the tensor cores' instruction, in words."""
    wanted = INSTRUCTIONS.get(kernel, "")
    return None if wanted in ptx else f"its PTX has no {wanted}"


def over_allowed(kernel: str, target: Target, spilled: int) -> str | None:
    """What a kernel spills too much, in words."""
    may = allowed(kernel, target.number)
    if spilled <= may:
        return None
    return f"a thread spills {spilled} bytes" + (f", {may} are allowed" if may else "")


def compiled_cuda(target: Target, name: str, make: Callable[[Path | None], bytes]) -> Compiled:
    try:
        registers, spilled, shared = used(make(None))
    except BackendError as e:
        return Compiled(name, "", target.arch, problem=str(e).splitlines()[0])
    return Compiled(name, "", target.arch, registers, spilled, shared, over_allowed(name, target, spilled))


def cuda_kernels(target: Target) -> Iterator[tuple[str, Callable[[Path | None], bytes]]]:
    """(name, what compiles it): Hopper's for 9.0, the portable denoising loop of 10 and 50 actions, SmolVLA's."""
    if target.capability == HOPPER:
        yield from ((f"sm90: {name}", make) for name, make in (machine_code.SHAPES | hopper_backward()).items())
    for suffix in (10, 50):
        refusals: dict[WeightNumbers, Any] = {"bf16": None, "fp8": fp8_refusal, "int8": int8_refusal}
        for weights in [one for one, refusal in refusals.items() if not (refusal and refusal(target.capability))]:
            label = weights if weights == "bf16" else weights.upper()
            yield f"denoise.kernel, H={suffix}, {label}", partial(_denoising, target, suffix, weights)
    yield "SmolVLA's denoise.kernel, H=50, bf16", partial(_smolvla_denoising, target, "bf16")
    if int8_refusal(target.capability) is None:
        yield "SmolVLA's denoise.kernel, H=50, INT8", partial(_smolvla_denoising, target, "int8")


def hopper_backward() -> dict[str, Callable[[Path | None], bytes]]:
    """What the true Jacobian's way back has of its own on Hopper, for 10 actions and for 50.

    Products of more tokens than vjp.MOST_TOKENS are Triton's, which are compiled for every target.
    """
    expert = preset("pi05_libero").planned_model.expert
    made: dict[str, Callable[[Path | None], bytes]] = {}
    heads = expert.num_heads * expert.head_dim
    for tokens in (10, 50):
        keeping = partial(machine_code._denoising, tokens, False, True, keep=True)
        made[f"denoising of a step that is kept, H={tokens}, bf16"] = keeping
        shapes: dict[vjp.Mode, tuple[int, int]] = {
            "geglu": (expert.width, expert.mlp_dim),
            "parts": (2 * expert.mlp_dim, expert.width),
            "plain": (expert.width, heads),
        }
        for mode, shape in shapes.items():
            one = vjp.cut(mode, tokens, *shape)
            assert (one is None) == (tokens > vjp.MOST_TOKENS), (mode, tokens)
            if one is not None:
                made[f"way back, {mode}, H={tokens}"] = partial(vjp.compiled, one, mode)
    return made


def _denoising(target: Target, suffix: int, weights: WeightNumbers, folder: Path | None) -> bytes:
    expert = preset("pi05_libero").planned_model
    return _loop(target, expert, PI05, machine_code.CACHE_ROWS, suffix, weights, folder)


def _smolvla_denoising(target: Target, weights: WeightNumbers, folder: Path | None) -> bytes:
    config = BASE.model
    assert isinstance(config, SmolVLAConfig)
    return _loop(target, smolvla.ExpertSizes.of(config), smolvla.form(config), SMOLVLA_PLACES, 50, weights, folder)


def _loop(
    target: Target,
    expert: Expert,
    form: Form,
    cache_rows: int,
    suffix: int,
    weights: WeightNumbers,
    folder: Path | None,
) -> bytes:
    sizes = denoise.kernel_sizes(
        expert,
        blocks=MULTIPROCESSORS[target.capability],
        cache_rows=cache_rows,
        suffix=suffix,
        weights=weights,
        choice=denoise.choices(suffix, form, MULTIPROCESSORS[target.capability]),
        form=form,
    )
    assert target.shared >= denoise.SHARED_BYTES, target
    return denoise.compiled(denoise.native_arch(target.capability), sizes, folder=folder)


def portable_modules() -> list[Any]:
    """Every module below kernels/portable."""
    prefix = f"{portable.__name__}."
    return [importlib.import_module(one.name) for one in pkgutil.walk_packages(portable.__path__, prefix)]


def triton_kernels() -> set[str]:
    """Names of all kernels below kernels/portable, as `Launch.name` has them."""
    return {
        Launch(one, (), (), (), ()).name
        for module in portable_modules()
        for one in vars(module).values()
        if isinstance(one, JITFunction) and one.__name__.endswith(("_kernel",)) and one.__module__ == module.__name__
    }


def versions() -> dict[str, str]:
    """The compilers'."""
    nvidia = triton.knobs.nvidia
    with patch.dict(os.environ, ptxas_of(Target(THOR))):
        of_thor = nvidia.ptxas_blackwell.version
    return {
        "triton": importlib.metadata.version("triton"),
        "ptxas": nvidia.ptxas.version,
        "ptxas from 10.0 on": nvidia.ptxas_blackwell.version,
        "ptxas of 11.0": of_thor,
        "nvrtc": machine_code.compiler() or "none",
    }
