// GeGLU where a CTA has several tiles: what follows a tile's sums is done in pieces between the steps of the next tile,
// whose sums have registers of their own. Comes behind base.cu.
// step(sums, is it the first, keep) multiplies, and all but this step is done then; end() waits for that one.
#if TP_OVERLAP
static_assert(EPILOGUE == 3 && !TP_PROMOTE && !GATHER && SPLITS == 1);
static_assert(!TP_RMS || 1024 + STAGES * (STAGE_BYTES + 16) + 16 + 8 * FP8 * WGS * BN + 4 * BM <= 227 * 1024,
              "no room for the rows' factors");
constexpr int PIECES = (BLOCKS + 3) / 4 * 2;  // of 4 blocks of columns in half of the rows; see `Tile.takes`

template <typename Step, typename End, typename TileOf>
__device__ __forceinline__ void geglu_tiles(Step step, End end, TileOf tile_at, int unit, int units, int stride,
                                            int k_blocks, Element* out, int M, int N, int group,
                                            const float* scale, float inverse, float2* shared,
                                            float* of_rows = nullptr, const float2* sums_in = nullptr,
                                            float inverse_width = 0, float eps = 0) {
    float even[BN / 2], odd[BN / 2];
    [[maybe_unused]] float* const own_factors =
        of_rows + group * 64 + threadIdx.x / 32 % 4 * 16 + threadIdx.x % 32 / 4;  // of this lane's row and 8 on
    Factors<u16> factors;
    auto fetch = [&](int n) {
        if (FP8) factors.fetch(scale, nullptr, n, N, false), factors.scale_up(0.5f * inverse);
    };
    auto done = [&](float(&sums)[BN / 2]) {  // the compiler is not to use them before
#pragma unroll
        for (int i = 0; i < BN / 2; ++i) asm volatile("" : "+f"(sums[i])::"memory");
        if (FP8) factors.share(shared, group);
    };
    auto piece = [&](int index, float(&sums)[BN / 2], const Tile& of) {
        const int lane = threadIdx.x % 32, half = index % 2, first = index / 2 * 4;
        const int row = of.m + group * 64 + threadIdx.x / 32 % 4 * 16 + lane / 4 + half * 8;
        const float factor = TP_RMS ? own_factors[half * 8] : 1.0f;
        auto value = [&](int j) -> u32 {
            float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
            const float up_x = sums[BN / 4 + 4 * j + 2 * half], up_y = sums[BN / 4 + 4 * j + 2 * half + 1];
            if (FP8) {  // `up` has the half and `inverse` in it
                const float4 gate = *(const float4*)(shared + j * 8 + lane % 4 * 2);
                const float4 up = *(const float4*)(shared + TILE_N + j * 8 + lane % 4 * 2);
                if (TP_RMS) x *= factor, y *= factor;
                x = twice_gelu(x * gate.x) * (up_x * up.x), y = twice_gelu(y * gate.z) * (up_y * up.z);
            } else {
                if (TP_RMS) x *= factor, y *= factor;
                x = gelu(x) * up_x, y = gelu(y) * up_y;
            }
            if (TP_RMS) x *= factor, y *= factor;  // as the up columns are to be
            return OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
        };
        store_row(out + (size_t)row * N + of.n, row < M ? min((N - of.n) / 8, BLOCKS) : 0, 0, lane, value, first,
                  min(first + 4, BLOCKS));
    };
    Tile t = tile_at(unit);  // the last one begun
#if TP_RMS  // before there are sums: they take all registers. All of a CTA's tiles are of the same rows
    {
        const int row = t.m + group * 64 + threadIdx.x / 32 % 4 * 16 + threadIdx.x % 32 / 4;
        float squares[2] = {};
#pragma unroll
        for (int i = 0; i < 2 * ((TP_RMS + 3) / 4); ++i) {
            const int part = i / 2 * 4 + threadIdx.x % 4, at = row + i % 2 * 8;
            if (at < M && part < TP_RMS) squares[i % 2] += sums_in[(size_t)part * M + at].y;
        }
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            const float factor = rsqrtf(sum_of_quad(squares[half]) * inverse_width + eps);
            if (threadIdx.x % 4 == 0) own_factors[half * 8] = factor;
        }
        __syncwarp();
    }
#endif
    fetch(t.n);
    step(even, true, false);
    for (int k = 1; k < k_blocks; ++k) step(even, false, true);
    auto next = [&](float(&sums)[BN / 2], float(&before)[BN / 2]) {
        const Tile was = t;
        t = tile_at(unit);
        step(sums, false, false), done(before), fetch(t.n);
#pragma unroll
        for (int i = 0; i < PIECES; ++i) piece(i, before, was), step(sums, false, true);
        for (int k = PIECES + 1; k < k_blocks; ++k) step(sums, false, true);
    };
    auto last = [&](float(&sums)[BN / 2]) {
        end(), done(sums);
#pragma unroll
        for (int i = 0; i < PIECES; ++i) piece(i, sums, t);
    };
    while (true) {  // of a shorter form ptxas makes one that waits for each product
        if ((unit += stride) >= units) return last(even);
        next(odd, even);
        if ((unit += stride) >= units) return last(odd);
        next(even, odd);
    }
}
#endif
