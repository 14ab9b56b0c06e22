// A CTA that has several tiles does what follows a tile's sums in pieces between the steps of the next tile, whose sums
// have registers of their own: the tensor cores don't wait for bias, GELU and results on their way. Comes behind base.cu.
// step(sums, is it the first, keep) multiplies, and all but this step is done then; end() waits for that one.
#if TP_OVERLAP
static_assert((EPILOGUE <= 3 || EPILOGUE == 6) && !TP_PROMOTE && !GATHER && SPLITS == 1 && !TP_RESIDUAL && !TP_NORMED);
constexpr bool HALVES = EPILOGUE == 3;  // a piece has 4 blocks of columns, and of GeGLU half of the rows
constexpr int PIECES = (BLOCKS + 3) / 4 * (HALVES ? 2 : 1);  // see `Tile.takes`
constexpr bool FACTORED = FP8 || BIASED;

template <typename Step, typename End, typename TileOf>
__device__ __forceinline__ void overlapped_tiles(Step step, End end, TileOf tile_at, int unit, int units, int stride,
                                                 int k_blocks, Element* out, const u16* bias, int M, int N, int group,
                                                 float2* shared, const float* scale = nullptr, float inverse = 1) {
    float even[BN / 2], odd[BN / 2];
    Factors<u16> factors;
    auto fetch = [&](int n) {
        if (FP8 && EPILOGUE == 3) factors.fetch(scale, nullptr, n, N, false), factors.scale_up(0.5f * inverse);
        else if (FP8) factors.fetch(scale, bias, n, N, bias);
        else if (BIASED) factors.fetch_biases(bias, n, N);
    };
    auto done = [&](float(&sums)[BN / 2]) {  // the compiler is not to use them before
#pragma unroll
        for (int i = 0; i < BN / 2; ++i) asm volatile("" : "+f"(sums[i])::"memory");
        if (FACTORED) factors.share(shared, group);
    };
    auto blocks = [&](int first, int half, float(&sums)[BN / 2], const Tile& of) {
        const int lane = threadIdx.x % 32;
        const int row = of.m + group * 64 + threadIdx.x / 32 % 4 * 16 + lane / 4 + half * 8;
        auto value = [&](int j) -> u32 {
            float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
#if TP_EPILOGUE == 3
            const float up_x = sums[BN / 4 + 4 * j + 2 * half], up_y = sums[BN / 4 + 4 * j + 2 * half + 1];
            if (FP8) {  // `up` has the half and `inverse` in it
                const float4 gate = *(const float4*)(shared + j * 8 + lane % 4 * 2);
                const float4 up = *(const float4*)(shared + TILE_N + j * 8 + lane % 4 * 2);
                x = twice_gelu(x * gate.x) * (up_x * up.x), y = twice_gelu(y * gate.z) * (up_y * up.z);
            } else {
                x = gelu(x) * up_x, y = gelu(y) * up_y;
            }
            return OUT_FP8 ? pack_e4m3(x, y) : pack(x, y);
#else
            if (FACTORED) {
                const float4 of_columns = *(const float4*)(shared + j * 8 + lane % 4 * 2);
                x = FP8 ? fmaf(x, of_columns.x, of_columns.y) : x + of_columns.y;
                y = FP8 ? fmaf(y, of_columns.z, of_columns.w) : y + of_columns.w;
            }
            if (EPILOGUE == 2) x = gelu(x), y = gelu(y);
            return OUT_FP8 ? pack_e4m3(x * inverse, y * inverse) : pack(x, y);
#endif
        };
        store_row(out + (size_t)row * N + of.n, row < M ? min((N - of.n) / 8, BLOCKS) : 0, 0, lane, value, first,
                  min(first + 4, BLOCKS));
    };
    auto piece = [&](int index, float(&sums)[BN / 2], const Tile& of) {
        if (HALVES) blocks(index / 2 * 4, index % 2, sums, of);
        else blocks(index * 4, 0, sums, of), blocks(index * 4, 1, sums, of);
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
