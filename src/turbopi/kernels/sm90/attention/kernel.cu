// out = softmax(scale * q @ k^T) @ v in bfloat16 with float32 logits and sums, over the first `length` keys: TMA feeds
// shared memory, wgmma multiplies. For compute capability 9.0. kernel.py sets the TP_ constants and writes
// `mma_logits` and `mma_values` for the tile's widths.
//
// q, k and v are columns of matrices [rows, heads, TP_DIM] (possibly of one and the same): heads of q begin at column
// block 0, those of k at `k_first`, of v at `v_first`. In every one of gridDim.x / tiles groups, a head of a picture or
// of all there is, `rows` rows of q see `keys` rows of k and v; one query head has one head of keys.
//
// TP_SHARING CTAs of one group form a cluster: each loads a share of every tile of keys and values into all of them.
// All tiles must have room then, as nobody waits for the others to free a slot.
//
// TP_PACKED: rows of several groups follow each other, and `segments` says of each CTA's rows which keys they see: see
// `kernels.interface.Segments`.
//
// TP_WHOLE: there are KEYS keys for each warpgroup and no length, so that nothing is decided while it runs.
//
// A CTA has 64 rows of q, a producer warp and TP_WGS consumer warpgroups, which take tiles of TP_KEYS keys in turn: one
// multiplies while another weighs. In the end each gets the others' sums of a share of the columns.
//
// Numbers are kept as wgmma leaves them: a lane holds columns 2 (lane % 4) and the next one of each block of 8, in rows
// lane / 4 and lane / 4 + 8 of its warp's 16.

constexpr int WGS = TP_WGS, KEYS = TP_KEYS, STAGES = TP_STAGES, DIM = TP_DIM, SHARING = TP_SHARING;
constexpr bool OUT_FP8 = TP_OUT_FP8, WHOLE = TP_WHOLE, PACKED = TP_PACKED;
#if TP_OUT_FP8
typedef unsigned char Element;
#else
typedef u16 Element;
#endif
constexpr int PANELS = (DIM + 63) / 64;  // of 64 columns, 128 bytes: as much as a swizzle spans
constexpr int ROW_BYTES = 128, Q_PANEL = 64 * ROW_BYTES, KEY_PANEL = KEYS * ROW_BYTES;
constexpr int Q_BYTES = PANELS * Q_PANEL, STAGE_BYTES = PANELS * KEY_PANEL;
constexpr int BLOCKS = DIM / 8, FOURS = (BLOCKS + 3) / 4, DEPTH = (DIM + 15) / 16, THREADS = 128 * WGS;
static_assert(STAGES >= 2 * WGS, "a warpgroup would wait for a slot that it holds");
constexpr int CONSUMER_REGISTERS = WGS == 1 ? 240 : 232, PRODUCER_REGISTERS = 40;
// which warpgroup ends up with a block of 8 columns; blocks go in fours, as that many leave together
__device__ constexpr int owner(int block) { return block / 4 * WGS / FOURS; }

// Generated: mma_logits(float (&)[KEYS / 2], u64, u64, int keep), mma_values(float (&)[DIM / 2], u32 * 4, u64, int keep),
// and the kernel's parameters.

