// One more entry of the denoising kernel's source: a CTA's four products of each layer and nothing of what is between
// them. The producer brings the weights, the warps that multiply find their operands where the loop would have them.
//
// sums[CTA][layer][qkv, out, gate|up, down][ROOM tiles][16 rows][NT * 8 tokens]

constexpr int HIDDEN = F16 % NC == 0 ? HC : 1;  // as layer.cu has it
constexpr int ROOM = imax(imax(QKV, GTL), DX);
#if TP_TOKENS > 16
constexpr int OUT_SUMS = M_X, GATE_UP_SUMS = M_X + X_FF_SUMS, DOWN_SUMS = GATE_UP_SUMS, OUT_EVEN = QT, DOWN_EVEN = HIDDEN,
              GATE_UP_AHEAD = 0;
#else
constexpr int OUT_SUMS = M_H, GATE_UP_SUMS = M_X, DOWN_SUMS = M_H,
              OUT_EVEN = HIDDEN % 16 == 0 && QT % 16 == 0 ? 16 : HIDDEN % 8 == 0 && QT % 8 == 0 ? 8 : 1,
              DOWN_EVEN = OUT_EVEN;
#endif

void put_operand(const Cta& b, int place, const byte* operand, int blocks) {
    consumers_sync();  // its place has been read
    for (int i = b.thread; i < blocks * NT * OPERAND; i += CONSUMERS) b.smem[place + i] = operand[i];
    consumers_sync();
}
// A lane's sums of a tile and 8 tokens n.
void put_sums(const Cta& b, float* to, int tile, int n, float4 v) {
    float* const row = to + (tile * 16 + b.g()) * NT * 8 + n * 8 + 2 * b.t();
    row[0] = v.x, row[1] = v.y, row[8 * NT * 8] = v.z, row[8 * NT * 8 + 1] = v.w;
}
template <typename Total>
void put_totals(const Cta& b, float* to, int tiles, Total total) {
    for (int i = b.warp(); i < tiles * NT; i += W) put_sums(b, to, i / NT, i % NT, total(i / NT, i % NT));
}

void qkv(Cta& b, const byte* stream, float* to) {
    const int tiles = b.qn() + b.kvn();
#if TP_TOKENS <= 16
    if constexpr (MMA_QKV) {
        QkvProduct product(tiles);
        product.load(b);
        put_operand(b, M_X, stream, D16);
        product.multiply(b);
        consumers_sync();
        product.store(b, b.smem + M_X);
        consumers_sync();
        return put_totals(b, to, tiles, [&](int i, int n) { return QkvProduct::total(b, b.smem + M_X, i, n); });
    }
#endif
    Ahead<group_tiles(QKV), 0> ahead(b);
    put_operand(b, M_X, stream, D16);
    float sums[plan_groups(QKV)][NT * 4];
    multiply<QKV, D16>(b, M_X, D16, tiles, sums, ahead);
    consumers_sync();
    store_partials<QKV>(b, b.smem + M_X, tiles, sums);
    consumers_sync();
    put_totals(b, to, tiles, [&](int i, int n) { return total<QKV>(b, b.smem + M_X, i, n); });
}
template <int MT, int EVEN, int AHEAD>
void shared_out(Cta& b, int place, const byte* operand, int blocks, int tiles, int region, float* to) {
    Ahead<group_tiles(MT), AHEAD> ahead(b);
    Own<MT> own(b, tiles);
    put_operand(b, place, operand, blocks);
    float sums[plan_groups(MT)][NT * 4];
    multiply<MT, EVEN>(b, place, blocks, tiles, sums, ahead);
    own.add_up(b, region, tiles, sums);
    for (int i = 0; i < plan_groups(MT); ++i)
        for (int k = 0; k < OWN<MT>; ++k)
            if (own.mine[i][k]) put_sums(b, to, own.tile[i], own.n[i][k], own.sums[i][k]);
}

extern "C" __global__ void products(const byte* weights, const long long* starts, long long layer_bytes,
                                    const long long* no_keys, const int* ctas, const byte* stream,
                                    const byte* attended, const byte* hidden, float* sums) {
    extern __shared__ byte smem[];
    Args args = {};
    args.weights = weights, args.starts = starts, args.layer_bytes = layer_bytes, args.length = no_keys, args.steps = 1;
    Cta b(args, smem);
    b.cta = ctas[blockIdx.x];
    if (threadIdx.x == 0)
        for (u32 i = 0; i < STAGES; ++i) barrier_init(b.full(i), 1), barrier_init(b.empty(i), W);
    __syncthreads();
    if (b.thread == CONSUMERS) Producer(b).run();
    if (b.thread >= CONSUMERS) return;
    attended += b.cluster() * QT * NT * OPERAND, hidden += share(F16, NC, b.cluster()) * NT * OPERAND;
    float* to = sums + size_t(blockIdx.x) * L * 4 * ROOM * 16 * NT * 8;
    auto next = [&] { return (to += ROOM * 16 * NT * 8) - ROOM * 16 * NT * 8; };
    for (int layer = 0; layer < L; ++layer) {
        qkv(b, stream, next());
        shared_out<DX, OUT_EVEN, RESIDUAL_AHEAD>(b, M_ATT, attended, QT, b.xn(), OUT_SUMS, next());
        shared_out<GTL, D16, GATE_UP_AHEAD>(b, M_X, stream, D16, b.gn(), GATE_UP_SUMS, next());
        shared_out<DX, DOWN_EVEN, RESIDUAL_AHEAD>(b, M_HID, hidden, b.hn(), b.xn(), DOWN_SUMS, next());
    }
}
