// What both kernels of suffixes share: RoPE of queries and keys on their way to operands, results sent within a cluster.
// suffix.py puts it behind common.cu.

constexpr int ROWS = TP_ROWS, RANKS = TP_RANKS, HALF = DIM / 2, CHUNKS = HALF / 8;  // CHUNKS: of 8 columns of half a head

// An operand's 16 bytes of row `row` from column `column` on; its panels of 64 columns lie `panel` bytes apart.
__device__ __forceinline__ u32 place_of(u32 operand, int panel, int row, int column) {
    return operand + column / 64 * panel + row * ROW_BYTES + ((column % 64 / 8) ^ (row % 8)) * 16;
}
__device__ __forceinline__ void put(u32 to, uint4 v) {
    asm volatile("st.shared.v4.u32 [%0], {%1, %2, %3, %4};" ::"r"(to), "r"(v.x), "r"(v.y), "r"(v.z), "r"(v.w) : "memory");
}
__device__ __forceinline__ void send_end(u32 to, float top, float total, u32 bar) {
    asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v2.b32 [%0], {%1, %2}, [%3];"
                 ::"r"(to), "r"(__float_as_uint(top)), "r"(__float_as_uint(total)), "r"(bar) : "memory");
}
__device__ __forceinline__ float inverse_of(float x) {  // without a division's branches
    float y;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
    return y;
}
// Columns 8 c to 8 c + 7 of a head and those HALF further, with their angles: loaded, and after RoPE in an operand's row.
struct Turn {
    uint4 low, high;
    float4 cosines[2], sines[2];

    __device__ __forceinline__ void load(const u16* head, int c) {
        low = *(const uint4*)(head + 8 * c), high = *(const uint4*)(head + HALF + 8 * c);
    }
    __device__ __forceinline__ void load_angles(const float* cos, const float* sin, int c) {
#pragma unroll
        for (int i = 0; i < 2; ++i)
            cosines[i] = *(const float4*)(cos + 8 * c + 4 * i), sines[i] = *(const float4*)(sin + 8 * c + 4 * i);
    }
    __device__ __forceinline__ void put_turned(u32 operand, int panel, int row, int c) const {
        const u32 a[4] = {low.x, low.y, low.z, low.w}, b[4] = {high.x, high.y, high.z, high.w};
        u32 first[4], second[4];
#pragma unroll
        for (int i = 0; i < 4; ++i) {
            const float4 cs = cosines[i / 2], sn = sines[i / 2];
            const float c0 = i % 2 ? cs.z : cs.x, c1 = i % 2 ? cs.w : cs.y, s0 = i % 2 ? sn.z : sn.x, s1 = i % 2 ? sn.w : sn.y;
            const float x0 = bf16_low(a[i]), x1 = bf16_high(a[i]), y0 = bf16_low(b[i]), y1 = bf16_high(b[i]);
            first[i] = pack(x0 * c0 - y0 * s0, x1 * c1 - y1 * s1);
            second[i] = pack(y0 * c0 + x0 * s0, y1 * c1 + x1 * s1);
        }
        put(place_of(operand, panel, row, 8 * c), make_uint4(first[0], first[1], first[2], first[3]));
        put(place_of(operand, panel, row, HALF + 8 * c), make_uint4(second[0], second[1], second[2], second[3]));
    }
};

// 8 columns of a row, which all ranks have sent: `parts`, `pitch` bytes from rank to rank, over their totals; `ends`, `end_pitch`
// apart, have the row's largest logit and its total.
__device__ __forceinline__ void add_ranks(
    Element* to, const char* parts, int pitch, const float2* ends, int end_pitch, float inverse) {
    float best = ends[0].x, whole = 0, result[8] = {};
#pragma unroll
    for (int r = 1; r < RANKS; ++r) best = fmaxf(best, ends[r * end_pitch].x);
#pragma unroll
    for (int r = 0; r < RANKS; ++r) {
        const float part = power_of_two(ends[r * end_pitch].x - best) * ends[r * end_pitch].y;  // 0 of a rank without keys
        const uint4 v = *(const uint4*)(parts + r * pitch);
        const u32 pairs[4] = {v.x, v.y, v.z, v.w};
        whole += part;
#pragma unroll
        for (int k = 0; k < 4; ++k) {
            result[2 * k] += part * bf16_low(pairs[k]);
            result[2 * k + 1] += part * bf16_high(pairs[k]);
        }
    }
    const float factor = (OUT_FP8 ? inverse : 1.0f) * inverse_of(whole);
    u32 pairs[4];
#pragma unroll
    for (int k = 0; k < 4; ++k) {
        const float x = result[2 * k] * factor, y = result[2 * k + 1] * factor;
        pairs[k] = OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
    }
    if (OUT_FP8) *(uint2*)to = make_uint2(pairs[0] | pairs[1] << 16, pairs[2] | pairs[3] << 16);
    else *(uint4*)to = make_uint4(pairs[0], pairs[1], pairs[2], pairs[3]);
}
