// out = softmax(scale * q @ k^T) @ v of pictures of 256 tokens, with q, k, v = LayerNorm(a) @ w^T + bias, in one kernel. For
// compute capability 9.0. kernel.py sets the TP_ constants and writes `mma`, `mma_logits` and `mma_values`.
//
// a is [pictures * 256, K], w [3 * heads * TP_DIM, K], q before k before v. How LayerNorm is multiplied, and what a and w
// of E4M3 numbers are (TP_FP8): see gemm/base.cu. TP_NORMED: parts of a row's sums. TP_OUT_FP8: out leaves as E4M3.
//
// Four CTAs share a head of a picture; each multiplies 64 tokens by the head's 3 * TP_DIM rows of w, keeps its queries and
// lets the others have its keys and values. TP_RANKS of them, two or four, are a cluster: they load w together, and
// within a pair, or a cluster of four, keys and values go from shared memory to shared memory. A pair gets those of the
// other pair through `exchange`, in the L2 cache: `flags` counts the CTAs that have written theirs and read the others'.
// (Clusters of two all fit a GPU whose clusters of four don't.)
//
// A CTA has two consumer warpgroups and four more warps. Of the product, the first warpgroup makes the keys and half of
// the queries, the second one the other half and the values. Then the first takes the keys of its own pair, the second
// the other's, which come later; at the end they join their sums.
//
// Warps behind the consumers: 0 loads w, 1 loads a; then they get the other pair's keys and values. 2 sends keys, 3 values.
//
// Queries, keys and values lie as core matrices, 8 tokens of 16 bytes: block of 8 columns by block, each token by token.

constexpr int DIM = TP_DIM, STAGES = TP_STAGES, RANKS = TP_RANKS, NORMED = TP_NORMED;
constexpr bool FP8 = TP_FP8;
constexpr int WGS = 2, THREADS = 128 * WGS, ROW_BYTES = 128, BK = FP8 ? ROW_BYTES : ROW_BYTES / 2;
constexpr int CTAS = 4, ROWS = 64, KEYS = 2 * ROWS;  // of a head and picture; a CTA's tokens; a warpgroup's keys
constexpr int BLOCKS = DIM / 8, DEPTH = (DIM + 15) / 16;
constexpr int KEPT = (3 * BLOCKS + 1) / 2, OTHERS = 3 * BLOCKS - KEPT;  // blocks of columns of each warpgroup
constexpr int A_BYTES = ROWS * ROW_BYTES, PART_BYTES = DIM * ROW_BYTES, STAGE_BYTES = A_BYTES + 3 * PART_BYTES;
// Of queries, keys, values: a block of columns; half of keys or of values, which is all of a pair's.
constexpr int QUERY_BLOCK = ROWS * 16, KEY_BLOCK = KEYS * 16, PAIR_BYTES = BLOCKS * KEY_BLOCK;
constexpr int SHARE_BYTES = BLOCKS * QUERY_BLOCK;  // one CTA's
constexpr int QUERY_BLOCKS = 2 * DEPTH;
constexpr int CONSUMER_REGISTERS = 232, PRODUCER_REGISTERS = 40;
constexpr u32 PACE = TP_PACE, LEAD = 2;  // see gemm/base.cu
static_assert(RANKS == 2 || RANKS == 4);
static_assert(KEPT >= BLOCKS && OTHERS >= BLOCKS, "keys are the first warpgroup's, values the second's");
static_assert(2 * RECEIVED<BLOCKS> <= STAGES * STAGE_BYTES, "no room for the other's sums");

// Generated: mma(float (&)[KEPT * 4 or OTHERS * 4], u64, u64, int keep), mma_logits(float (&)[KEYS / 2], u64, u64, int
// keep), mma_values(float (&)[DIM / 2], u32 * 4, u64, int keep), and the kernel's parameters.

