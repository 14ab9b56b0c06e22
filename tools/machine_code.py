"""The CUDA kernels' machine code for shapes that the GPU tests run, as hashes: part of the GPU result's fingerprint.

Needs NVRTC, which needs no GPU. Another version of it makes other code of the same source: then nothing is compared.
"""

import hashlib
import importlib.metadata
import struct
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from turbopi.config import preset
from turbopi.kernels import nvrtc
from turbopi.kernels.sm90.attention import kernel as attention
from turbopi.kernels.sm90.attention import suffix
from turbopi.kernels.sm90.attention.suffix_tile import FewTile, SuffixTile
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise.packing import Arrangement
from turbopi.kernels.sm90.gemm import bf16, fp8
from turbopi.kernels.sm90.gemm.bf16 import Epilogue, Tile
from turbopi.kernels.sm90.instructions import SHARED_BYTES
from turbopi.kernels.sm90.norms import layer_norm
from turbopi.support.errors import BackendError

ARCH = "sm_90a"
CACHE_ROWS = 976  # of `fused` with three cameras and prompts of up to 200 tokens
ROWS_OF_TWO = 1440  # of two observations with two cameras each
# Sections of a cubin that say what runs, and with how many registers, constants and barriers.
SECTIONS = (".text.", ".nv.constant", ".nv.info.", ".nv.shared.")


def _denoising(
    suffix: int,
    in_fp8: bool,
    by_token: bool,
    folder: Path | None,
    *,
    rows: int = CACHE_ROWS,
    pair: bool = False,
    keep: bool = False,
) -> bytes:
    arrangement = Arrangement(preset("pi05_libero").planned_model)
    sizes = denoise.kernel_sizes(
        arrangement,
        cache_rows=rows,
        suffix=suffix,
        shared_bytes=SHARED_BYTES,
        fp8=in_fp8,
        by_token=by_token,
        pair=pair,
        keep=keep,
    )
    return denoise.compiled(ARCH, sizes, folder=folder)


def _product(tile: Tile, epilogue: Epilogue, residual: bool, folder: Path | None) -> bytes:
    takes = bf16.parameters(fp8=False, residual=residual, normed=False, copied=False)
    source = bf16.source(tile.columns, takes, fp8=False)
    return nvrtc.compile_cubin(source, ARCH, bf16.constants(tile, epilogue, residual), folder=folder)


def _product_fp8(
    tile: Tile, epilogue: Epilogue, inner: int, copied: int, out_fp8: bool, folder: Path | None, *, int8: bool = False
) -> bytes:
    takes = bf16.parameters(fp8=True, residual=copied > 0, normed=False, copied=copied > 0, marks=int8)
    promote = 0 if int8 else fp8.promotion(tile, inner)
    sizes = fp8.constants(tile, epilogue, out_fp8, promote, copied > 0, 0, copied, whole=int8, marks=int8)
    return nvrtc.compile_cubin(bf16.source(tile.columns, takes, fp8=True, whole=int8), ARCH, sizes, folder=folder)


def _attention(
    tile: attention.AttentionTile, whole: bool, folder: Path | None, *, packed: bool = False, in_int8: bool = False
) -> bytes:
    sizes = attention.constants(tile, in_int8, whole, packed, in_int8)
    return nvrtc.compile_cubin(attention.source(tile, in_int8), ARCH, sizes, folder=folder)


def _layer_norm(has_y: bool, in_fp8: bool, folder: Path | None) -> bytes:
    sizes = layer_norm.constants(preset("pi05_libero").planned_model.vision.width, has_y, in_fp8)
    return nvrtc.compile_cubin(layer_norm.source(in_fp8), ARCH, sizes, folder=folder)


def _suffixes(tile: SuffixTile | FewTile, in_fp8: bool, folder: Path | None) -> bytes:
    return nvrtc.compile_cubin(suffix.source(tile), ARCH, suffix.constants(tile, in_fp8), folder=folder)


