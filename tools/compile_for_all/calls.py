"""Calls of everything that launches a Triton kernel, at the full model's sizes: two images and a prompt's bucket."""

from collections.abc import Callable
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor, nn

from compile_for_all.targets import Target
from turbopi.kernels.interface import SOURCE, Segments, StepEnd
from turbopi.kernels.portable import (
    activations,
    attention,
    backward,
    batch,
    batch_steps,
    embedding,
    grouped,
    norms,
    nvfp4,
    quantize,
    resize,
    rope,
    token,
    transfer,
)
from turbopi.kernels.portable.attention_tiles import Attention, AttentionTile
from turbopi.kernels.portable.attention_tiles import candidates as attention_candidates
from turbopi.kernels.portable.gemm import tiles
from turbopi.kernels.portable.gemm.kernel import product
from turbopi.kernels.portable.vjp.ops import FEW_TOKENS
from turbopi.quantization.formats import OF_EIGHT_BITS, Format
from turbopi.quantization.fp8 import E4M3, Directions, ScaledMatrix
from turbopi.quantization.nvfp4 import BLOCK, Nvfp4Matrix, whole

BF16, F32 = torch.bfloat16, torch.float32
Calls = list[Callable[[], Any]]
Input = dict[str, Any]  # what the operation in front of a matrix is told: see `quantization.fp8.input_of`
ROWS, PREFIX, SUFFIX, SMOLVLA_PLACES = 512, 560, 50, 177
# name, epilogue, rows, out, in, bias, E4M3 or int8 behind it
PRODUCTS: tuple[tuple[str, tiles.Epilogue, int, int, int, bool, bool], ...] = (
    ("vision's qkv", "plain", ROWS, 3456, 1152, True, False),
    ("vision's out", "parts", ROWS, 1152, 1152, True, False),
    ("vision's fc1", "gelu", ROWS, 4352, 1152, True, True),
    ("vision's fc1 before bf16", "gelu", ROWS, 4352, 1152, True, False),
    ("vision's fc2", "parts", ROWS, 1152, 4352, True, False),
    ("projector", "plain", ROWS, 2048, 1152, True, False),
    ("prefix's qkv", "plain", PREFIX, 2560, 2048, False, False),
    ("prefix's out", "parts", PREFIX, 2048, 2048, False, False),
    ("prefix's gate and up", "geglu", PREFIX, 16384, 2048, False, True),
    ("prefix's gate and up before bf16", "geglu", PREFIX, 16384, 2048, False, False),
    ("prefix's down", "parts", PREFIX, 2048, 16384, False, False),
)


def of(*shape: int, dtype: torch.dtype = BF16) -> Tensor:
    return torch.empty(shape, dtype=dtype, device="cuda")


def all_calls(target: Target, chosen: bool = False) -> Calls:
    """Every variant that the product can launch there at full size. chosen: see below."""
    inverses: tuple[Input, ...] = ({}, *({"inverse": 30.0, "numbers": one} for one in eight_bits(target)))
    calls = [
        *_norms(inverses),
        *_attention(target, inverses),
        *_batch(target, inverses),
        *_rest(),
        *_backward(),
        *_backward_form(),
        *_smolvla(target, inverses),
        _one_token,
    ]
    calls += [partial(_geglu, one) for one in inverses]
    return [*calls, *_weights(), *product_calls(target, chosen), *four_bits(target)]


def eight_bits(target: Target) -> list[torch.dtype]:
    """E4M3 and int8, as far as the GPU takes them."""
    refusals = {E4M3: tiles.fp8_refusal, torch.int8: tiles.int8_refusal}
    return [numbers for numbers, refusal in refusals.items() if refusal(target.capability) is None]


def _marks(input: Input) -> Input:
    """The residual stream, in which int8's damage is marked."""
    return {"stream": of(PREFIX, 2048)} if input.get("numbers") == torch.int8 else {}


def _geglu(input: Input) -> Tensor:
    return activations.geglu(of(PREFIX, 2 * 16384), **input, **_marks(input))


