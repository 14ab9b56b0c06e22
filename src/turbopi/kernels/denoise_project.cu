// Part 8 of 11: queries, keys and values of the suffix.

__device__ __forceinline__ void ldmatrix(uint4& v, u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "r"(address));
}
__device__ __forceinline__ void ldmatrix_transposed(uint4& v, u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "r"(address));
}

constexpr int ITEMS_Q =
    most((QTL + KVL) * NT, W);  // (tile, 8 tokens) of queries, keys and values that one warp finishes

// Cosine and sine of a warp's items, for tokens 2t and 2t + 1; values aren't turned. To shared memory if there is room.
__device__ __forceinline__ void make_rope(const Block& b, int prefix, float2 (&rope)[ITEMS_Q][2]) {
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W, qn = b.qn(), kvn = b.kvn(), k = i - qn * NT;
    rope[j][0] = rope[j][1] = make_float2(1, 0);
    if (!b.attends() || i >= (qn + kvn) * NT) continue;
    const int tile = k < 0 ? b.q0() + i % qn : b.kv0() + (KVL == 1 ? 0 : k % kvn), n = k < 0      ? i / qn
                                                                                       : KVL == 1 ? k
                                                                                                  : k / kvn;
    if (k >= 0 && tile >= QT) continue;
#pragma unroll
    for (int h = 0; h < 2; ++h) {
      float sine, cosine;
      sincosf(float(prefix + n * 8 + 2 * b.t() + h) * b.a.inv_freq[tile * 8 + b.g()], &sine, &cosine);
      rope[j][h] = make_float2(cosine, sine);
    }
  }
  if (FEW)
#pragma unroll
    for (int j = 0; j < ITEMS_Q; ++j)
      if (b.warp + j * W < (QTL + KVL) * NT)
        *(float4*)(b.smem + M_ROPE + (b.warp + j * W) * 512 + b.lane * 16) =
            make_float4(rope[j][0].x, rope[j][0].y, rope[j][1].x, rope[j][1].y);
}

// Floats as integers of the same order, and back. Even where a rank has no keys, the largest logit is LOWEST.
constexpr float LOWEST = -3e38f;
__device__ __forceinline__ int ordered(int v) { return v ^ ((v >> 31) & 0x7fffffff); }
__device__ __forceinline__ int ordered(float v) { return ordered(__float_as_int(v)); }

// Awaits the stream. q to all ranks, k and v to all clusters as float32 with their flags. The partial sums lie over the
// stream; queries are sent when all of those have been read, so what a peer sends after it has them may lie there too.
__device__ __forceinline__ void project(Block& b, const float* shifted, const float* row_scales, float* kv, u32 bit,
                                        const float2 (&rope)[ITEMS_Q][2]) {
  const int qn = b.qn(), kvn = b.kvn();
  float2 shift[ITEMS_Q], scale[ITEMS_Q];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W, k = i - qn * NT;
    const int tile = i >= (qn + kvn) * NT ? 0 : k < 0 ? i % qn : QTL + (KVL == 1 ? 0 : k % kvn);
    shift[j] = make_float2(__ldg(shifted + tile * 16 + b.g()), __ldg(shifted + tile * 16 + b.g() + 8));
    if (FP8) scale[j] = make_float2(__ldg(row_scales + tile * 16 + b.g()), __ldg(row_scales + tile * 16 + b.g() + 8));
  }
  receive(b, BAR_X, b.x_parity, X_EXPECT, WAIT_X);
  b.x_parity ^= 1;
  MARK(0)
  float sums[plan_groups(QTL + KVL)][NT * 4];
  multiply<QTL + KVL, D16>(b, b.base + M_X, D16, qn + kvn, sums);
  MARK(1)
  consumers_sync();
  if constexpr (SPREAD) give_room(b);
  store_partials<QTL + KVL>(b, b.smem + M_X, qn + kvn, sums);
  consumers_sync();
  if (threadIdx.x < NT * 8) ((int*)(b.smem + M_PART))[threadIdx.x] = ordered(LOWEST);  // for `weigh_prefix`
  byte* const staged = b.smem + M_ATT;  // free until all have what attention sends: [item][half][8 tokens][8]
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W, k = i - qn * NT;
    if (i < (qn + kvn) * NT) {
      const int n = k < 0      ? i / qn
                    : KVL == 1 ? k
                               : k / kvn,
                kv_tile = KVL == 1 ? 0 : k % kvn, token = n * 8 + 2 * b.t();
      float4 c = total<QTL + KVL>(b, b.smem + M_X, k < 0 ? i % qn : qn + kv_tile, n);
      if (FP8) c = make_float4(c.x * scale[j].x, c.y * scale[j].x, c.z * scale[j].y, c.w * scale[j].y);
      const float2 r = inverse_rms(b, token);
      float4 turn = make_float4(rope[j][0].x, rope[j][0].y, rope[j][1].x, rope[j][1].y);
      if (FEW) turn = *(const float4*)(b.smem + M_ROPE + i * 512 + b.lane * 16);
      const float2 u = make_float2(turn.x, turn.y), v = make_float2(turn.z, turn.w);
      const float a0 = c.x * r.x + shift[j].x, a1 = c.z * r.x + shift[j].y, c0 = c.y * r.y + shift[j].x,
                  c1 = c.w * r.y + shift[j].y;
      const float f0 = a0 * u.x - a1 * u.y, s0 = a1 * u.x + a0 * u.y, f1 = c0 * v.x - c1 * v.y,
                  s1 = c1 * v.x + c0 * v.y;
      if (k < 0) {
        const u32 f = pack(f0, f1), s = pack(s0, s1);
        unsigned short* p = (unsigned short*)(staged + i * 256 + b.t() * 32) + b.g();
        p[0] = (unsigned short)f, p[8] = (unsigned short)(f >> 16);
        p[64] = (unsigned short)s, p[72] = (unsigned short)(s >> 16);
      } else {
        const int tile = b.kv0() + kv_tile, col = tile < QT ? tile * 8 + b.g() : HD + (tile - QT) * 16 + b.g(),
                  up = tile < QT ? HD / 2 : 8;
        float* p = kv + size_t(token) * 2 * HD + col;
        if (token < T) publish(p, f0, bit), publish(p + up, s0, bit);
        if (token + 1 < T) publish(p + 2 * HD, f1, bit), publish(p + 2 * HD + up, s1, bit);
      }
    }
  }
  consumers_sync();
  if constexpr (SPREAD) await_room(b), ++b.room;
  static_assert(S == 8, "half a warp serves half of the ranks");
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W;
    if (i < qn * NT) {
      const int n = i / qn, half = b.lane >> 3 & 1, token = b.lane & 7, d0 = b.lane >> 4 << 2;
      const float4 v = *(const float4*)(staged + i * 256 + (b.lane & 15) * 16);
      const u32 to = b.base + M_Q + ((b.q0() + i % qn + half * QT) * NT + n) * 128 + token * 16;
      u32 data[4], bars[4];
#pragma unroll
      for (int d = 0; d < 4; ++d) data[d] = at_rank(to, d0 + d), bars[d] = at_rank(b.bar(BAR_Q), d0 + d);
      if (n * 8 + token < T)
#pragma unroll
        for (int d = 0; d < 4; ++d) send(data[d], v, bars[d]);
    }
  }
  if (IDLE_Q && threadIdx.x < S) send(at_rank(b.base + M_TOKEN, threadIdx.x), 0, at_rank(b.bar(BAR_Q), threadIdx.x));
}
constexpr u32 Q_EXPECT = HD * T * 2 + (IDLE_Q ? S * 4 : 0);
