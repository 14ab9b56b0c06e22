// out[M, N] = epilogue(a[M, K] @ w[N, K]^T) in bfloat16 with float32 sums: TMA feeds shared memory, wgmma multiplies.
// For compute capability 9.0. bf16.py sets the TP_ constants and writes `mma` for the tile's width.
//
// TP_FP8: a and w are E4M3; `scale` (of each output channel, times the input's) multiplies the sums before bias and
// nonlinearity. The tensor cores keep only some 14 bits of sums of E4M3 products: after every TP_PROMOTE blocks of K
// (0: never) they are added up in float32 registers. TP_OUT_FP8: the result leaves as E4M3, times `inverse`.
//
// A CTA has two producer warps and TP_WGS consumer warpgroups of 64 rows each, and walks over its tiles (grid = CTAs that
// the GPU holds at once, not tiles), so the next tile's loads run during an epilogue. TP_CM x TP_CN CTAs form a cluster
// of neighbouring tiles: those of a row share their part of `a` and those of a column theirs of `w`; each loads its share
// of it into all of them, as reading operands from L2 would be the bottleneck.
// Weights don't depend on the kernel before this one: one thread loads them, as far ahead as there is room, while
// another waits for that kernel's end to load `a`.
//
// Epilogues: 0 plain, 1 + bias, 2 gelu(+ bias), 3 GeGLU (w has N gate rows, then N up rows), 4 float32 sums of a part
// of K each (+ bias in the first) as out[split, M, N], 5 the same in bfloat16, without a bias, 6 + bias, rounded and added
// to what is in `out`, the residual stream: the L2 cache adds, so nobody waits for what was there.
//
// TP_INT8, beside TP_FP8: both are whole numbers instead, their sums exact. TP_MARKS: where the result can't hold that it
// isn't finite, the row's first number in `marked`, rows of `mark_pitch` bfloat16 numbers, becomes NaN.
//
// TP_GATHER: the CTAs that share a tile, each with a part of K, are in one cluster. In the end each gets the others'
// sums of a share of the tile's columns through distributed shared memory. For one tile a CTA: without TP_APART they go
// where operands were.
//
// LayerNorm between two products without a pass of its own: TP_RESIDUAL adds `residual` [M, N] to the result, and the
// sum of each row's results and of their squares goes, by tile, to `sums_out`. TP_NORMED (parts of a row's sums, or 0)
// takes a's LayerNorm for a, whose scale is in w and whose shift in `offset`: as the product is linear, the norm is
// only made of the sums in the end. `sums_of_w` are of the rounded w, so a mean in a's rows cancels, however large.
//
// The same where the product behind is of E4M3 numbers: TP_COPY (parts of the residual's row sums, or 0) also rounds
// the result to E4M3 as if the residual's mean and variance were its own, and `sums_out` are of the result in these
// units, `plain_sums` of the result itself, as the next copy's units. They are close, so it is as good an E4M3 copy as
// the norm's would be; TP_NORMED then makes up for the difference, in which w times the shift is in `offset`, as it is
// in the copy already, and the bias goes apart.
//
// `ahead`: what this kernel's last loads are followed by into L2, the next one's weights, `ahead_bytes` a CTA.
// TP_OVERLAP: see overlap.cu.

