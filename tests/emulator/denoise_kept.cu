// One more entry of the denoising kernel's source: what a CTA keeps of each layer for a way back, of sums that say where
// they come from. rows: [CTA][QKV + GTL tiles][16] of q|k|v, then of gate|up.

float number_of(int row, int token, int layer) { return float((row * 13 + token * 7 + layer * 5) % 251); }
// A lane's two rows (columns) for its two tokens.
float4 numbers_of(int row, int row_8, int token, int layer) {
    return make_float4(number_of(row, token, layer), number_of(row, token + 1, layer), number_of(row_8, token, layer),
                       number_of(row_8, token + 1, layer));
}

extern "C" __global__ void kept(const int* ctas, const int* rows, unsigned short* kept_x, unsigned short* kept_q,
                                unsigned short* kept_gate_up, unsigned char* own_k, unsigned char* own_v,
                                long long layer_stride, float* kv) {
    extern __shared__ byte smem[];
    Args args = {};
    args.kept_x = kept_x, args.kept_q = kept_q, args.kept_gate_up = kept_gate_up, args.own_k = own_k, args.own_v = own_v;
    args.layer_stride = layer_stride;
    Cta b(args, smem);
    b.cta = ctas[blockIdx.x];
    if (b.thread == 0) barrier_init(b.bar(BAR_RMS), 1), barrier_arrive(b.bar(BAR_RMS));
    if (b.thread < NT * 8) *(float*)(smem + M_RMS + b.thread * 4) = 1;
    __syncthreads();
    if (b.thread >= CONSUMERS) return;
    rows += blockIdx.x * (QKV + GTL) * 16;
    const Factors none = make_float4(0, 0, 0, 0);
    float4 x[ITEMS_X];
    for (b.n = 0; b.n <= L; ++b.n)
        for (int half = 0; half < 2 && (b.n < L || half == 0); ++half) {
            for (int j = 0; j < ITEMS_X; ++j) {
                const Item item = stream_item(b, j);
                const int column = (b.x0() + item.tile) * 16 + 2 * b.g();
                x[j] = numbers_of(column, column + 1, item.token, 2 * b.n + half);
            }
            keep_stream(b, x, 2 * b.n + half);
            if (b.n == L) continue;
            if (half == 0)
                for (int j = 0; j < ITEMS_Q; ++j)
                    if (const QkvItem item(b, j); item.mine) {
                        const int* const of = rows + item.at * 16 + b.g();
                        const float4 c = numbers_of(of[0], of[8], item.n * 8 + 2 * b.t(), b.n);
                        finish_item<64>(b, item, c, none, make_float4(1, 0, 1, 0), smem + M_ATT + item.i * 256, kv, 0);
                    }
            if (half == 1)
                for (int i = b.warp(); i < b.gn() * NT; i += W) {
                    const int tile = i / NT, n = i % NT;
                    const int* const of = rows + (QKV + tile) * 16 + b.g();
                    const float4 c = numbers_of(of[0], of[8], n * 8 + 2 * b.t(), b.n);
                    keep_gate_up(b, tile, n, c, make_float2(1, 1), none);
                }
        }
}