def product_calls(target: Target, chosen: bool = False) -> Calls:
    """The products in every tile of the table that this GPU takes; `chosen`: in the tile that it would choose alone.

    Splits of the inner axis are two, which stands for more.
    """
    calls: Calls = []
    halves = [(E4M3, True)] if tiles.half_sums_refusal(target.capability) is None else []
    for of_numbers, half in [*((one, False) for one in (*eight_bits(target), BF16)), *halves]:
        for _, epilogue, m, n, k, bias, behind in PRODUCTS:
            if of_numbers == BF16 and (epilogue != "geglu" or behind):
                continue  # the library's
            for tile in tiles.candidates(target.capability, of_numbers != BF16, epilogue, k, half):
                if tile.splits <= 2:
                    used = None if chosen else tile
                    calls.append(partial(_product, of_numbers, epilogue, m, n, k, bias, behind, used, half))
    return calls


def four_bits(target: Target) -> Calls:
    """NVFP4's products, each with the rounding of its activation, where the GPU takes them."""

    def four(epilogue: tiles.Epilogue, m: int, n: int, k: int, bias: bool) -> Tensor:
        rows, wide = 2 * n if epilogue == "geglu" else n, whole(k)
        codes, blocks = of(rows, wide // 2, dtype=torch.uint8), of(rows, wide // BLOCK, dtype=E4M3)
        with_it: Any = "plain" if epilogue == "parts" else epilogue
        matrix = Nvfp4Matrix(codes, blocks, of(rows, dtype=F32), 0.2, k, BF16)
        return nvfp4.product(of(m, k), matrix, with_it, of(n) if bias else None)

    if tiles.nvfp4_refusal(target.capability) is not None:
        return []
    return [partial(four, epilogue, m, n, k, bias) for _, epilogue, m, n, k, bias, _ in PRODUCTS]


def _product(
    numbers: torch.dtype,
    epilogue: tiles.Epilogue,
    m: int,
    n: int,
    k: int,
    bias: bool,
    behind: bool,
    tile: tiles.Tile | None,
    half: bool,
) -> Tensor:
    rows = 2 * n if epilogue == "geglu" else n
    data = of(rows, k, dtype=numbers)
    weight = data if numbers == BF16 else ScaledMatrix(data, of(rows, dtype=F32), 50.0, BF16, half)
    input: Input = {"inverse": 30.0, "numbers": numbers} if behind else {}
    added = of(n) if bias else None
    return product(of(m, k, dtype=numbers), weight, epilogue, added, tile=tile, **input, **_marks(input))


def _norms(inverses: tuple[Input, ...]) -> Calls:
    calls: Calls = []
    for inverse in inverses:
        for splits in (None, 0, 2, 3, 4):
            for width, rows in ((2048, PREFIX), (1152, ROWS)):
                y: tuple[int, ...] = (rows, width) if not splits else (splits, rows, width)
                if width == 2048:
                    calls.append(partial(_rms, rows, width, None if splits is None else y, None, False, inverse))
                else:
                    calls.append(partial(_layer_norm, rows, width, None if splits is None else y, inverse))
    for by_row in (False, True):
        for given in (None, (SUFFIX, 1024)):
            calls.append(partial(_rms, SUFFIX, 1024, given, given, by_row, {}))
    return calls


def _rms(
    rows: int, width: int, y: tuple[int, ...] | None, gate: Any, by_row: bool, input: Input
) -> tuple[Tensor, Tensor]:
    shape = (rows, width) if by_row else (width,)
    modulated = width == 1024
    factor, shift = of(*shape, dtype=F32), of(*shape, dtype=F32) if modulated else None
    gated = None if gate is None else of(*shape, dtype=F32)
    given = None if y is None else of(*y)
    return norms.residual_rms_norm(of(rows, width), given, gated, factor, shift, 1e-6, **input)


def _layer_norm(rows: int, width: int, y: tuple[int, ...] | None, input: Input) -> tuple[Tensor, Tensor]:
    given = None if y is None else of(*y)
    return norms.residual_layer_norm(of(rows, width), given, of(width), of(width), 1e-6, **input)


def _attention(target: Target, inverses: tuple[Input, ...]) -> Calls:
    """In every tile that this GPU takes."""

    def vision(tile: AttentionTile, input: Input) -> Tensor:
        return attention.vision_attention(of(ROWS, 3456), 2, 16, tile=tile, **input, **_marks(input))

    def prefix(tile: AttentionTile, input: Input) -> Tensor:
        k = of(PREFIX, 256)
        length = of(1, dtype=torch.int64)
        return attention.prefix_attention(of(PREFIX * 8, 256), k, k, length, 8, tile=tile, **input)

    def softmax(state_token: bool) -> Tensor:
        length = of(1, dtype=torch.int64)
        return attention.masked_softmax(of(SUFFIX * 8, 1026, dtype=F32), length, 976, 8, state_token, 0.06, BF16)

    return [
        *(partial(vision, *one) for one in _in_tiles(target, "vision_attention", 72, inverses)),
        *(partial(prefix, *one) for one in _in_tiles(target, "prefix_attention", 256, inverses)),
        *(partial(softmax, state_token) for state_token in (False, True)),
    ]


def _in_tiles(
    target: Target, kind: Attention, dim: int, inverses: tuple[Input, ...]
) -> list[tuple[AttentionTile, Input]]:
    return [(tile, one) for tile in attention_candidates(kind, target.capability, dim) for one in inverses]


def _batch(target: Target, inverses: tuple[Input, ...]) -> Calls:
    """Of two and sixteen observations: keys of a suffix split over blocks, and in one; of eight with few actions. In
    every tile.
    """

    def packed(tile: AttentionTile, input: Input) -> Tensor:
        k, rows = of(2 * PREFIX, 256), of(3, dtype=torch.int32)
        segments = Segments(rows, rows, of(143, 4, dtype=torch.int32))
        return batch.packed_attention(of(2 * PREFIX * 8, 256), k, k, segments, 8, tile=tile, **input)

    def suffix(count: int, tokens: int, state_token: bool, tile: AttentionTile, input: Input) -> Tensor:
        prefix, rows, inverse = of(count * PREFIX, 256), of(count + 1, dtype=torch.int32), input.get("inverse")
        qkv, cos = of(count * tokens, 2560), of(count * tokens, 128, dtype=F32)
        return batch.suffix_attention(qkv, cos, cos, prefix, prefix, rows, rows, 8, state_token, inverse, tile=tile)

    def embed() -> None:
        batch.embed_rows(of(2 * PREFIX, dtype=torch.int64), of(4 * 256, 2048), of(257152, 2048), of(2 * PREFIX, 2048))

    def norm(parts: int | None, input: Input) -> Any:
        """Of a modulated norm, and of Pi0's."""
        y, of_all = None if parts is None else of(*([parts] if parts else []), SUFFIX, 1024), of(1024, dtype=F32)
        shift, gate = (None, None) if parts == 1 else (of_all, None if y is None else of_all)
        return batch_steps.residual_rms_norm(of(SUFFIX, 1024), y, gate, of_all, shift, 1e-6, **input)

    def end(parts: int) -> Tensor:
        width, actions, of_all = 1024, 32, of(1024, dtype=F32)
        out = of(actions, width, dtype=F32), of(actions, dtype=F32)
        into = of(width, actions, dtype=F32), of(width, dtype=F32)
        x, y = of(SUFFIX, width), of(*([parts] if parts else []), SUFFIX, width)
        chunks = [of(SUFFIX, actions, dtype=F32)] * 3
        return batch_steps.end_step(x, y, of_all, StepEnd(of_all, of_all, 1e-6, out, -0.1, into), *chunks)

    beside = tuple(one for one in inverses if one.get("numbers") != torch.int8)  # of INT8's expert: bfloat16
    suffixes = _in_tiles(target, "suffix_attention", 256, beside)
    return [
        embed,
        *(partial(packed, *one) for one in _in_tiles(target, "packed_attention", 256, inverses)),
        *(partial(suffix, 8, 10, False, *one) for one in suffixes),
        *(partial(suffix, count, SUFFIX, False, *one) for count in (2, 16) for one in suffixes),
        *(partial(suffix, count, SUFFIX, True, *one) for count in (2, 16) for one in suffixes if not one[1]),
        *(partial(norm, parts, one) for parts in (None, 0, 1, 4, 8) for one in beside),
        *(partial(end, parts) for parts in (0, 4, 8)),
    ]


def _rest() -> Calls:
    def rope_split() -> Tensor:
        cos, cache = of(PREFIX, 128, dtype=F32), of(PREFIX, 256)
        return rope.rope_split(of(PREFIX, 2560), cos, cos, cache, cache)

    def camera_images(dtype: torch.dtype) -> None:
        resize.resize_images(of(2, len(SOURCE), dtype=torch.int64), of(2, 224, 224, 3, dtype=dtype))

    pixels = (torch.uint8, F32)
    return [
        rope_split,
        *(partial(camera_images, dtype) for dtype in pixels),
        lambda: transfer.transfer(of(2, 224, 224, 3, dtype=torch.uint8), of(2, 224, 224, 3, dtype=torch.uint8)),
        *(partial(lambda dtype: embedding.patch_rows(of(2, 224, 224, 3, dtype=dtype), 14), dtype) for dtype in pixels),
        lambda: embedding.odd_rows(of(2, 224, 224, 3, dtype=torch.uint8), 14),
        lambda: embedding.add_position(of(ROWS, 1152, dtype=F32), of(256, 1152, dtype=F32), BF16),
        lambda: embedding.embed_prompt(of(48, dtype=torch.int64), of(257152, 2048), of(48, 2048)),
    ]


def _smolvla(target: Target, inverses: tuple[Input, ...]) -> Calls:
    """Two images of 1,024 patches, which are 64 places each; 48 of the prompt; the state."""
    heads, groups, width, hidden, places = 15, 5, 960, 2560, SMOLVLA_PLACES

    def layer(input: Input) -> None:
        cos, cache = of(places, 32, dtype=F32), of(groups, places, 64)
        q = grouped.rope_grouped(of(places, (heads + 2 * groups) * 64), cos, cos, cache, cache)
        grouped.grouped_attention(q, cache, cache, of(1, dtype=torch.int64), **input, **_marks(input))
        grouped.swiglu(of(places, 2 * hidden), **input, **_marks(input))

    def several(*, own: bool) -> None:
        """Attention of the expert's 50 actions of each of two observations."""
        cache, its, lengths = of(groups, 2 * places, 64), of(groups, 100, 64), of(2, dtype=torch.int64)
        q = of(groups, 100 * heads // groups, 64)
        grouped.grouped_suffix_attention(q, cache, cache, lengths, 50, (its, its) if own else None)

    def rms(y: tuple[int, ...] | None) -> Any:
        given = None if y is None else of(*y)
        return norms.residual_rms_norm(of(places, width), given, None, of(width, dtype=F32), None, 1e-5)

    def vision(tile: AttentionTile) -> Tensor:
        return attention.vision_attention(of(2048, 2304), 2, 12, tile=tile)

    parts: tuple[tuple[int, ...], ...] = ((), (2,), (3,), (4,))
    return [
        *(partial(layer, one) for one in inverses),
        *(partial(several, own=own) for own in (False, True)),
        *(partial(rms, y) for y in (None, *((*one, places, width) for one in parts))),
        *(partial(_layer_norm, 2048, 768, y, {}) for y in (None, *((*one, 2048, 768) for one in parts))),
        *(partial(vision, tile) for tile in attention_candidates("vision_attention", target.capability, 64)),
    ]


def _one_token() -> None:
    """Of Pi0-FAST: a layer behind three images and a prompt, in bf16 and with INT8 weights, and the head."""

    def int8(rows: int, columns: int) -> token.Int8Rows:
        return token.Int8Rows(of(rows, columns // 4, dtype=torch.int32), of(rows, dtype=F32))

    norm, row, (heads, dim, width, hidden, places) = (
        nn.RMSNorm(2048, dtype=BF16),
        of(2048, dtype=F32),
        (8, 256, 2048, 16384, 1274),
    )
    one, many, room = of(1, dtype=torch.int64), of(1, 256, dtype=torch.int64), of(1, dtype=torch.uint8)
    shares = of(40, heads, dim, dtype=F32), of(40, heads, dtype=F32), of(40, heads, dtype=F32)
    qkv, cos, cache, attended = (
        of(2560, dtype=F32),
        of(places, 128, dtype=F32),
        of(1, 1, places, dim),
        of(heads * dim, dtype=F32),
    )
    table, logits = of(257152, width), of(1, 257152, dtype=F32)
    token.embed_id(one, table, row)
    for weight in (of, int8):
        token.row_product(row, weight(2560, width), qkv, norm=norm, eps=1e-6)
        token.row_product(attended, weight(width, heads * dim), row, add=True)
        up = weight(hidden, width)
        token.row_product(row, weight(hidden, width), of(hidden, dtype=F32), norm=norm, eps=1e-6, beside=up)
        token.row_product(of(hidden, dtype=F32), weight(width, hidden), row, add=True)
    token.attend_places(qkv, (cos, cos), cache, cache, of(1, places, dtype=torch.uint8), one, one, shares)
    token.join_shares(shares, attended)
    best, where = of(126, dtype=F32), of(126, dtype=torch.int32)
    token.choose(logits, best, where, one, many, one, one, one, of(2, dtype=torch.int64), room)


def _backward() -> Calls:
    def rms(by_row: bool, full: bool, parts: int) -> Any:
        factor = of(SUFFIX, 1024, dtype=F32) if by_row else of(1024, dtype=F32)
        d_x, gate = (of(SUFFIX, 1024, dtype=F32), factor) if full else (None, None)
        d_normed = of(parts, SUFFIX, 1024, dtype=F32) if parts else of(SUFFIX, 1024)
        return backward.rms_norm_vjp(d_normed, of(SUFFIX, 1024), factor, 1e-6, d_x, gate)

    def rope_vjp() -> Tensor:
        cos, head = of(SUFFIX, 128, dtype=F32), of(SUFFIX, 256)
        return backward.rope_vjp(of(SUFFIX * 8, 256), head, head, cos, cos)

    return [
        *(partial(rms, by_row, full, 0) for by_row in (False, True) for full in (False, True)),
        *(partial(rms, True, True, parts) for parts in (8, 10)),
        lambda: backward.geglu_vjp(of(SUFFIX, 4096), of(SUFFIX, 8192)),
        lambda: backward.softmax_vjp(of(SUFFIX * 8, 1026), of(SUFFIX * 8, 1026, dtype=F32), 0.06),
        rope_vjp,
    ]


def _backward_form() -> Calls:
    """The expert on few tokens: a tile for each power of two of them, with prefixes of one and of four cameras."""

    def layer(tokens: int, slots: int, state_token: bool) -> None:
        ops, x, cos = FEW_TOKENS, of(tokens, 1024), of(tokens, 128, dtype=F32)
        k, own, heads = of(slots + tokens, 256), of(tokens, 256), (of(1, dtype=torch.int64), slots, 8, state_token)
        qkv, out, gate_up, down = of(2560, 1024), of(1024, 2048), of(8192, 1024), of(1024, 4096)
        q = ops.qkv(x, qkv, cos, cos, own, own)
        attended, kept = ops.attention(q, k, k, *heads)
        ops.out(attended, out)
        product, hidden = ops.gate_up(x, gate_up)
        ops.down(hidden, down)
        ops.gate_up_vjp(ops.down_vjp(x, down, product), gate_up)
        ops.qkv_vjp(ops.attention_vjp(kept, ops.out_vjp(x, out), k, k, *heads), cos, cos, qkv)
        cache, chunk, one = of(18, slots + tokens, 256), of(tokens, 32, dtype=F32), of(tokens, dtype=F32)
        ops.kept_attention(of(18, tokens * 8, 256), cache, cache, *heads)
        into, table, rows = of(1024, 32, dtype=F32), of(11, 1024, dtype=F32), of(tokens, dtype=torch.int32)
        ops.pull(chunk, chunk, one, chunk, of(tokens, 1, dtype=F32), of(32, 1024, dtype=F32), BF16)
        ops.move(of(tokens, 1024, dtype=F32), into, chunk, chunk, chunk, one, one, chunk)
        d_x, eight, ten = of(tokens, 1024, dtype=F32), *(of(parts, tokens, 1024, dtype=F32) for parts in (8, 10))
        for d_normed in (eight, ten):
            ops.rms_norm_vjp(d_normed, x, table, 1e-6, d_x, table, rows)
        ops.rms_norm_vjp(x, x, table, 1e-6, None, table, rows)  # the last one
        ops.rms_norm_vjp(ten, x, table, 1e-6, d_x, None, rows)  # the first one

    return [
        partial(layer, tokens, slots, tokens == 51)
        for tokens in (10, 32, 50, 51)
        for slots in (256 + 64, PREFIX + 8, 4 * 256 + 208)
    ]


def _weights() -> Calls:
    """To eight bits. `turbopi calibrate` and the emulated backends round to each format on every GPU, whatever its
    tensor cores multiply, of float32 weights; `fused` of bfloat16.
    """

    def rounded(format: Format, dtype: torch.dtype) -> Tensor:
        directions = Directions(of(1152, 16, dtype=E4M3), of(16, dtype=F32), 0.1)
        feeding = of(1152, dtype=torch.int64), of(1152, 16, dtype=F32), of(1152, 16, dtype=F32)
        with patch.object(quantize, "feedback", lambda given: feeding):  # PyTorch's operations, which need a GPU
            return quantize.round_rows(of(2048, 1152, dtype=dtype), of(2048, dtype=F32), directions, format)

    return [partial(rounded, format, dtype) for format in OF_EIGHT_BITS.values() for dtype in (BF16, F32)]