// Core matrices: `along` bytes from one to the next of the same rows, `down` to the next 8 rows. Where rows are the inner
// axis, they are numbers of 8 columns each.
__device__ __forceinline__ u64 core_operand(u32 address, int along, int down) {
    return ((u64)(address & 0x3ffff) >> 4) | ((u64)(along >> 4) << 16) | ((u64)(down >> 4) << 32);
}
__device__ __forceinline__ void arrive_consumers(int barrier, int threads) {
    asm volatile("bar.arrive %0, %1;" ::"r"(barrier), "r"(threads) : "memory");
}
__device__ __forceinline__ void show_to_async() { asm volatile("fence.proxy.async.shared::cta;" ::: "memory"); }
// `bytes` of this CTA's shared memory into that of one of the cluster, whose barrier counts them
__device__ __forceinline__ void copy_to_cta(u32 to, u32 from, u32 bytes, u32 bar) {
    asm volatile("cp.async.bulk.shared::cluster.shared::cta.mbarrier::complete_tx::bytes [%0], [%1], %2, [%3];"
                 ::"r"(to), "r"(from), "r"(bytes), "r"(bar) : "memory");
}
__device__ __forceinline__ void copy_out(char* to, u32 from, u32 bytes) {  // and wait until it is there
    asm volatile("cp.async.bulk.global.shared::cta.bulk_group [%0], [%1], %2;" ::"l"(to), "r"(from), "r"(bytes) : "memory");
    asm volatile("cp.async.bulk.commit_group;" ::: "memory");
    asm volatile("cp.async.bulk.wait_group 0;" ::: "memory");
}
__device__ __forceinline__ void copy_in(u32 to, const char* from, u32 bytes, u32 bar) {
    asm volatile("cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes [%0], [%1], %2, [%3];"
                 ::"r"(to), "l"(from), "r"(bytes), "r"(bar) : "memory");
}
__device__ __forceinline__ void add_released(u32* to, u32 what) {
    asm volatile("red.release.gpu.global.add.u32 [%0], %1;" ::"l"(to), "r"(what) : "memory");
}
__device__ __forceinline__ u32 load_acquired(const u32* from) {
    u32 value;
    asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(value) : "l"(from) : "memory");
    return value;
}
// Waits until both CTAs of a pair have added 1; the second of the two that wait takes it all back, for the next launch.
__device__ __forceinline__ void await_pair(u32* flag) {
    for (u32 tries = 0; load_acquired(flag) < 2; ++tries)
        if (tries == 1u << 24) asm volatile("trap;");  // seconds: the other pair isn't there
    if (atomicAdd(flag, 1) == 3) atomicExch(flag, 0);
}
// A row's mean and 1 / deviation of the parts of its sum and of its squares' sum, of which each lane of a quad has some
template <int OWN>
__device__ __forceinline__ float2 norm_of_row(const float2 (&parts)[OWN], float inverse_width, float eps) {
    float sum = 0.0f, squares = 0.0f;
#pragma unroll
    for (int i = 0; i < OWN; ++i) sum += parts[i].x, squares += parts[i].y;
    const float mean = settled(sum_of_quad(sum) * inverse_width);
    const float variance = sum_of_quad(squares) * inverse_width - mean * mean;
    return make_float2(mean, settled(rsqrtf(fmaxf(variance, 0.0f) + eps)));
}
// Where a block of queries lies: of an odd number the last one comes behind one of zeros, which keys meet in the last step
__device__ constexpr int query_place(int block) { return BLOCKS % 2 && block == BLOCKS - 1 ? BLOCKS : block; }

// Where the rows of w begin whose products are keys (0), queries (1), values (2), as they lie in a stage
__device__ __forceinline__ int rows_of(int part, int heads, int head) {
    return ((part == 0 ? heads : part == 1 ? 0 : 2 * heads) + head) * DIM;
}

struct Projection {
    const float2* sums_in;
    const float *sums_of_w, *offset, *scale;
    const u16* bias;
    float inverse_width, eps;
    int M, heads, head, k_blocks, first_row, side;
    char* raw;
    u32 base, keys, values, queries, factors, full, empty;  // places in shared memory
};