constexpr int WGS = TP_WGS, BN = TP_BN, STAGES = TP_STAGES, CM = TP_CM, CN = TP_CN, SPLITS = TP_SPLITS;
constexpr bool GATHER = TP_GATHER;
#define TP_ROW_PARTS (TP_NORMED + TP_COPY)
constexpr int EPILOGUE = TP_EPILOGUE, PARTS = EPILOGUE == 3 ? 2 : 1;
constexpr int SHARING = CM * CN, CLUSTER = SHARING * (GATHER ? SPLITS : 1);
constexpr bool FP8 = TP_FP8, OUT_FP8 = TP_OUT_FP8;
static_assert(!TP_INT8 || (TP_FP8 && !TP_PROMOTE && !TP_OVERLAP && !TP_NORMED && !TP_COPY && !TP_RESIDUAL), "INT8");
#define INFINITE __uint_as_float(0x7f800000)
#if TP_INT8
typedef int Sum;
#else
typedef float Sum;
#endif
static_assert(!(TP_COPY && TP_NORMED) && !(TP_COPY && TP_OUT_FP8), "copies leave beside a bfloat16 stream");
#if TP_OUT_FP8
typedef unsigned char Element;
#else
typedef u16 Element;
#endif
constexpr int ROW_BYTES = 128;  // of a block of an operand: as much as a swizzle spans
constexpr int BM = 64 * WGS, BK = FP8 ? ROW_BYTES : ROW_BYTES / 2, TILE_N = BN / PARTS;
constexpr int A_BYTES = BM * ROW_BYTES, B_BYTES = BN * ROW_BYTES, STAGE_BYTES = A_BYTES + B_BYTES;
// Loads asked for together share a multiprocessor's bandwidth: the first would come as late as the last. So until the
// ring has been full once, `a` is loaded LEAD steps ahead of what has come, and w, which may have nothing to wait for,
// a step every PACE cycles at least. Smaller steps than these come too slowly so: 256 rows took 0.05 ms more.
constexpr bool PACED = STAGE_BYTES >= 28 * 1024;
constexpr int LEAD = 2;
constexpr u32 PACE = 250;
constexpr bool BIASED = !FP8 && !TP_NORMED &&  // E4M3: see Factors
                        (EPILOGUE == 1 || EPILOGUE == 2 || EPILOGUE == 4 || EPILOGUE == 6);
// TP_LEAVES_ROOM: a CTA has half of a multiprocessor's registers, so that one of the next kernel may start beside it.
static_assert(!TP_LEAVES_ROOM || WGS == 1, "more warpgroups need more registers");
constexpr int CONSUMER_REGISTERS = TP_LEAVES_ROOM ? 208 : WGS == 1 ? 240 : WGS == 2 ? 232 : 160;
constexpr int PRODUCER_REGISTERS = WGS == 1 ? 40 : WGS == 2 ? 40 : 24;

// into the CTAs of `mask`, at the same place in each
template <bool MULTICAST>
__device__ __forceinline__ void load(u32 to, const TensorMap* map, int k, int row, u32 bar, u32 mask) {
    if (MULTICAST)
        asm volatile(
            "cp.async.bulk.tensor.2d.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster"
            " [%0], [%1, {%2, %3}], [%4], %5;"
            ::"r"(to), "l"(map), "r"(k), "r"(row), "r"(bar), "h"((u16)mask) : "memory");
    else
        asm volatile(
            "cp.async.bulk.tensor.2d.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1, {%2, %3}], [%4];"
            ::"r"(to), "l"(map), "r"(k), "r"(row), "r"(bar) : "memory");
}
// Generated: mma(Sum (&sums)[BN / 2], u64 a, u64 b, int keep), and the kernel's parameters.

__device__ __forceinline__ u32 pack_eight_bits(float low, float high) {
    return TP_INT8 ? pack_int8(low, high) : pack_e4m3(low, high);
}

__device__ __forceinline__ float tanh_of_gelu(float x) {  // off by 2^-11 at most: less than rounding is
    float t;
    asm("tanh.approx.f32 %0, %1;" : "=f"(t) : "f"(x * fmaf(0.0356774081f, x * x, 0.7978845608f)));
    return t;
}
__device__ __forceinline__ float gelu(float x) { return fmaf(0.5f * x, tanh_of_gelu(x), 0.5f * x); }
__device__ __forceinline__ float twice_gelu(float x) { return fmaf(x, tanh_of_gelu(x), x); }
// The descriptor of instructions.cu's `operand`, of its lower half, which counts in 16 bytes.
__device__ __forceinline__ u32 lower_half(u32 address) { return (u32)operand(address); }
__device__ __forceinline__ u64 operand_of(u32 lower) { return lower | (operand(0) & 0xffffffff00000000ull); }

