// GeGLU where a CTA has several tiles: what follows a tile's sums is done in pieces between the steps of the next tile,
// whose sums have registers of their own. Comes behind base.cu.
// step(sums, is it the first, keep) multiplies, and all but this step is done then; end() waits for that one.
#if TP_OVERLAP
static_assert(EPILOGUE == 3 && !TP_PROMOTE && !GATHER && SPLITS == 1);
constexpr int PIECES = (BLOCKS + 3) / 4 * 2;  // of 4 blocks of columns in half of the rows; see `Tile.takes`

template <typename Step, typename End, typename TileOf>
__device__ __forceinline__ void geglu_tiles(Step step, End end, TileOf tile_at, int unit, int units, int stride,
                                            int k_blocks, Element* out, int M, int N, int group,
                                            const float* scale = nullptr, float inverse = 1, float2* shared = nullptr) {
    float even[BN / 2], odd[BN / 2];
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
        auto value = [&](int j) -> u32 {
            float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
            const float up_x = sums[BN / 4 + 4 * j + 2 * half], up_y = sums[BN / 4 + 4 * j + 2 * half + 1];
            if (FP8) {  // `up` has the half and `inverse` in it
                const float4 gate = *(const float4*)(shared + j * 8 + lane % 4 * 2);
                const float4 up = *(const float4*)(shared + TILE_N + j * 8 + lane % 4 * 2);
                x = twice_gelu(x * gate.x) * (up_x * up.x), y = twice_gelu(y * gate.z) * (up_y * up.z);
            } else {
                x = gelu(x) * up_x, y = gelu(y) * up_y;
            }
            return OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
        };
        store_row(out + (size_t)row * N + of.n, row < M ? min((N - of.n) / 8, BLOCKS) : 0, 0, lane, value, first,
                  min(first + 4, BLOCKS));
    };
    Tile t = tile_at(unit);  // the last one begun
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