// 64 columns of 64 or KEYS rows of one head
__device__ __forceinline__ void load(u32 to, const TensorMap* map, int column, int head, int row, u32 bar) {
    asm volatile(
        "cp.async.bulk.tensor.3d.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1, {%2, %3, %4}], [%5];"
        ::"r"(to), "l"(map), "r"(column), "r"(head), "r"(row), "r"(bar) : "memory");
}
// into all CTAs of the cluster, at the same place in each
__device__ __forceinline__ void load_into_all(u32 to, const TensorMap* map, int column, int head, int row, u32 bar) {
    asm volatile(
        "cp.async.bulk.tensor.3d.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster"
        " [%0], [%1, {%2, %3, %4}], [%5], %6;"
        ::"r"(to), "l"(map), "r"(column), "r"(head), "r"(row), "r"(bar), "h"((u16)((1 << SHARING) - 1)) : "memory");
}
// rows of 128 bytes, swizzled, columns of the product along the row; panels of 64 of them lie KEY_PANEL bytes apart
__device__ __forceinline__ u64 operand_across(u32 address) {
    return ((u64)(address & 0x3ffff) >> 4) | ((u64)(KEY_PANEL >> 4) << 16) | (64ull << 32) | (1ull << 62);
}
__device__ __forceinline__ float power_of_two(float x) {
    float y;
    asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
__device__ __forceinline__ float largest_of_quad(float x) {
    x = fmaxf(x, __shfl_xor_sync(~0u, x, 1));
    return fmaxf(x, __shfl_xor_sync(~0u, x, 2));
}

__device__ __forceinline__ void sync_consumers(int barrier, int threads) {
    asm volatile("bar.sync %0, %1;" ::"r"(barrier), "r"(threads) : "memory");
}

extern "C" __global__ void __launch_bounds__(128 * (WGS + 1), 1)
attention(ATTENTION_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024, ring = base + Q_BYTES;
    const u32 q_full = ring + STAGES * STAGE_BYTES, full = q_full + 8, empty = full + 8 * STAGES;
    const int warpgroup = __shfl_sync(~0u, threadIdx.x / 128, 0);  // the same for all, as the compiler now sees

    if (threadIdx.x == THREADS) {
        asm volatile("prefetch.tensormap [%0];\nprefetch.tensormap [%1];\nprefetch.tensormap [%2];"
                     ::"l"(&map_q), "l"(&map_k), "l"(&map_v));
    }
    if (threadIdx.x == 0) {
        barrier_init(q_full, 1);
        for (int s = 0; s < STAGES; ++s) barrier_init(full + 8 * s, 1), barrier_init(empty + 8 * s, 1);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
    if (SHARING > 1) cluster_sync();
    else __syncthreads();
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
    // who loads nothing and asks for no length begins when something is there, so what is behind the wait
    if (!WHOLE) asm volatile("griddepcontrol.wait;" ::: "memory");

    const int series = quotient(blockIdx.x, tiles), group = quotient(series, heads), head = series - group * heads;
    const int4 segment = PACKED ? segments[blockIdx.x] : make_int4((blockIdx.x - series * tiles) * 64, rows, 0, 0);
    const int row = segment.x, end_of_rows = segment.y;  // in its group
    if (PACKED && row >= end_of_rows) return;

    // Tiles pass through the ring in rounds: one of keys for each warpgroup, then their values. Each warpgroup's first
    // keys, up to `early`, are loaded and multiplied before the length is known.
    const int early = WHOLE ? WGS : min((keys + KEYS - 1) / KEYS, WGS);
    auto place_of_keys = [](int tile) { return tile / WGS * 2 * WGS + tile % WGS; };

    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        if (threadIdx.x == THREADS) {
            auto load_tile = [&](const TensorMap* map, int first, int tile, int place) {
                const u32 s = place % STAGES;
                if (place >= STAGES) barrier_wait(empty + 8 * s, (place / STAGES + 1) & 1);
                barrier_expect(full + 8 * s, STAGE_BYTES);
                const int part = blockIdx.x % SHARING, from = group * keys + segment.z + tile * KEYS + part * (KEYS / SHARING);
                for (int p = 0; p < PANELS; ++p) {
                    const u32 to = ring + s * STAGE_BYTES + p * KEY_PANEL + part * (KEY_PANEL / SHARING);
                    if (SHARING > 1) load_into_all(to, map, 64 * p, first + head, from, full + 8 * s);
                    else load(to, map, 64 * p, first + head, from, full + 8 * s);
                }
            };
            if (WHOLE) asm volatile("griddepcontrol.wait;" ::: "memory");
            barrier_expect(q_full, Q_BYTES);
            for (int p = 0; p < PANELS; ++p)
                load(base + p * Q_PANEL, &map_q, 64 * p, head, group * rows + row, q_full);
            for (int tile = 0; tile < early; ++tile) load_tile(&map_k, k_first, tile, place_of_keys(tile));
            const int valid = WHOLE ? WGS * KEYS : PACKED ? segment.w : length ? (int)*length : keys;
        const int last = (valid + KEYS - 1) / KEYS;
#pragma unroll 1
            for (int round = 0; round < last; round += WGS) {
                const int end = min(round + WGS, last);
                for (int tile = max(round, early); tile < end; ++tile)
                    load_tile(&map_k, k_first, tile, place_of_keys(tile));
                for (int tile = round; tile < end; ++tile)
                    load_tile(&map_v, v_first, tile, place_of_keys(tile) + WGS);
            }
        }
    } else {
        asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
        const int lane = threadIdx.x % 32, own = threadIdx.x % 128, warp = own / 32;
        const int valid = WHOLE ? WGS * KEYS : PACKED ? segment.w : length ? (int)*length : keys;
        const int last = (valid + KEYS - 1) / KEYS;
        const float none = __uint_as_float(0xff800000);  // -inf
        float logits[KEYS / 2], sums[DIM / 2] = {};      // of the values, by weight
        float top[2] = {none, none}, total[2] = {};
        u32 weights[KEYS / 4];  // as wgmma's operand in registers wants them
        auto await_tile = [&](int place) {
            if (WHOLE) __builtin_assume(place < STAGES);
            barrier_wait(full + 8 * (place % STAGES), (place / STAGES) & 1);
            return ring + place % STAGES * STAGE_BYTES;
        };
        auto release = [&](int place) {
            if (own == 0) barrier_arrive(empty + 8 * (place % STAGES));
        };
        auto multiply_keys = [&](u32 tile) {
#pragma unroll
            for (int k = 0; k < DEPTH; ++k)
                mma_logits(logits, operand(base + k / 4 * Q_PANEL + k % 4 * 32),
                           operand(tile + k / 4 * KEY_PANEL + k % 4 * 32), k > 0);
            commit_products();
        };
        auto multiply_values = [&](u32 values) {
#pragma unroll
            for (int k = 0; k < KEYS / 16; ++k)
                mma_values(sums, weights[4 * k], weights[4 * k + 1], weights[4 * k + 2], weights[4 * k + 3],
                           operand_across(values + k * 16 * ROW_BYTES), 1);
            commit_products();
        };
        // the tile's logits become weights, the sums follow the new top; values beyond the length become 0
        auto weigh = [&](int tile, u32 values) {
            const int left = valid - tile * KEYS;
            if (!WHOLE && left < KEYS) {
#pragma unroll
                for (int i = 0; i < KEYS / 2; ++i)
                    if (i / 4 * 8 + lane % 4 * 2 + i % 2 >= left) logits[i] = none;
            }
            float shrink[2];
#pragma unroll
            for (int half = 0; half < 2; ++half) {
                float best = top[half];
#pragma unroll
                for (int i = 0; i < KEYS / 2; ++i)
                    if (i / 2 % 2 == half) best = fmaxf(best, logits[i]);
                best = largest_of_quad(best);
                shrink[half] = power_of_two((top[half] - best) * scale);
                top[half] = best;
                total[half] *= shrink[half];
            }
#pragma unroll
            for (int i = 0; i < KEYS / 2; i += 2) {
                const int half = i / 2 % 2;
                const float offset = top[half] * scale;
                const float x = power_of_two(fmaf(logits[i], scale, -offset));
                const float y = power_of_two(fmaf(logits[i + 1], scale, -offset));
                total[half] += x + y;
                weights[i / 2] = pack(x, y);
            }
            if (!WHOLE) {
#pragma unroll
                for (int i = 0; i < DIM / 2; ++i) sums[i] *= shrink[i / 2 % 2];
            }
            if (!WHOLE && left < KEYS) {  // 0 * NaN would be NaN
                const int first = left * (ROW_BYTES / 16), count = KEY_PANEL / 16 - first;
                for (int i = own; i < PANELS * count; i += 128) {
                    const u32 at = values + i / count * KEY_PANEL + (first + i % count) * 16;
                    asm volatile("st.shared.v4.u32 [%0], {%1, %1, %1, %1};" ::"r"(at), "r"(0) : "memory");
                }
                asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
                sync_consumers(2 + warpgroup, 128);
            }
        };

        barrier_wait(q_full, 0);
        int tile = warpgroup, place = place_of_keys(tile);
        if (WHOLE || tile < early) {  // also where the length ends before it: its place is used again in the end
            const u32 first = await_tile(place);
            begin_products();
            multiply_keys(first);
            await_products<0>();
            release(place);
        }
        if (WHOLE || tile < last) {
            for (; !WHOLE && tile + WGS < last; tile += WGS, place += 2 * WGS) {
                const u32 values = await_tile(place + WGS);
                weigh(tile, values);
                const u32 next = await_tile(place + 2 * WGS);
                begin_products();
                multiply_values(values);
                multiply_keys(next);
                await_products<0>();
                release(place + WGS);
                release(place + 2 * WGS);
            }
            const u32 values = await_tile(place + WGS);
            weigh(tile, values);
            begin_products();
            multiply_values(values);
            await_products<0>();
        }
#pragma unroll
        for (int half = 0; half < 2; ++half) total[half] = sum_of_quad(total[half]);

#if TP_WGS == 2
        // the other's sums of this warpgroup's columns, by block and thread; behind them its tops and totals
        constexpr int MOST = (FOURS + 1) / 2 * 4 * 2048, SHARE = MOST + 2048;
        static_assert(2 * SHARE <= Q_BYTES + STAGES * STAGE_BYTES, "no room for the other's sums");
        char* const shared = raw + (base - shared_address(raw));
        sync_consumers(1, THREADS);  // nobody reads tiles any more
#pragma unroll
        for (int to = 0; to < 2; ++to) {
            if (to == warpgroup) continue;
            float4* const there = (float4*)(shared + to * SHARE) + own;
            int count = 0;
#pragma unroll
            for (int j = 0; j < BLOCKS; ++j)
                if (owner(j) == to)
                    there[128 * count++] = make_float4(sums[4 * j], sums[4 * j + 1], sums[4 * j + 2], sums[4 * j + 3]);
            there[MOST / 16] = make_float4(top[0], top[1], total[0], total[1]);
        }
        sync_consumers(1, THREADS);
        const float4* const received = (const float4*)(shared + warpgroup * SHARE) + own;
        const float4 other = received[MOST / 16];
        float mine[2], theirs[2];
#pragma unroll
        for (int half = 0; half < 2; ++half) {  // 2^-inf is 0: who had no keys counts for nothing
            const float other_top = half ? other.y : other.x, best = fmaxf(top[half], other_top);
            mine[half] = power_of_two((top[half] - best) * scale);
            theirs[half] = power_of_two((other_top - best) * scale);
            total[half] = total[half] * mine[half] + (half ? other.w : other.z) * theirs[half];
        }
#pragma unroll
        for (int who = 0; who < 2; ++who) {
            if (who != warpgroup) continue;
            int count = 0;
#pragma unroll
            for (int j = 0; j < BLOCKS; ++j) {
                if (owner(j) != who) continue;
                const float4 x = received[128 * count++];
                sums[4 * j] = sums[4 * j] * mine[0] + x.x * theirs[0];
                sums[4 * j + 1] = sums[4 * j + 1] * mine[0] + x.y * theirs[0];
                sums[4 * j + 2] = sums[4 * j + 2] * mine[1] + x.z * theirs[1];
                sums[4 * j + 3] = sums[4 * j + 3] * mine[1] + x.w * theirs[1];
            }
        }
#endif

#pragma unroll
        for (int half = 0; half < 2; ++half) {
            const int at = row + warp * 16 + lane / 4 + half * 8;
            Element* const to = out + ((size_t)(group * rows + at) * heads + head) * DIM;
            const float factor = (OUT_FP8 ? inverse : 1.0f) / total[half];
            auto value = [&](int j) -> u32 {
                const float x = sums[4 * j + 2 * half] * factor, y = sums[4 * j + 2 * half + 1] * factor;
                return OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
            };
#pragma unroll
            for (int j = 0; j + 3 < BLOCKS; j += 4) {
                if (owner(j) != warpgroup) continue;
                const uint4 v = transpose_quad(value(j), value(j + 1), value(j + 2), value(j + 3), lane);
                if (at < end_of_rows) {
                    Element* const here = to + (j + lane % 4) * 8;
                    if (OUT_FP8) *(uint2*)here = make_uint2(v.x | v.y << 16, v.z | v.w << 16);
                    else *(uint4*)here = v;
                }
            }
#pragma unroll
            for (int j = BLOCKS / 4 * 4; j < BLOCKS; ++j) {
                if (owner(j) != warpgroup) continue;
                const u32 v = value(j);
                if (at < end_of_rows) {
                    Element* const here = to + j * 8 + lane % 4 * 2;
                    if (OUT_FP8) *(u16*)here = (u16)v;
                    else *(u32*)here = v;
                }
            }
        }
    }
    if (SHARING > 1) cluster_sync();  // what this CTA loads for the others may still be on its way
}
