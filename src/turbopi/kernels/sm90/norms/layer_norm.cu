// out[M, WIDTH] = LayerNorm(x) * weight + bias, or of x + y, which is then stored in `sum`: a warp for each row, so that
// nobody waits for another warp. The kernel before this one may still run when it starts; only weights and biases are
// read before its end. layer_norm.py sets the TP_ constants.
//
// TP_HAS_Y: there is y to add; the sum is rounded to bfloat16 before it is normed. TP_FP8: the result leaves as E4M3,
// times `inverse`.

constexpr int WIDTH = TP_WIDTH, CHUNKS = WIDTH / 8, EACH = (CHUNKS + 31) / 32;  // of 8 numbers: of a row, of a lane
static_assert(WIDTH % 8 == 0, "rows are whole chunks");

__device__ __forceinline__ bool inside(int chunk) { return CHUNKS % 32 == 0 || chunk < CHUNKS; }
__device__ __forceinline__ float number(const uint4& chunk, int i) {  // 0 to 7
    const u32 pair = i / 2 == 0 ? chunk.x : i / 2 == 1 ? chunk.y : i / 2 == 2 ? chunk.z : chunk.w;
    return i % 2 ? bf16_high(pair) : bf16_low(pair);
}
__device__ __forceinline__ u32 sum_of_pairs(u32 a, u32 b) {
    return pack(bf16_low(a) + bf16_low(b), bf16_high(a) + bf16_high(b));
}
__device__ __forceinline__ float sum_of_warp(float x) {
#pragma unroll
    for (int by = 16; by; by /= 2) x += __shfl_xor_sync(~0u, x, by);
    return x;
}

extern "C" __global__ void __launch_bounds__(TP_THREADS)
layer_norm(NORM_PARAMETERS) {
    const int lane = threadIdx.x % 32, row = blockIdx.x * (TP_THREADS / 32) + threadIdx.x / 32;
    asm volatile("griddepcontrol.launch_dependents;");
    uint4 weights[EACH], biases[EACH];
#pragma unroll
    for (int i = 0; i < EACH; ++i)
        if (inside(lane + 32 * i)) weights[i] = weight[lane + 32 * i], biases[i] = bias[lane + 32 * i];
    asm volatile("griddepcontrol.wait;" ::: "memory");
    if (row >= M) return;

    uint4 chunks[EACH];
#pragma unroll
    for (int i = 0; i < EACH; ++i)
        chunks[i] = inside(lane + 32 * i) ? x[(size_t)row * CHUNKS + lane + 32 * i] : make_uint4(0, 0, 0, 0);
#if TP_HAS_Y
#pragma unroll
    for (int i = 0; i < EACH; ++i) {
        if (!inside(lane + 32 * i)) continue;
        const uint4 a = chunks[i], b = y[(size_t)row * CHUNKS + lane + 32 * i];
        chunks[i] = make_uint4(sum_of_pairs(a.x, b.x), sum_of_pairs(a.y, b.y), sum_of_pairs(a.z, b.z),
                               sum_of_pairs(a.w, b.w));
        sum[(size_t)row * CHUNKS + lane + 32 * i] = chunks[i];
    }
#endif
    float total = 0.0f, squares = 0.0f;
#pragma unroll
    for (int i = 0; i < 8 * EACH; ++i) total += number(chunks[i / 8], i % 8);
    const float mean = sum_of_warp(total) / WIDTH;
#pragma unroll
    for (int i = 0; i < 8 * EACH; ++i) {
        const float off = number(chunks[i / 8], i % 8) - mean;
        if (inside(lane + 32 * (i / 8))) squares = fmaf(off, off, squares);
    }
    const float factor = rsqrtf(sum_of_warp(squares) / WIDTH + eps);
#pragma unroll
    for (int i = 0; i < EACH; ++i) {
        if (!inside(lane + 32 * i)) continue;
        float r[8];
#pragma unroll
        for (int j = 0; j < 8; ++j) {
            r[j] = fmaf((number(chunks[i], j) - mean) * factor, number(weights[i], j), number(biases[i], j));
            if (TP_FP8) r[j] *= inverse;
        }
        const size_t place = (size_t)row * CHUNKS + lane + 32 * i;
#if TP_FP8
        out[place] = make_uint2(pack_e4m3(r[0], r[1]) | pack_e4m3(r[2], r[3]) << 16,
                                pack_e4m3(r[4], r[5]) | pack_e4m3(r[6], r[7]) << 16);
#else
        out[place] = make_uint4(pack(r[0], r[1]), pack(r[2], r[3]), pack(r[4], r[5]), pack(r[6], r[7]));
#endif
    }
}
