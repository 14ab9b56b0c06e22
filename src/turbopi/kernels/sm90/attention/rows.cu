// What attention does with rows of logits and of sums, which a warpgroup keeps as wgmma leaves them: a lane holds columns
// 2 (lane % 4) and the next one of each block of 8, in rows lane / 4 and lane / 4 + 8 of its warp's 16.

#if TP_OUT_FP8
typedef unsigned char Element;
#else
typedef u16 Element;
#endif
constexpr bool OUT_FP8 = TP_OUT_FP8;

// which of `wgs` warpgroups ends up with a block of 8 columns; blocks go in fours, as that many leave together
__device__ constexpr int owner(int block, int blocks, int wgs) { return block / 4 * wgs / ((blocks + 3) / 4); }

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

// Logits become weights, as wgmma's operand in registers wants them. What was added up before is to be multiplied by
// `shrink`, as the largest logit may have grown; `total` has been.
template <int KEYS>
__device__ __forceinline__ void weigh_rows(const float (&logits)[KEYS], float scale, float (&top)[2], float (&total)[2],
                                           float (&shrink)[2], u32 (&weights)[KEYS / 2]) {
#pragma unroll
    for (int half = 0; half < 2; ++half) {
        float best = top[half];
#pragma unroll
        for (int i = 0; i < KEYS; ++i)
            if (i / 2 % 2 == half) best = fmaxf(best, logits[i]);
        best = largest_of_quad(best);
        shrink[half] = power_of_two((top[half] - best) * scale);
        top[half] = best;
        total[half] *= shrink[half];
    }
#pragma unroll
    for (int i = 0; i < KEYS; i += 2) {
        const int half = i / 2 % 2;
        const float offset = top[half] * scale;
        const float x = power_of_two(fmaf(logits[i], scale, -offset));
        const float y = power_of_two(fmaf(logits[i + 1], scale, -offset));
        total[half] += x + y;
        weights[i / 2] = pack(x, y);
    }
}

// Of two warpgroups with the same rows and different keys, each gets the other's sums of its columns through `shared`,
// which nobody reads any more once both are here: by block and thread; behind them its tops and totals.
template <int BLOCKS>
constexpr int MOST_RECEIVED = ((BLOCKS + 3) / 4 + 1) / 2 * 4 * 2048;
template <int BLOCKS>
constexpr int RECEIVED = MOST_RECEIVED<BLOCKS> + 2048;
template <int SUMS>
__device__ __forceinline__ void join_rows(float (&sums)[SUMS], const float (&top)[2], float (&total)[2], float scale,
                                          char* shared, int warpgroup, int own) {
    constexpr int BLOCKS = SUMS / 4, MOST = MOST_RECEIVED<BLOCKS>, SHARE = RECEIVED<BLOCKS>;
    sync_consumers(1, 256);  // nobody reads tiles any more
#pragma unroll
    for (int to = 0; to < 2; ++to) {
        if (to == warpgroup) continue;
        float4* const there = (float4*)(shared + to * SHARE) + own;
        int count = 0;
#pragma unroll
        for (int j = 0; j < BLOCKS; ++j)
            if (owner(j, BLOCKS, 2) == to)
                there[128 * count++] = make_float4(sums[4 * j], sums[4 * j + 1], sums[4 * j + 2], sums[4 * j + 3]);
        there[MOST / 16] = make_float4(top[0], top[1], total[0], total[1]);
    }
    sync_consumers(1, 256);
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
            if (owner(j, BLOCKS, 2) != who) continue;
            const float4 x = received[128 * count++];
            sums[4 * j] = sums[4 * j] * mine[0] + x.x * theirs[0];
            sums[4 * j + 1] = sums[4 * j + 1] * mine[0] + x.y * theirs[0];
            sums[4 * j + 2] = sums[4 * j + 2] * mine[1] + x.z * theirs[1];
            sums[4 * j + 3] = sums[4 * j + 3] * mine[1] + x.w * theirs[1];
        }
    }
}

// Sums over their totals, those columns of them that are this warpgroup's; `to(half)` is where a row begins, `there(half)`
// whether there is one.
template <int SUMS, typename To, typename There>
__device__ __forceinline__ void store_rows(const float (&sums)[SUMS], const float (&total)[2], float inverse, int wgs,
                                           int warpgroup, int lane, To to_row, There there) {
    constexpr int BLOCKS = SUMS / 4;
#pragma unroll
    for (int half = 0; half < 2; ++half) {
        Element* const to = to_row(half);
        const float factor = (OUT_FP8 ? inverse : 1.0f) / total[half];
        auto value = [&](int j) -> u32 {
            const float x = sums[4 * j + 2 * half] * factor, y = sums[4 * j + 2 * half + 1] * factor;
            return OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
        };
#pragma unroll
        for (int j = 0; j + 3 < BLOCKS; j += 4) {
            if (owner(j, BLOCKS, wgs) != warpgroup) continue;
            const uint4 v = transpose_quad(value(j), value(j + 1), value(j + 2), value(j + 3), lane);
            if (there(half)) {
                Element* const here = to + (j + lane % 4) * 8;
                if (OUT_FP8) *(uint2*)here = make_uint2(v.x | v.y << 16, v.z | v.w << 16);
                else *(uint4*)here = v;
            }
        }
#pragma unroll
        for (int j = BLOCKS / 4 * 4; j < BLOCKS; ++j) {
            if (owner(j, BLOCKS, wgs) != warpgroup) continue;
            const u32 v = value(j);
            if (there(half)) {
                Element* const here = to + j * 8 + lane % 4 * 2;
                if (OUT_FP8) *(u16*)here = (u16)v;
                else *(u32*)here = v;
            }
        }
    }
}