// A warpgroup's columns of the product, COUNT blocks from block BEGIN of a stage's on, become numbers in shared memory.
template <int BEGIN, int COUNT>
__device__ __forceinline__ void project(const Projection& p) {
    constexpr int GROUP = BEGIN > 0;
    const int own = threadIdx.x % 128, lane = own % 32, token = own / 32 * 16 + lane / 4;  // and 8 tokens on
    float sums[COUNT * 4];
    // Each thread fetches a column's factors long before they are needed.
    const int column = BEGIN * 8 + own, at = rows_of(column / DIM, p.heads, p.head) + column % DIM;
    const bool some = own < COUNT * 8;
    const float2 of_norm = some ? make_float2(p.sums_of_w[at], p.offset[at]) : make_float2(0.0f, 0.0f);
#if TP_FP8
    const float of_scale = some ? p.scale[at] : 0.0f;
    const u16 of_bias = some ? p.bias[at] : 0;
#endif
    const float2* const own_sums = settled(p.sums_in + (size_t)(lane % 4) * p.M + p.first_row + token);
    asm volatile("griddepcontrol.wait;" ::: "memory");
    constexpr int PARTS = (NORMED + 3) / 4;
    float2 row_sums[2][PARTS];
#pragma unroll
    for (int i = 0; i < 2 * PARTS; ++i)
        row_sums[i % 2][i / 2] = i / 2 * 4 + lane % 4 < NORMED ? own_sums[(size_t)(i / 2 * 4) * p.M + i % 2 * 8]
                                                                 : make_float2(0.0f, 0.0f);

    const u32 a_lower = lower_half(p.base), b_lower = lower_half(p.base + A_BYTES + BEGIN * 8 * ROW_BYTES);
    int slot = 0, last = 0;
    u32 parity = 0;
    auto multiply = [&](bool keep) {  // one step, and no more than it is still going on then
        barrier_wait(p.full + 8 * slot, parity);
        const u32 a = a_lower + slot * (STAGE_BYTES / 16), b = b_lower + slot * (STAGE_BYTES / 16);
        begin_products();
#pragma unroll
        for (int j = 0; j < 4; ++j) mma(sums, operand_of(a + 2 * j), operand_of(b + 2 * j), keep || j > 0);
        commit_products(), await_products<1>();
    };
    auto advance = [&] {
        last = slot++;
        if (slot == STAGES) slot = 0, parity ^= 1;
    };
    auto release = [&](int k) {  // what step k took, if somebody waits for it
        if (own < RANKS && k + STAGES < p.k_blocks) barrier_arrive(p.empty + 8 * last, own);
    };
    multiply(false), advance();
    multiply(true), release(0), advance();
    float2* const shared = (float2*)(p.raw + (p.factors - shared_address(p.raw)));
    if (some) {
        shared[column] = of_norm;
#if TP_FP8
        shared[3 * DIM + column] = make_float2(of_scale, __uint_as_float((u32)of_bias << 16));
#endif
    }
    float2 norm[2];  // mean, 1 / deviation
#pragma unroll
    for (int half = 0; half < 2; ++half) norm[half] = norm_of_row(row_sums[half], p.inverse_width, p.eps);
    sync_consumers(2 + GROUP, 128);
    for (int k = 2; k < p.k_blocks; ++k) multiply(true), release(k - 1), advance();
    await_products<0>();

#pragma unroll
    for (int j = 0; j < COUNT; ++j) {
        const int block = BEGIN + j, part = block / BLOCKS, within = block % BLOCKS;
        const float4 of_w = *(const float4*)(shared + block * 8 + lane % 4 * 2);
#if TP_FP8
        const float4 of = *(const float4*)(shared + 3 * DIM + block * 8 + lane % 4 * 2);
#endif
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
            const float mean = norm[half].x, factor = norm[half].y;
#if TP_FP8
            x = fmaf(fmaf(x, of.x, -fmaf(mean, of_w.x, of_w.y)), factor, of_w.y + of.y);
            y = fmaf(fmaf(y, of.z, -fmaf(mean, of_w.z, of_w.w)), factor, of_w.w + of.w);
#else
            x = fmaf(x - mean * of_w.x, factor, of_w.y);
            y = fmaf(y - mean * of_w.z, factor, of_w.w);
#endif
            const u32 to = part == 1 ? p.queries + query_place(within) * QUERY_BLOCK
                                     : (part == 0 ? p.keys : p.values) + within * KEY_BLOCK + p.side * QUERY_BLOCK;
            *(u32*)(p.raw + (to - shared_address(p.raw)) + (token + half * 8) * 16 + lane % 4 * 4) = pack(x, y);
        }
        if (block == BLOCKS - 1 || block == 3 * BLOCKS - 1) show_to_async(), arrive_consumers(4 + GROUP, 160);
    }
}
