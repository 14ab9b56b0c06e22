"""Faults that would send a robot's arm somewhere else, or stop it: each one line of code, as someone might write it.

A fault is a text that stands exactly once in a package's files, and what takes its place. A text that is no longer
there is an error (tests/test_tools_mutate.py), so the table follows the code.
"""

from dataclasses import dataclass
from pathlib import Path

EMULATED = "tests/test_kernels_emulated.py::test_a_product_in_bf16_is_right_in_whatever_order_its_threads_go"
PRODUCTS = "tests/test_kernels_denoise_emulated.py"
CHOICE = "tests/test_fused_choice.py"
ARGUMENTS = "tests/test_kernels_arguments.py"
GEOMETRY = "tests/test_launch_geometry.py"
BY_TOKEN = (
    "tests/test_kernels_denoise_by_token.py::test_a_lane_gets_its_tokens_factors_of_its_columns",
    "tests/test_kernels_denoise_by_token.py::test_a_lane_gets_its_tokens_shifts_of_its_rows",
    "tests/test_kernels_denoise_by_token.py::test_a_number_is_guided_and_moved_as_pytorch_would",
)
CONDITIONED_BATCH = (
    "tests/test_engine_batch_conditioned.py::test_intermediates_of_golden_cases",
    "tests/test_engine_batch_conditioned.py::test_held_actions_come_out_as_they_were_given",
)
ENGINE = "tests/test_engine.py::test_equals_the_reference_for_odd_prompts_and_cameras"
BARRIERS = "tests/test_kernels_barriers.py"
PARITY = "tests/test_model_parity.py::test_float32_equals_openpi_within_float32_rounding"


@dataclass(frozen=True)
class Fault:
    """One change that is fatal on a GPU.

    package  whose .py and .cu files, in all its folders, have `text` exactly once
    fatal    what a robot would see of it
    tests    files or names of tests, as pytest takes them, of which one at least must fail: of the fast tier
    """

    name: str
    package: str
    text: str
    planted: str
    fatal: str
    tests: tuple[str, ...]