__device__ __forceinline__ float wide(u16 x) { return __uint_as_float((u32)x << 16); }
__device__ __forceinline__ float wide(float x) { return x; }
// A tile's scales and biases by column of `w`. Each thread of a warpgroup fetches some of them long before they are
// needed; they go through shared memory to whom they belong when the first products are under way.
template <typename Bias>
struct Factors {
    static constexpr int OWN = (BN + 127) / 128;
    float scale[OWN];
    Bias bias[OWN];  // as loaded: who made a float of it here would wait for it here

    __device__ __forceinline__ void fetch(const float* scales, const Bias* biases, int n, int N, bool with_bias) {
#pragma unroll
        for (int i = 0; i < OWN; ++i) {
            const int c = threadIdx.x % 128 + 128 * i, part = c / TILE_N, col = n + c % TILE_N;
            const bool inside = c < BN && col < N;
            scale[i] = inside ? scales[part * N + col] : 0.0f;
            bias[i] = inside && with_bias ? biases[col] : Bias();
        }
    }
    __device__ __forceinline__ void fetch_biases(const Bias* biases, int n, int N) {  // of bfloat16, which isn't scaled
#pragma unroll
        for (int i = 0; i < OWN; ++i) {
            const int c = threadIdx.x % 128 + 128 * i;
            scale[i] = 0.0f, bias[i] = biases && c < BN && n + c < N ? biases[n + c] : Bias();
        }
    }
    __device__ __forceinline__ void scale_up(float by) {  // GeGLU's up columns
#pragma unroll
        for (int i = 0; i < OWN; ++i)
            if (threadIdx.x % 128 + 128 * i >= TILE_N) scale[i] *= by;
    }
    __device__ __forceinline__ void share(float2* shared, int warpgroup) const {
        const auto sync = [&] { asm volatile("bar.sync %0, 128;" ::"r"(warpgroup + 1) : "memory"); };
        sync();  // the last tile's have been read
#pragma unroll
        for (int i = 0; i < OWN; ++i) {
            const int c = threadIdx.x % 128 + 128 * i;
            if (c < BN) shared[c] = make_float2(scale[i], wide(bias[i]));
        }
        sync();
    }
};

// which of a tile's parts ends up with a block of 8 columns; blocks go in twos or fours, as that many leave together
constexpr int BLOCKS = TILE_N / 8, TOGETHER = OUT_FP8 ? 4 : 2, GROUPS = (BLOCKS + TOGETHER - 1) / TOGETHER;
__device__ constexpr int owner(int block) { return block / TOGETHER * SPLITS / GROUPS; }
// What one part gets of another's sums, by block, then by thread. TP_APART: where all this lies is no slot of operands.
constexpr int FROM_ONE = (GROUPS + SPLITS - 1) / SPLITS * TOGETHER * 128 * WGS * 16;
constexpr bool APART = TP_APART;
constexpr int RECEIVED_BYTES = APART ? (SPLITS - 1) * FROM_ONE : 0;
static_assert(1024 + STAGES * (STAGE_BYTES + 16) + RECEIVED_BYTES + 16  // then factors, then lines
                      + (FP8 + (TP_NORMED > 0) + (TP_OVERLAP && BIASED)) * 8 * BN * WGS
                      + (EPILOGUE >= 5 && !TP_OVERLAP ? BM * ROW_BYTES : 0) <= TP_SHARED_BYTES, "what a CTA is given");
static_assert(!GATHER || APART || (SPLITS - 1) * FROM_ONE <= STAGES * STAGE_BYTES, "no room for the others' sums");