SHAPES: dict[str, Callable[[Path | None], bytes]] = {
    **{
        f"denoising{' by token' if by_token else ''}, H={suffix}, {'fp8' if in_fp8 else 'bf16'}": partial(
            _denoising, suffix, in_fp8, by_token
        )
        for by_token in (False, True)
        for suffix in (10, 50)
        for in_fp8 in (False, True)
    },
    **{
        f"denoising of two observations, H=10, {'fp8' if in_fp8 else 'bf16'}": partial(
            _denoising, 20, in_fp8, False, rows=ROWS_OF_TWO, pair=True
        )
        for in_fp8 in (False, True)
    },
    "product of vision's qkv, bf16": partial(_product, Tile(1, 112, cluster_m=2), "bias", False),
    "product gathered beside the residual, bf16": partial(
        _product, Tile(2, 144, cluster_m=2, cluster_n=2, splits=2, gather=True), "bias", True
    ),
    "prefix's GeGLU, bf16": partial(_product, Tile(3, 128, 1, 2, overlap=True), "geglu", False),
    "prefix's GeGLU, fp8": partial(_product_fp8, Tile(3, 128, cluster_n=2, overlap=True), "geglu", 2048, 0, True),
    "prefix's GeGLU, int8": partial(_product_fp8, Tile(2, 256, cluster_n=2), "geglu", 2048, 0, True, int8=True),
    "prefix's attention, int8": partial(_attention, attention.AttentionTile(256, 64), False, in_int8=True),
    "vision's qkv in batches, bf16": partial(_product, Tile(2, 176, 2, overlap=True), "bias", False),
    "vision's fc1 in batches, fp8": partial(_product_fp8, Tile(2, 184, overlap=True), "gelu", 1152, 0, True),
    "vision's output added to the stream in batches, fp8": partial(_product_fp8, Tile(3, 192), "added", 1152, 0, False),
    "prefixes' output added to the stream, fp8": partial(
        _product_fp8, Tile(2, 144, overlap=True), "added", 2048, 0, False
    ),
    "prefixes' output added to the stream, bf16": partial(_product, Tile(3, 192, cluster_m=2), "added", False),
    "LayerNorm of many rows, fp8": partial(_layer_norm, False, True),
    "LayerNorm of many rows and what is added, bf16": partial(_layer_norm, True, False),
    # Few rows, in tiles that leave room for the next kernel
    "expert's q|k|v in batches, bf16": partial(_product, Tile(1, 40), "plain", False),
    "expert's GeGLU in batches, bf16": partial(_product, Tile(1, 64), "geglu", False),
    "expert's output in parts in batches, fp8": partial(
        _product_fp8, Tile(1, 32, splits=4, ring=4), "parts", 2048, 0, False
    ),
    "product that leaves a copy, fp8": partial(_product_fp8, Tile(1, 80, cluster_m=2), "bias", 1152, 15, False),
    "vision's attention": partial(_attention, attention.AttentionTile(72, 128, sharing=2), True),
    "prefix's attention": partial(_attention, attention.AttentionTile(256, 64), False),
    "vision's attention in batches": partial(
        _attention, attention.AttentionTile(72, 64, 4, wide=True, queries=2), False
    ),
    "SmolVLA's vision attention": partial(_attention, attention.AttentionTile(64, 128, 3, wide=True, queries=2), False),
    "prefixes' attention": partial(_attention, attention.AttentionTile(256, 80, wide=True), False, packed=True),
    "suffixes' attention, fp8": partial(_suffixes, SuffixTile(256, 80, 4, 80), True),
    "suffixes' attention in few clusters, fp8": partial(_suffixes, FewTile(256, 40, 6, 96, 2), True),
    "suffixes' attention in few clusters, bf16": partial(_suffixes, FewTile(256, 80, 6, 96, 4), False),
}


def compiler() -> str | None:
    """NVRTC's version, as exactly as it can be had; None without NVRTC."""
    try:
        major, minor = nvrtc.checked("nvrtcVersion", nvrtc.bindings("nvrtc").nvrtcVersion())
    except (BackendError, RuntimeError):  # no package, or no library behind it
        return None
    packages = {one.metadata["Name"].lower(): one.version for one in importlib.metadata.distributions()}
    exact = (version for name, version in sorted(packages.items()) if name.startswith("nvidia-cuda-nvrtc"))
    return next((version for version in exact if version.startswith(f"{major}.{minor}")), f"{major}.{minor}")


def machine_code(folder: Path | None = None) -> dict[str, str] | None:
    """{"NVRTC": its version, shape: hash of its machine code}; None without NVRTC.

    Cubins that `folder` (None: the user's cache) has aren't compiled again.
    """
    version = compiler()
    if version is None:
        return None
    with ThreadPoolExecutor(2) as pool:
        cubins = list(pool.map(lambda make: make(folder), SHAPES.values()))
    return {"NVRTC": version, **{name: hash_of(cubin) for name, cubin in zip(SHAPES, cubins, strict=True)}}


def hash_of(cubin: bytes) -> str:
    """Of what runs: names of files, symbols and the order of sections don't count."""
    digest = hashlib.sha256()
    for name, content in sorted(sections(cubin)):
        if name.startswith(SECTIONS):
            digest.update(f"{name} {len(content)}\n".encode() + content)
    return digest.hexdigest()[:16]


def sections(elf: bytes) -> Iterator[tuple[str, bytes]]:
    """(name, content) of a 64-bit ELF file's sections."""
    assert elf[:5] == b"\x7fELF\x02", "no 64-bit ELF file"
    (table,), (size, count, of_names) = struct.unpack_from("<Q", elf, 0x28), struct.unpack_from("<3H", elf, 0x3A)
    headers = [struct.unpack_from("<IIQQQQIIQQ", elf, table + i * size) for i in range(count)]
    names = headers[of_names][4]
    for header in headers:
        start = names + header[0]
        content = b"" if header[1] == 8 else elf[header[4] : header[4] + header[5]]  # 8: NOBITS, as shared memory
        yield elf[start : elf.index(b"\0", start)].decode(), content
