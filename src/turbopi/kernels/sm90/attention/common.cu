// What the attention kernels share: sizes of a tile, the ring that tiles pass through, their operands, weights of logits,
// results on their way out.
// kernel.py or suffix.py sets the TP_ constants and writes `mma_logits(float (&)[KEYS / 2], u64, u64, int keep)` and
// `mma_values(float (&)[DIM / 2], u32 * 4, u64, int keep)`.
//
// Numbers are kept as wgmma leaves them: a lane holds columns 2 (lane % 4) and the next one of each block of 8, in rows
// lane / 4 and lane / 4 + 8 of its warp's 16.

constexpr int WGS = TP_WGS, KEYS = TP_KEYS, STAGES = TP_STAGES, DIM = TP_DIM;
constexpr bool OUT_FP8 = TP_OUT_FP8;
#if TP_OUT_FP8
typedef unsigned char Element;
#else
typedef u16 Element;
#endif
constexpr int PANELS = (DIM + 63) / 64;  // of 64 columns, 128 bytes: as much as a swizzle spans
constexpr int ROW_BYTES = 128, KEY_PANEL = KEYS * ROW_BYTES, STAGE_BYTES = PANELS * KEY_PANEL;
constexpr int BLOCKS = DIM / 8, DEPTH = (DIM + 15) / 16, THREADS = 128 * WGS;
static_assert(DIM % 8 == 0 && 16 <= DIM && DIM <= 256, "columns that a product may have");
static_assert(KEYS % 16 == 0 && 16 <= KEYS && KEYS <= 256, "a product with values is 16 keys deep");
// Registers of a thread, when the producer has given away what it doesn't need
constexpr int PRODUCER_REGISTERS = WGS > 2 ? 24 : 40;
constexpr int CONSUMER_REGISTERS = WGS == 4 ? 112 : WGS == 3 ? 160 : WGS == 1 ? 240 : 232;
static_assert(1 <= WGS && WGS <= 4, "setmaxnreg waits for registers that a multiprocessor hasn't");

#define NONE __uint_as_float(0xff800000)  // -inf

// TP_OUT_INT8, beside TP_OUT_FP8: results of whole numbers. What they can't hold is marked: the first of `pitch` bfloat16
// numbers becomes NaN, of which there is a row for `of` rows of results; `first` is that of the warp's first row.
#if TP_OUT_INT8
struct Marks {
    u16* rows;
    int pitch, of;
    size_t first;
};
#define MARKS(first) Marks{marked, mark_pitch, marks_of, (size_t)(first)}
#else
struct Marks {};
#define MARKS(first) Marks{}
#endif