// Adds up, for the blocks of 8 columns that are this part's, the sums of all parts of a tile, which come with `bar`.
__device__ __forceinline__ void gather(float (&sums)[BN / 2], int split, char* raw, u32 base, int rank, u32 bar) {
    constexpr int THREADS = 128 * WGS;
    if (threadIdx.x == 0) {
        int own = 0;
#pragma unroll
        for (int j = 0; j < BLOCKS; ++j) own += owner(j) == split;
        barrier_expect(bar, own * (SPLITS - 1) * THREADS * 16);
    }
    if (APART) base += STAGES * STAGE_BYTES;
    else cluster_sync();  // nobody reads operands any more
#pragma unroll
    for (int to = 0; to < SPLITS; ++to) {
        if (to == split) continue;
        const u32 cta = to * SHARING + rank % SHARING, its_bar = at_rank(bar, cta);
        const u32 there = at_rank(base + (split < to ? split : split - 1) * FROM_ONE + threadIdx.x * 16, cta);
        int count = 0;
#pragma unroll
        for (int j = 0; j < BLOCKS; ++j)
            if (owner(j) == to)
                send(there + count++ * THREADS * 16,
                     make_float4(sums[4 * j], sums[4 * j + 1], sums[4 * j + 2], sums[4 * j + 3]), its_bar);
    }
    barrier_wait(bar, 0);
    const float4* const received = (const float4*)(raw + (base - shared_address(raw))) + threadIdx.x;
#pragma unroll
    for (int mine = 0; mine < SPLITS; ++mine) {
        if (mine != split) continue;
        int count = 0;
#pragma unroll
        for (int j = 0; j < BLOCKS; ++j) {
            if (owner(j) != mine) continue;
#pragma unroll
            for (int i = 0; i < SPLITS - 1; ++i) {
                const float4 x = received[i * (FROM_ONE / 16) + count * THREADS];
                sums[4 * j] += x.x, sums[4 * j + 1] += x.y, sums[4 * j + 2] += x.z, sums[4 * j + 3] += x.w;
            }
            ++count;
        }
    }
}

struct Tile {
    int m, n, k, k_end, split;
};

__device__ __forceinline__ Tile tile_of(int unit, int m_groups, int n_groups, int k_blocks, int rank) {
    Tile t;
    constexpr bool SEVERAL = !GATHER && SPLITS > 1;  // parts of K, in different clusters
    const int place = rank % SHARING, rest = quotient(unit, m_groups), part = SEVERAL ? quotient(rest, n_groups) : 0;
    t.m = ((unit - rest * m_groups) * CM + place / CN) * BM;
    t.n = ((rest - part * n_groups) * CN + place % CN) * TILE_N;
    t.split = GATHER ? rank / SHARING : part;
    t.k = settled(u32(k_blocks * t.split / SPLITS));  // of a loop that starts at 0 for sure, ptxas makes wgmma wait
    t.k_end = k_blocks * (t.split + 1) / SPLITS;
    return t;
}

// A quad's E4M3 numbers of 4 blocks, 2 columns of each a lane, in p (blocks 0 and 1) and q; lane i gets block i.
__device__ __forceinline__ uint2 transpose_bytes(u32 p, u32 q, int lane) {
    const bool odd = lane & 1, high = lane & 2;
    const u32 low_halves = high ? 0x1054 : 0x5410, high_halves = high ? 0x3276 : 0x7632;
    const u32 kept = high ? q : p, of_pair = __shfl_xor_sync(~0u, high ? p : q, 2);
    const u32 mine = __byte_perm(kept, of_pair, odd ? high_halves : low_halves);
    const u32 other = __shfl_xor_sync(~0u, __byte_perm(kept, of_pair, odd ? low_halves : high_halves), 1);
    return make_uint2(__byte_perm(mine, other, odd ? 0x1054 : 0x5410), __byte_perm(mine, other, odd ? 0x3276 : 0x7632));
}

// Two or four neighbouring numbers of a row, or eight, on their way out.
__device__ __forceinline__ void put(u16* to, u32 x) {
#if TP_EPILOGUE == 6
    asm volatile("red.global.add.noftz.bf16x2 [%0], %1;" ::"l"(to), "r"(x) : "memory");
#else
    *(u32*)to = x;
#endif
}
__device__ __forceinline__ void put(u16* to, uint2 x) {
#if TP_EPILOGUE == 6
    asm volatile("red.global.add.noftz.v2.bf16x2 [%0], {%1, %2};" ::"l"(to), "r"(x.x), "r"(x.y) : "memory");
#else
    *(uint2*)to = x;
#endif
}
__device__ __forceinline__ void put(u16* to, uint4 x) {
#if TP_EPILOGUE == 6
    asm volatile("red.global.add.noftz.v4.bf16x2 [%0], {%1, %2, %3, %4};"
                 ::"l"(to), "r"(x.x), "r"(x.y), "r"(x.z), "r"(x.w) : "memory");
#else
    *(uint4*)to = x;
#endif
}