FAULTS = (
    Fault(
        "M and N swapped at the FP8 product's launch",
        "turbopi.kernels",
        '"mark_pitch": stream.stride(0)}),\n        **size_arguments(m, n,',
        '"mark_pitch": stream.stride(0)}),\n        **size_arguments(n, m,',
        "rows beyond the result are written, columns of it are not",
        (ARGUMENTS, GEOMETRY),
    ),
    Fault(
        "two pointers swapped in the denoising kernel's struct",
        "turbopi.kernels.portable.denoise",
        '"cache_k": cache_k, "cache_v": cache_v,',
        '"cache_k": cache_v, "cache_v": cache_k,',
        "queries meet values: actions are noise",
        (GEOMETRY,),
    ),
    Fault(
        "the denoising kernel's results swapped",
        "turbopi.kernels.portable.denoise",
        '"x_t": x_t, "v_t": v_t}',
        '"x_t": v_t, "v_t": x_t}',
        "velocities leave as actions, and memory behind v_t is overwritten",
        (GEOMETRY,),
    ),
    Fault(
        "times and steps of tokens swapped in the denoising kernel's struct",
        "turbopi.kernels",
        '"token_steps": (tokens.steps, by_step),\n            "token_times": (tokens.times, by_step),',
        '"token_steps": (tokens.times, by_step),\n            "token_times": (tokens.steps, by_step),',
        "denoising adds noise; actions that are held stay",
        (GEOMETRY,),
    ),
    Fault(
        "a token's factors given to its neighbour's column",
        "turbopi.kernels",
        "make_float4(even.x, odd.x, even.y, odd.y)",
        "make_float4(even.x, even.y, odd.x, odd.y)",
        "where tokens have different times every norm is wrong",
        BY_TOKEN,
    ),
    Fault(
        "guidance by identity in the wrong direction",
        "turbopi.kernels",
        "__fsub_rn(target, chunk)",
        "__fsub_rn(chunk, target)",
        "a new chunk jumps away from the one that runs",
        BY_TOKEN,
    ),
    Fault(
        "the denoising kernel's output projection not transposed",
        "turbopi.kernels.sm90",
        'out_w=small["action_out_proj.weight"].T,',
        'out_w=small["action_out_proj.weight"],',
        "every action is a mixture of other outputs",
        (GEOMETRY,),
    ),
    Fault(
        "scale and shift swapped in `Copy`",
        "turbopi.kernels",
        '"norm_scale": copy.scale.data_ptr(),\n        "norm_shift": copy.shift.data_ptr(),',
        '"norm_scale": copy.shift.data_ptr(),\n        "norm_shift": copy.scale.data_ptr(),',
        "LayerNorm's weights are applied as its biases in FP8 vision",
        (ARGUMENTS,),
    ),
    Fault(
        "the expert left on the host where operations denoise",
        "turbopi.backends",
        'self._expert.use("layers", user)  # while its graph is kept, as it points to them',
        "pass",
        "the first call whose loop the kernel refuses fails, after another loop had its kernel",
        (CHOICE,),
    ),
    Fault(
        "the expert put away from under a graph of operations",
        "turbopi.backends",
        'if not self.users["layers"]:',
        "if True:",
        "replays read freed memory",
        (CHOICE,),
    ),
    Fault(
        "a horizon's bound off by one",
        "turbopi.backends",
        "if reason is None and loop.horizon > most:",
        "if reason is None and loop.horizon > most + 1:",
        "a horizon of 57 stops the server instead of taking operations",
        (CHOICE,),
    ),
    Fault(
        "the kernel's room for cache rows forgets the fourth camera",
        "turbopi.backends",
        "cameras = min(max(shape.cameras, 3), MAX_CAMERAS)",
        "cameras = min(max(shape.cameras, 3), 3)",
        "keys of the fourth image are written beyond the buffer",
        (CHOICE,),
    ),
    Fault(
        "a prompt's bucket rounded down",
        "turbopi",
        "return max(BUCKET, -(-tokens // BUCKET) * BUCKET)",
        "return max(BUCKET, tokens // BUCKET * BUCKET)",
        "a prompt of 17 tokens doesn't fit into its call",
        ("tests/test_begin.py::test_actions_are_the_references",),
    ),
    Fault(
        "the length counts padding",
        "turbopi.engine",
        'arrays["length"][0] = self.images.rows + len(tokens)',
        'arrays["length"][0] = self.images.rows + len(padded)',
        "the policy reads words that nobody said",
        (ENGINE,),
    ),
    Fault(
        "unseen rows of the cache not zeroed",
        "turbopi.engine",
        "cache[:, self._unseen] = 0",
        "cache[:, self._unseen] += 0",
        "0 * NaN: actions are NaN",
        ("tests/test_engine.py::test_rows_between_prefix_and_suffix_are_seen_by_nobody", ENGINE),
    ),
    Fault(
        "keys and values swapped in the prefix's cache",
        "turbopi.engine",
        "        return cache_k[i, :slots], cache_v[i, :slots]",
        "        return cache_v[i, :slots], cache_k[i, :slots]",
        "actions ignore what the cameras see",
        (ENGINE,),
    ),
    Fault(
        "gate and up swapped in the packed matrix",
        "turbopi.checkpoint",
        '("gate_proj", "up_proj")',
        '("up_proj", "gate_proj")',
        "every feed-forward is wrong",
        (ENGINE,),
    ),
    Fault(
        "matrices that are rounded stay on the host",
        "turbopi.checkpoint",
        "room.take(name, state.pop(name))",
        "room.take(name, state[name])",
        "FP8 and INT8 need as much host memory as the weights",
        ("tests/test_engine_weight_placement.py::test_loading_for_eight_bits_never_holds_the_weights_on_the_host",),
    ),
    Fault(
        "adaRMS scales without their 1",
        "turbopi.engine",
        "table[:, :, 0] += 1",
        "table[:, :, 0] += 0",
        "actions are near 0",
        (ENGINE,),
    ),
    Fault(
        "RoPE's sign in the reference",
        "turbopi.models.pi0",
        "x1 * cos - x2 * sin, x2 * cos + x1 * sin",
        "x1 * cos + x2 * sin, x2 * cos - x1 * sin",
        "positions count backwards",
        (PARITY,),
    ),
    Fault(
        "RoPE's sign in the Triton kernel",
        "turbopi.kernels",
        "return first * c - second * s, second * c + first * s",
        "return first * c + second * s, second * c - first * s",
        "positions count backwards where operations denoise, and in every prefix",
        ("tests/test_kernels_ops.py::test_rope_split",),
    ),
    Fault(
        "an Euler step in the wrong direction",
        "turbopi.models.pi0",
        "return x_t + step_size(num_steps) * v_t",
        "return x_t - step_size(num_steps) * v_t",
        "denoising adds noise",
        (PARITY,),
    ),
    Fault(
        "an FP8 matrix whose input is multiplied by its scale",
        "turbopi.quantization",
        "return replace(self, scale=self.scale * scale, inverse=1 / scale)",
        "return replace(self, scale=self.scale * scale, inverse=scale)",
        "activations saturate or vanish",
        ("tests/test_kernels_fp8.py::test_a_matrix_has_a_scale_for_each_channel",),
    ),
    Fault(
        "a cluster's share of TMA's box",
        "turbopi.kernels",
        "matrix_map(a.data_ptr(), m, k, tile.rows // tile.cluster_n, fp8=True)",
        "matrix_map(a.data_ptr(), m, k, tile.rows // tile.cluster_m, fp8=True)",
        "a CTA's shared memory is overwritten, or the kernel waits forever",
        (GEOMETRY,),
    ),
    Fault(
        "more clusters than the GPU holds",
        "turbopi.kernels",
        "return min(groups * (1 if tile.gather else tile.splits), at_once)",
        "return groups * (1 if tile.gather else tile.splits)",
        "the persistent kernel's second wave starts when the first has ended: the prefix takes twice as long",
        (GEOMETRY,),
    ),
    Fault(
        "wrong parity at a barrier of the product's ring",
        "turbopi.kernels",
        "barrier_wait(empty + 8 * slot, round & 1 ^ 1);\n                    } else",
        "barrier_wait(empty + 8 * slot, round & 1);\n                    } else",
        "the kernel waits forever, or operands are overwritten while they are multiplied",
        (EMULATED,),
    ),
    Fault(
        "consumers' parity isn't flipped when the ring begins again",
        "turbopi.kernels",
        "if (slot == STAGES) slot = 0, parity ^= 1;",
        "if (slot == STAGES) slot = 0;",
        "products read what isn't there yet",
        (EMULATED,),
    ),
    Fault(
        "a slot is given back before its products are done",
        "turbopi.kernels",
        "commit_products(), await_products<1>();",
        "commit_products(), await_products<2>();",
        "operands are overwritten while they are multiplied: wrong now and then",
        (EMULATED,),
    ),
    Fault(
        "a cluster's barrier forgets who shares",
        "turbopi.kernels",
        "barrier_init(empty + 8 * s, WGS * (CM + CN - 1));",
        "barrier_init(empty + 8 * s, WGS);",
        "a neighbour's operands are overwritten while it multiplies",
        (EMULATED,),
    ),
    Fault(
        "entries of the epilogues' enum swapped",
        "turbopi.kernels",
        '"bias": 1, "gelu": 2,',
        '"bias": 2, "gelu": 1,',
        "GELU is applied where it isn't wanted, and left out where it is",
        (EMULATED,),
    ),
    Fault(
        "gate and up swapped in GeGLU's epilogue",
        "turbopi.kernels",
        "x = (FP8 ? twice_gelu(x) : gelu(x)) * sums[BN / 4 + 4 * j + 2 * half];",
        "x = (FP8 ? twice_gelu(sums[BN / 4 + 4 * j + 2 * half]) : gelu(sums[BN / 4 + 4 * j + 2 * half])) * x;",
        "every second hidden unit is wrong",
        (EMULATED,),
    ),
    Fault(
        "core matrices of packed weights by columns first",
        "turbopi.kernels",
        "ordered = tiles.view(count, 2, 8, blocks, 2, per).permute(0, 3, 1, 4, 2, 5)",
        "ordered = tiles.view(count, 2, 8, blocks, 2, per).permute(0, 3, 4, 1, 2, 5)",
        "every product of the action expert is wrong",
        (PRODUCTS,),
    ),
    Fault(
        "ldmatrix's quarters of lanes swapped in the denoising kernel",
        "turbopi.kernels",
        "b.lane() / 8 % 2 * 256 + b.lane() / 16 * 128",
        "b.lane() / 8 % 2 * 128 + b.lane() / 16 * 256",
        "queries, keys and values of few tokens are wrong",
        (PRODUCTS,),
    ),
    Fault(
        "parts of the reduction meet each other's activations",
        "turbopi.kernels",
        "const int here = min(fragment + my.part, most(blocks, KB) - 1);",
        "const int here = min(fragment, most(blocks, KB) - 1);",
        "models whose widths divide nothing get wrong sums",
        (PRODUCTS,),
    ),
    Fault(
        "weights' slot given back before its products are done",
        "turbopi.kernels",
        "await_products<1>();  // the round before is done",
        "await_products<2>();  // the round before is done",
        "weights are overwritten while they are multiplied: wrong now and then",
        (PRODUCTS,),
    ),
    Fault(
        "a slot is given back when 15 of 16 warps have read it",
        "turbopi.kernels.sm90",
        "barrier_init(b.empty(i), W);",
        "barrier_init(b.empty(i), W - 1);",
        "weights are overwritten while a warp reads them: wrong now and then, or the loop stops",
        (BARRIERS,),
    ),
    Fault(
        "queries are sent before all ranks have multiplied the stream",
        "turbopi.kernels.sm90",
        "    await_room(b);\n    send_queries(b, staged);",
        "    send_queries(b, staged);",
        "queries land on the stream while a rank multiplies it: wrong now and then",
        (BARRIERS,),
    ),
    Fault(
        "fewer bytes of queries are awaited than are sent",
        "turbopi.kernels.sm90",
        "Q_EXPECT = HD * T * 2",
        "Q_EXPECT = HD * T",
        "scores of half of the queries; then the barrier is never right again",
        (BARRIERS,),
    ),
    Fault(
        "every observation of a batch gets the first one's conditioning",
        "turbopi.engine",
        "array[row] if name in BY_ACTION else array[:, row] for",
        "array[0] if name in BY_ACTION else array[:, 0] for",
        "a robot carries out another one's actions",
        CONDITIONED_BATCH,
    ),
    Fault(
        "guided observations of a batch see each other's prefixes on the way",
        "turbopi.kernels",
        "logits.view(-1, heads, len(k)).masked_fill_(hidden, -torch.inf)",
        "pass",
        "one robot's images move another one's arm",
        CONDITIONED_BATCH,
    ),
    Fault(
        "a graph's replay isn't waited for",
        "turbopi.engine",
        "self.launch()\n        torch.cuda.current_stream(self._device).synchronize()",
        "self.launch()",
        "the robot gets the actions of the call before",
        ("tests/test_capture.py",),
    ),
)


def place(fault: Fault, source: Path) -> Path:
    """The file that has the fault's text, below the folder `source` in which packages are.

    Raises ValueError unless the text stands exactly once in its package.
    """
    folder = source / fault.package.replace(".", "/")
    files = sorted(path for path in folder.rglob("*") if path.suffix in (".py", ".cu"))
    counts = {path: path.read_text(encoding="utf-8").count(fault.text) for path in files}
    found = {path: count for path, count in counts.items() if count}
    if list(found.values()) != [1]:
        places = ", ".join(f"{path.name} ({count})" for path, count in found.items()) or "nowhere"
        raise ValueError(
            f"{fault.name!r}: expected its text once in {fault.package}, it is in {places}: {fault.text!r}"
        )
    return next(iter(found))