// 64 columns of some rows of one head
__device__ __forceinline__ void load(u32 to, const TensorMap* map, int column, int head, int row, u32 bar) {
    asm volatile(
        "cp.async.bulk.tensor.3d.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1, {%2, %3, %4}], [%5];"
        ::"r"(to), "l"(map), "r"(column), "r"(head), "r"(row), "r"(bar) : "memory");
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

// Tiles pass through STAGES slots of shared memory, each at its `place` in the order of all. Behind the slots are their
// barriers: a tile is there; all its readers, which are warpgroups, have released it.
struct Ring {
    static constexpr int BYTES = STAGES * (STAGE_BYTES + 16);
    u32 slots;

    __device__ __forceinline__ u32 slot(u32 place) const { return slots + place % STAGES * STAGE_BYTES; }
    __device__ __forceinline__ u32 full(u32 place) const { return slots + STAGES * STAGE_BYTES + place % STAGES * 8; }
    __device__ __forceinline__ u32 empty(u32 place) const { return full(place) + STAGES * 8; }

    __device__ __forceinline__ void init(int readers) const {
        for (int s = 0; s < STAGES; ++s) barrier_init(full(s), 1), barrier_init(empty(s), readers);
    }
    // For the producer: waits until the slot is free. What it loads there next is to tell `full`.
    __device__ __forceinline__ void claim(u32 place) const {
        if (place >= STAGES) barrier_wait(empty(place), (place / STAGES + 1) & 1);
        barrier_expect(full(place), STAGE_BYTES);
    }
    __device__ __forceinline__ void load_tile(u32 place, const TensorMap* map, int head, int row) const {
        claim(place);
        for (int p = 0; p < PANELS; ++p) load(slot(place) + p * KEY_PANEL, map, 64 * p, head, row, full(place));
    }
    // For readers
    __device__ __forceinline__ u32 await(u32 place) const {
        barrier_wait(full(place), (place / STAGES) & 1);
        return slot(place);
    }
    __device__ __forceinline__ void release(u32 place) const {
        if (threadIdx.x % 128 == 0) barrier_arrive(empty(place));
    }
};

// The products of a tile, as a group: of 64 queries, whose panels lie Q_PANEL bytes apart, with keys, and of their weights
// with values.
template <int Q_PANEL>
__device__ __forceinline__ void multiply_keys(float (&logits)[KEYS / 2], u32 queries, u32 keys) {
#pragma unroll
    for (int k = 0; k < DEPTH; ++k)
        mma_logits(logits, operand(queries + k / 4 * Q_PANEL + k % 4 * 32), operand(keys + k / 4 * KEY_PANEL + k % 4 * 32),
                   k > 0);
    commit_products();
}
__device__ __forceinline__ void multiply_values(float (&sums)[DIM / 2], const u32 (&weights)[KEYS / 4], u32 values) {
#pragma unroll
    for (int k = 0; k < KEYS / 16; ++k)
        mma_values(sums, weights[4 * k], weights[4 * k + 1], weights[4 * k + 2], weights[4 * k + 3],
                   operand_across(values + k * 16 * ROW_BYTES), 1);
    commit_products();
}

// Logits of keys from the `left`th of a tile on count for nothing.
__device__ __forceinline__ void hide(float (&logits)[KEYS / 2], int left) {
    const int lane = threadIdx.x % 32;
#pragma unroll
    for (int i = 0; i < KEYS / 2; ++i)
        if (i / 4 * 8 + lane % 4 * 2 + i % 2 >= left) logits[i] = NONE;
}
// Their values become 0, as 0 * NaN would be NaN; by so many threads. `show_to_products` must follow.
__device__ __forceinline__ void clear_rows(u32 values, int left, int threads) {
    const int first = left * (ROW_BYTES / 16), count = KEY_PANEL / 16 - first;
    for (int i = threadIdx.x % threads; i < PANELS * count; i += threads) {
        const u32 at = values + i / count * KEY_PANEL + (first + i % count) * 16;
        asm volatile("st.shared.v4.u32 [%0], {%1, %1, %1, %1};" ::"r"(at), "r"(0) : "memory");
    }
}
// What so many threads have stored in shared memory is there for products of any of them.
__device__ __forceinline__ void show_to_products(int barrier, int threads) {
    asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
    sync_consumers(barrier, threads);
}
// Registers that a product has written, once it has been awaited: the compiler is to read them after that.
template <int COUNT>
__device__ __forceinline__ void settle(float (&registers)[COUNT]) {
#pragma unroll
    for (int i = 0; i < COUNT; ++i) asm volatile("" : "+f"(registers[i])::"memory");
}

#define LOWEST __uint_as_float(0xff7fffff)  // of float32: a row's top before it sees a key; -inf - -inf would be NaN

// Of a lane's two rows, over tiles of keys: the largest logit so far, in powers of two, and the sum of weights. The sums of
// values are relative to it. The largest weight is 1, which bfloat16 has: a top that lags behind is less exact.
struct Softmax {
    float scale;  // of logits, in powers of two
    float top[2] = {LOWEST, LOWEST}, total[2] = {};

    // A tile's logits become weights. Sums of values that were made before are to be shrunk by what comes back, so that
    // they are relative to the new top: `shrink_sums`.
    __device__ __forceinline__ float2 weigh(float (&logits)[KEYS / 2]) {
        float shrink[2];
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            float best = NONE;
#pragma unroll
            for (int i = 0; i < KEYS / 2; ++i)
                if (i / 2 % 2 == half) best = fmaxf(best, logits[i]);
            const float before = top[half];
            top[half] = fmaxf(before, largest_of_quad(best) * scale);
            shrink[half] = power_of_two(before - top[half]);  // exactly 1 where the top stays
            total[half] *= shrink[half];
        }
#pragma unroll
        for (int i = 0; i < KEYS / 2; i += 2) {
            const int half = i / 2 % 2;
            logits[i] = power_of_two(fmaf(logits[i], scale, -top[half]));
            logits[i + 1] = power_of_two(fmaf(logits[i + 1], scale, -top[half]));
            total[half] += logits[i] + logits[i + 1];
        }
        return make_float2(shrink[0], shrink[1]);
    }

    // Totals of whole rows.
    __device__ __forceinline__ void end() {
        total[0] = sum_of_quad(total[0]), total[1] = sum_of_quad(total[1]);
    }
};