// A lane's part of a row of a tile's results, `value(block)` for each of `count` blocks of 8 columns; `to` is where the
// tile begins in that row.
template <typename Value>
__device__ __forceinline__ void store_row(u16* to, int count, int split, int lane, Value value, int begin = 0,
                                          int end = BLOCKS) {
    const bool odd = lane & 1;
    u16* const place = to + (odd ? 8 : 0) + lane % 4 / 2 * 4;
#pragma unroll
    for (int j = begin; j + 1 < end; j += 2) {  // lanes of a pair exchange halves of two blocks
        if (GATHER && owner(j) != split) continue;
        const u32 x = value(j), y = value(j + 1), other = __shfl_xor_sync(~0u, odd ? x : y, 1);
        if (j + odd < count) put(place + j * 8, odd ? make_uint2(other, y) : make_uint2(x, other));
    }
    if (end % 2 && (!GATHER || owner(end - 1) == split)) {
        const u32 x = value(end - 1);
        if (end - 1 < count) put(to + (end - 1) * 8 + lane % 4 * 2, x);
    }
}
template <typename Value>
__device__ __forceinline__ void store_row(unsigned char* to, int count, int split, int lane, Value value, int begin = 0,
                                          int end = BLOCKS) {
    if (GATHER && TOGETHER == 2) {  // lanes of a pair exchange halves of two blocks
        const bool odd = lane & 1;
#pragma unroll
        for (int j = begin; j < end; j += 2) {
            if (owner(j) != split) continue;
            const u32 v = value(j) | (j + 1 < end ? value(j + 1) : 0) << 16, other = __shfl_xor_sync(~0u, v, 1);
            if (j + odd < count)
                *(u32*)(to + (j + odd) * 8 + lane % 4 / 2 * 4) = __byte_perm(v, other, odd ? 0x3276 : 0x5410);
        }
        return;
    }
    unsigned char* const place = to + lane % 4 * 8;
#pragma unroll
    for (int j = begin; j + 3 < end; j += 4) {
        if (GATHER && owner(j) != split) continue;
        const u32 p = value(j) | value(j + 1) << 16, q = value(j + 2) | value(j + 3) << 16;
        const uint2 v = transpose_bytes(p, q, lane);
        if (j + lane % 4 < count) *(uint2*)(place + j * 8) = v;
    }
#pragma unroll
    for (int j = end / 4 * 4; j < end; ++j) {
        if (GATHER && owner(j) != split) continue;
        const u32 x = value(j);
        if (j < count) *(u16*)(to + j * 8 + lane % 4 * 2) = (u16)x;
    }
}

// A warp's 16 rows of a part of the sums, in bfloat16, to where its first one begins. They take the way through shared
// memory, as whole lines of 128 bytes leave several times as fast as what a lane has of 8 rows.
constexpr int ROWS_BYTES = 16 * 128;
__device__ __forceinline__ void store_part(const float (&sums)[BN / 2], u16* to, char* shared, int rows, int N,
                                           int blocks, int lane) {
    const int of_quad = lane / 4, chunk = lane % 8;
#pragma unroll
    for (int first = 0; first < BLOCKS; first += 8) {
        __syncwarp();
#pragma unroll
        for (int j = first; j < min(first + 8, BLOCKS); ++j) {
            char* const place = shared + of_quad * 128 + ((j - first) ^ of_quad) * 16 + lane % 4 * 4;
            *(u32*)place = pack(sums[4 * j], sums[4 * j + 1]);
            *(u32*)(place + 8 * 128) = pack(sums[4 * j + 2], sums[4 * j + 3]);
        }
        __syncwarp();
#pragma unroll
        for (int row = lane / 8; row < 16; row += 4) {
            const uint4 line = *(const uint4*)(shared + row * 128 + (chunk ^ row % 8) * 16);
            if (row < rows && first + chunk < blocks) put(to + (size_t)row * N + (first + chunk) * 8, line);
        }
    }
}
