// Queries, keys and values of the suffix: what becomes of their sums.

constexpr int ITEMS_Q = most(QKV * NT, W);  // (tile, 8 tokens) of queries, keys and values that one warp finishes

struct QkvItem {
  int i, k;             // among all: queries first; among keys and values, negative: a query
  int n, kv_tile, at;   // 8 tokens; tile of keys or values; tile among all of this CTA
  bool mine;            // there is such an item
  __device__ __forceinline__ QkvItem(const Cta& b, int j) : i(b.warp() + j * W) {
    const int qn = b.qn(), kvn = b.kvn();
    k = i - qn * NT, mine = i < (qn + kvn) * NT;
    n = k < 0 ? i / qn : KVL == 1 ? k : k / kvn;
    kv_tile = KVL == 1 ? 0 : k % kvn, at = k < 0 ? i % qn : qn + kv_tile;
  }
  __device__ __forceinline__ int row(const Cta& b) const {  // in `shifted` and `row_scales`
    return (!mine ? 0 : k < 0 ? i % b.qn() : QTL + kv_tile) * 16 + b.g();
  }
};

// Cosine and sine of an item, for tokens 2t and 2t + 1; values aren't turned.
__device__ __forceinline__ float4 rope_of(const Cta& b, int prefix, QkvItem item) {
  float4 turn = make_float4(1, 0, 1, 0);
  const int tile = item.k < 0 ? b.q0() + item.at : b.kv0() + item.kv_tile;
  if (!item.mine || item.k >= 0 && tile >= QT) return turn;
  auto angle = [&](int h) { return float(POSITION(b.a, prefix, item.n * 8 + 2 * b.t() + h)) * b.a.inv_freq[tile * 8 + b.g()]; };
  sincosf(angle(0), &turn.y, &turn.x), sincosf(angle(1), &turn.w, &turn.z);
  return turn;
}

// Floats as integers of the same order, and back. Even where a rank has no keys, the largest logit is LOWEST.
constexpr float LOWEST = -3e38f;
__device__ __forceinline__ int ordered(int v) { return v ^ ((v >> 31) & 0x7fffffff); }
__device__ __forceinline__ int ordered(float v) { return ordered(__float_as_int(v)); }

// An item's sums times scale and 1 / rms, shifted, turned: a query to `staged`, its other half OTHER_HALF numbers behind;
// keys and values to all clusters as float32 with their flags.
template <int OTHER_HALF>
__device__ __forceinline__ void finish_item(const Cta& b, QkvItem item, float4 c, Factors of_rows, float4 turn, byte* staged,
                                            float* kv, u32 bit) {
  const int token = item.n * 8 + 2 * b.t();
  const float2 r = inverse_rms(b, token, 0);
  const float2 u = make_float2(turn.x, turn.y), v = make_float2(turn.z, turn.w);
  const float4 shift = of_item(of_rows);
  const float a0 = c.x * r.x + shift.x, a1 = c.z * r.x + shift.z, c0 = c.y * r.y + shift.y, c1 = c.w * r.y + shift.w;
  const float f0 = a0 * u.x - a1 * u.y, s0 = a1 * u.x + a0 * u.y, f1 = c0 * v.x - c1 * v.y, s1 = c1 * v.x + c0 * v.y;
  if (item.k < 0) {
    const u32 f = pack(f0, f1), s = pack(s0, s1);
    unsigned short* p = (unsigned short*)(staged + b.t() * 32) + b.g();
    p[0] = (unsigned short)f, p[8] = (unsigned short)(f >> 16);
    p[OTHER_HALF] = (unsigned short)s, p[OTHER_HALF + 8] = (unsigned short)(s >> 16);
    KEEP(keep_queries(b, token, (b.q0() + item.at) * 8 + b.g(), make_float4(f0, s0, f1, s1));)
  } else {
    const int tile = b.kv0() + item.kv_tile, col = tile < QT ? tile * 8 + b.g() : HD + (tile - QT) * 16 + b.g(),
              up = tile < QT ? HD / 2 : 8;
    float* p = kv + size_t(token) * 2 * HD + col;
    if (token < T) publish(p, f0, bit), publish(p + up, s0, bit);
    if (token + 1 < T) publish(p + 2 * HD, f1, bit), publish(p + 2 * HD + up, s1, bit);
    KEEP(keep_keys(b, tile < QT ? b.a.own_k : b.a.own_v, token, tile < QT ? col : col - HD, up, make_float4(f0, s0, f1, s1));)
  }
}

// Queries, staged [item][half][8 tokens][8], to all ranks.
__device__ __forceinline__ void send_queries(const Cta& b, const byte* staged) {
  const int qn = b.qn();
  static_assert(S == 8, "half a warp serves half of the ranks");
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp() + j * W;
    if (i < qn * NT) {
      const int n = i / qn, half = b.lane() >> 3 & 1, token = b.lane() & 7, d0 = b.lane() >> 4 << 2;
      const float4 v = *(const float4*)(staged + i * 256 + (b.lane() & 15) * 16);
      const u32 to = b.base + M_Q + ((b.q0() + i % qn + half * QT) * NT + n) * 128 + token * 16;
      u32 data[4], bars[4];
#pragma unroll
      for (int d = 0; d < 4; ++d) data[d] = at_rank(to, d0 + d), bars[d] = at_rank(b.bar(BAR_Q), d0 + d);
      if (n * 8 + token < T)
#pragma unroll
        for (int d = 0; d < 4; ++d) send(data[d], v, bars[d]);
    }
  }
  if (IDLE_Q && b.thread < S) send(at_rank(b.base + M_TOKEN, b.thread), 0, at_rank(b.bar(BAR_Q), b.thread));
}
