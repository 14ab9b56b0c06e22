"""The denoising kernel's own products, run on a CPU thread by thread, of weights that `PackedExpert.pack` packed.

The producer brings them into the ring, warps find their fragments there and multiply them. What comes out must be a
plain matmul of the matrices as they were before packing.
"""

from pathlib import Path

import pytest
import torch
from emulator import emulate
from kernel_turns.problems import problem
from torch import Tensor

from turbopi.kernels.arguments import Parameter, Parameters
from turbopi.kernels.sm90 import instructions
from turbopi.kernels.sm90.denoise import kernel as denoise
from turbopi.kernels.sm90.denoise.packing import KINDS, RANKS, PackedExpert, Precision
from turbopi.quantization.fp8 import E4M3

pytestmark = pytest.mark.skipif(emulate.COMPILER is None, reason="no g++ here")
CPU = torch.device("cpu")
ENTRY = emulate.MACHINE.with_name("denoise_products.cu")
TAKES = Parameters(
    (
        *(Parameter("const unsigned char*", "weights"), Parameter("const long long*", "starts")),
        *(Parameter("long long", "layer_bytes"), Parameter("const long long*", "no_keys")),
        *(Parameter("const int*", "ctas"), Parameter("const unsigned char*", "stream")),
        *(Parameter("const unsigned char*", "attended"), Parameter("const unsigned char*", "hidden")),
        Parameter("float*", "sums"),
    )
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Compiled kernels."""
    return tmp_path_factory.mktemp("emulated")


@pytest.fixture
def in_part(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the kernel's source what its products need: attention and what follows it isn't compiled."""
    monkeypatch.setattr(instructions, "wgmma", emulate.wgmma)
    monkeypatch.setattr(denoise, "PARTS", denoise.PARTS[: denoise.PARTS.index("{form}/project") + 1])


def operand(x: Tensor) -> Tensor:
    """[tokens, columns] as sizes.cu says that activations lie: [block][8 tokens][8 columns][token][16 bytes], of E4M3
    [block][8 tokens][token][16 bytes].
    """
    tokens, columns = x.shape
    per = 16 // x.element_size()
    return x.view(tokens // 8, 8, columns // 16, 16 // per, per).permute(2, 0, 3, 1, 4).contiguous()


def run(
    packed: PackedExpert, suffix: int, ctas: list[int], inputs: tuple[Tensor, ...], folder: Path, seed: int
) -> Tensor:
    """float32[CTAs, layers, qkv | out | gate|up | down, tiles, 16, tokens]; NaN where the kernel wrote nothing."""
    a, fp8 = packed.arrangement, packed.fp8
    sizes = denoise.kernel_sizes(a, cache_rows=48, suffix=suffix, shared_bytes=232448, fp8=fp8)
    source = denoise.source(suffix, fp8) + ENTRY.read_text()
    library = emulate.compiled(source, "products", TAKES, sizes, folder, in_part=True)
    queries, keys_values, gates, slice_tiles = a.max_tiles
    room, tokens = max(queries + keys_values, gates, slice_tiles), -(-suffix // 8) * 8
    sums = torch.full((len(ctas), a.config.expert.depth, len(KINDS), room, 16, tokens), torch.nan)
    which, no_keys = torch.tensor(ctas, dtype=torch.int32), torch.zeros(1, dtype=torch.int64)
    given = {"weights": packed.weights, "starts": packed.starts, "no_keys": no_keys, "ctas": which, "sums": sums}
    given |= dict(zip(("stream", "attended", "hidden"), inputs, strict=True))
    addresses = {name: tensor.data_ptr() for name, tensor in given.items()}
    kernel = emulate.EmulatedKernel(library, TAKES, denoise.THREADS, 1, 1, seed)
    kernel.launch_dependent(len(ctas), addresses | {"layer_bytes": packed.layer_bytes})
    return sums


# Both forms; the full model's widths; tiles and ranks that divide nothing; several groups.
SIZES = (("odd", 10), ("uneven", 50), ("wide", 3), ("wide", 20), ("shallow", 10), ("shallow", 50))
FAST = (("odd", 10, "bf16"), ("uneven", 50, "bf16"), ("wide", 3, "bf16"), ("shallow", 10, "bf16"))
MORE = [(*size, precision) for size in SIZES for precision in ("bf16", "fp8") if (*size, precision) not in FAST]


@pytest.mark.parametrize(
    ("name", "suffix", "precision"),
    [*FAST, *(pytest.param(*one, marks=pytest.mark.slow) for one in MORE)],
)
def test_the_kernels_products_of_packed_weights_are_those_of_the_matrices(
    in_part: None, folder: Path, name: str, suffix: int, precision: Precision
) -> None:
    p = problem(name, 1, 1, 3, 0, CPU)
    g, fp8 = p.config.expert, precision == "fp8"
    scales = {f"expert.{i}.{kind}": 1.0 for i in range(g.depth) for kind in KINDS}
    packed = PackedExpert.pack(p.config, p.layers, scales if fp8 else None)
    a = packed.arrangement
    gen, tokens = torch.Generator().manual_seed(suffix), -(-suffix // 8) * 8
    widths = g.width, g.num_heads * g.head_dim, g.mlp_dim
    x, attended, hidden = (torch.randn(tokens, n, generator=gen).to(E4M3 if fp8 else torch.bfloat16) for n in widths)
    kept = torch.cat([a.out_columns(cluster) for cluster in range(a.clusters)])  # the order in which attention is kept
    inputs = operand(x), operand(attended.view(torch.uint8 if fp8 else torch.int16)[:, kept]), operand(hidden)
    ctas = [a.blocks - 1] if name == "shallow" else sorted({0, 3, RANKS + 5, a.blocks - 1})
    sums = run(packed, suffix, ctas, inputs, folder, seed=suffix).double()
    x, attended, hidden = x.double(), attended.double(), hidden.double()
    for i, cta in enumerate(ctas):
        cluster, rank = divmod(cta, RANKS)
        columns, units = a.out_columns(cluster), a.hidden(cluster)
        qkv_rows = torch.cat((a.query_rows(cluster, rank), a.key_value_rows(cluster, rank)))
        stream_rows = a.stream_rows(rank)
        for layer in range(g.depth):
            qkv, out, gate_up, down = (matrix.double() for matrix in packed.matrices(layer))
            wanted = (
                (qkv_rows, x @ qkv.T),
                (stream_rows, attended[:, columns] @ out[:, columns].T),
                (a.gate_up_rows(cluster, rank), x @ gate_up.T),
                (stream_rows, hidden[:, units.start : units.stop] @ down[:, units.start : units.stop].T),
            )
            own = packed.row_scales(layer) if fp8 else (torch.ones(len(qkv) + len(gate_up)),) * 4
            for kind, (rows, product) in enumerate(wanted):
                found = sums[i, layer, kind, : len(rows), :, :suffix] * own[kind][rows][..., None]
                torch.testing.assert_close(found, product.T[rows][..., :suffix], rtol=1e-5, atol=1e-5)