// Weights as wgmma's operand in registers wants them. Only when no product is on its way: otherwise ptxas makes each one
// wait for the one before.
__device__ __forceinline__ void round_weights(const float (&logits)[KEYS / 2], u32 (&weights)[KEYS / 4]) {
#pragma unroll
    for (int i = 0; i < KEYS / 4; ++i) weights[i] = pack(logits[2 * i], logits[2 * i + 1]);
}
__device__ __forceinline__ void shrink_sums(float (&sums)[DIM / 2], float2 by) {
#pragma unroll
    for (int i = 0; i < DIM / 2; ++i) sums[i] *= i / 2 % 2 ? by.y : by.x;
}
// Whether any row of the warp has a new top. NaN, too, is to reach the sums.
__device__ __forceinline__ bool any_shrinks(float2 by) { return __any_sync(~0u, by.x != 1 || by.y != 1); }

// Rows' sums of values in the columns of blocks that are `mine`, over their totals, to `out`, which points to the first of
// the warp's 16 rows; `pitch` numbers from row to row. Rows from `there` on aren't written.
template <typename Mine>
__device__ __forceinline__ void store_rows(
    const float (&sums)[DIM / 2], const float (&total)[2], float inverse, Element* out, size_t pitch, int there, Mine mine,
    Marks marks) {
    const int lane = threadIdx.x % 32;
#pragma unroll
    for (int half = 0; half < 2; ++half) {
        const int at = lane / 4 + half * 8;
        Element* const to = out + at * pitch;
        const float factor = (OUT_FP8 ? inverse : 1.0f) / total[half];
#if TP_OUT_INT8
        bool damaged = false;
#endif
        auto value = [&](int j) -> u32 {
            const float x = sums[4 * j + 2 * half] * factor, y = sums[4 * j + 2 * half + 1] * factor;
#if TP_OUT_INT8
            damaged |= !(fabsf(x) < -NONE && fabsf(y) < -NONE);
            return pack_int8(x, y);
#endif
            return OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
        };
#pragma unroll
        for (int j = 0; j + 3 < BLOCKS; j += 4) {
            if (!mine(j)) continue;
            const uint4 v = transpose_quad(value(j), value(j + 1), value(j + 2), value(j + 3), lane);
            if (at < there) {
                Element* const here = to + (j + lane % 4) * 8;
                if (OUT_FP8) *(uint2*)here = make_uint2(v.x | v.y << 16, v.z | v.w << 16);
                else *(uint4*)here = v;
            }
        }
#pragma unroll
        for (int j = BLOCKS / 4 * 4; j < BLOCKS; ++j) {
            if (!mine(j)) continue;
            const u32 v = value(j);
            if (at < there) {
                Element* const here = to + j * 8 + lane % 4 * 2;
                if (OUT_FP8) *(u16*)here = (u16)v;
                else *(u32*)here = v;
            }
        }
#if TP_OUT_INT8
        if (damaged && at < there) marks.rows[(marks.first + at) / marks.of * marks.pitch] = 0x7fff;
#endif
    }
}
