// Part 6 of 7: queries, keys and values of the suffix, and attention. The keys are split over the ranks of the head's
// cluster.

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
  store_partials<QTL + KVL>(b, b.smem + M_X, qn + kvn, sums);
  consumers_sync();
  if (threadIdx.x < NT * 8) ((int*)(b.smem + M_PART))[threadIdx.x] = ordered(LOWEST);  // for `weigh_prefix`
  byte* const staged = b.smem + M_H + H_ATT;  // free until all have what attention sends: [item][half][8 tokens][8]
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
  static_assert(S == 8, "half a warp serves half of the ranks");
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp + j * W;
    if (i < qn * NT) {
      const int n = i / qn, half = b.lane >> 3 & 1, token = b.lane & 7, d0 = b.lane >> 4 << 2;
      const float4 v = *(const float4*)(staged + i * 256 + (b.lane & 15) * 16);
      const u32 to = b.base + M_H + H_Q + ((b.q0() + i % qn + half * QT) * NT + n) * 128 + token * 16;
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

// Who does what: the first SCORERS warps score a tile of prefix keys each, or two if there are more; the last four
// score the suffix's keys, a quarter of the columns each, as they come through L2 and so later than the queries. If
// tokens are few (HOLD) the other eight warps weigh the values, and keys and values wait in registers for queries and
// weights; else all warps weigh, and the third warpgroup fetches the suffix's values.
constexpr int SCORERS = 8, ROUNDS = most(KT, SCORERS), LEADER = SCORERS - 1, SUFFIX_WARP = 12;
constexpr bool HOLD = FEW && ROUNDS == 1 && KT <= 2 * SLOT_TILES && STAGES >= 4;
// Blocks of its keys that a scoring warp holds, tiles of values that a weighing warp does: more would spill.
constexpr int HELD_KEYS = QT < 12 ? QT : 12, HELD_TILES = KT < 4 ? KT : 4;
constexpr int WEIGHERS = HOLD ? W - SCORERS : W, CT = most(QT, WEIGHERS);  // tiles of columns of a weighing warp
constexpr int SUFFIX_STEPS = most(QT, 4);                                   // blocks of columns of a suffix warp
// Barriers of some warps; 1 is consumers_sync's.
constexpr int TOPS = 2, SUFFIX_SUMS = 3, WEIGHTS = 4, WEIGHTS_FOR_SUFFIX = 5, SUFFIX_WEIGHTS = 6;
template <int BARRIER, int WARPS>
__device__ __forceinline__ void arrive() {
  __syncwarp();
  asm volatile("bar.arrive %0, %1;" ::"n"(BARRIER), "n"(WARPS * 32) : "memory");
}
template <int BARRIER, int WARPS>
__device__ __forceinline__ void sync() {
  __syncwarp();
  asm volatile("bar.sync %0, %1;" ::"n"(BARRIER), "n"(WARPS * 32) : "memory");
}

// A lane's address for `mma_tokens` in activations [block][half][NT][8 tokens][8 columns], standard order.
__device__ __forceinline__ u32 token_address(const Block& b, u32 region) {
  return b.base + region + ((b.lane >> 3 & 1) * NT + (b.lane >> 4)) * 128 + (b.lane & 7) * 16;
}
// One block: a tile's rows times all tokens. What is read beyond the last tokens isn't used.
__device__ __forceinline__ void mma_tokens(float (&c)[NT][4], uint4 a, u32 from) {
#pragma unroll
  for (int n = 0; n < NT; n += 2) {
    uint4 v;
    ldmatrix(v, from + n * 128);
    mma(c[n], a, make_uint2(v.x, v.y));
    if (n + 1 < NT) mma(c[n + 1], a, make_uint2(v.z, v.w));
  }
}

// Logits of 16 keys over STEPS blocks of columns from block `first` on, `steps` of which exist. fetch(k) is the k-th
// fragment of the keys. Returns a word that needs all it read, for give_slot.
template <int STEPS, int UNROLL, typename Fetch>
__device__ __forceinline__ u32 score(const Block& b, Fetch fetch, int first, int steps, float (&c)[NT][4]) {
  constexpr int CHAINS = FEW && STEPS > 4 ? 2 : 1;
  float sums[CHAINS][NT][4];
#pragma unroll
  for (int i = 0; i < CHAINS; ++i) clear(sums[i]);
  u32 seen = 0;
  const u32 q = token_address(b, M_H + H_Q) + first * NT * 256;
#pragma unroll(UNROLL)
  for (int k = 0; k < STEPS; ++k)
    if (QT % 4 == 0 || k < steps) {
      const uint4 a = fetch(k);
      seen ^= a.x;
      mma_tokens(sums[k % CHAINS], a, q + k * NT * 256);
    }
#pragma unroll
  for (int n = 0; n < NT; ++n)
#pragma unroll
    for (int i = 0; i < 4; ++i) c[n][i] = CHAINS == 2 ? sums[0][n][i] + sums[CHAINS - 1][n][i] : sums[0][n][i];
  return seen;
}

// Suffix keys (kind 0) or values (1) from all clusters to shared memory, asked for first and kept later: of `rows` of
// them, from `row0` on, `quads` times four columns from quad `first` on, by `threads` threads.
template <int MOST>
struct SuffixPart {
  const float* kv;
  u32 bit;
  int kind, me, threads, row0, rows, first, quads;
  uint4 v[MOST];
  __device__ __forceinline__ int item(int i) const {  // the last more than once
    return min(me + i * threads, rows * quads - 1);
  }
  __device__ __forceinline__ const uint4* place(int i) const {
    return (const uint4*)(kv + size_t(row0 + item(i) / quads) * 2 * HD + kind * HD) + first + item(i) % quads;
  }
  __device__ __forceinline__ void ask() {
#pragma unroll
    for (int i = 0; i < MOST; ++i) v[i] = peek(place(i));
  }
  __device__ __forceinline__ void keep(const Block& b) {
#pragma unroll 1
    for (bool again = true; again;) {
      again = false;
#pragma unroll
      for (int i = 0; i < MOST; ++i)
        if (missing(v[i], bit)) v[i] = peek(place(i)), again = true;
    }
#pragma unroll
    for (int i = 0; i < MOST; ++i)
      *(uint2*)(b.smem + M_X + X_SUFFIX + (kind * SUFFIX + item(i) / quads) * RS + (first + item(i) % quads) * 8) =
          make_uint2(pack(__uint_as_float(v[i].x), __uint_as_float(v[i].y)),
                     pack(__uint_as_float(v[i].z), __uint_as_float(v[i].w)));
  }
};

// Logits of the rank's suffix keys, by the last four warps; SUFFIX_WARP gets them.
__device__ __forceinline__ void score_suffix(const Block& b, int count, float (&c)[NT][4]) {
  const int part = b.warp - SUFFIX_WARP, first = share(QT, 4, part), steps = share(QT, 4, part + 1) - first;
  const u32 from = b.base + M_X + X_SUFFIX + min(b.lane & 7, count - 1) * RS + first * 32 + (b.lane >> 4) * 16;
  auto fetch = [&](int k) {  // rows beyond the last key hold anything
    uint4 v;
    ldmatrix(v, from + k * 32);
    return v;
  };
  score<SUFFIX_STEPS, SUFFIX_STEPS>(b, fetch, first, steps, c);
  float2* sums = (float2*)(b.smem + M_X + X_SUFFIX_SUMS) + b.lane;
  if (part > 0) {
#pragma unroll
    for (int n = 0; n < NT; ++n) sums[((part - 1) * NT + n) * 32] = make_float2(c[n][0], c[n][1]);
    arrive<SUFFIX_SUMS, 4>();
  } else {
    sync<SUFFIX_SUMS, 4>();
#pragma unroll
    for (int i = 0; i < 3; ++i)
#pragma unroll
      for (int n = 0; n < NT; ++n) {
        const float2 v = sums[(i * NT + n) * 32];
        c[n][0] += v.x, c[n][1] += v.y;
      }
  }
}

// Logits times the scale and log2 e, or -inf in rows that don't exist; the largest of each token.
template <int R>
__device__ __forceinline__ void scale_logits(const Block& b, float (&c)[R][NT][4], int rows, float2 (&top)[NT]) {
  const float scale = rsqrtf(float(HD)) * 1.4426950408889634f, none = __int_as_float(0xff800000);
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    top[n] = make_float2(none, none);
#pragma unroll
    for (int r = 0; r < R; ++r) {
#pragma unroll
      for (int i = 0; i < 4; ++i)
        c[r][n][i] = b.g() + (i >> 1) * 8 < rows - r * SCORERS * 16 ? c[r][n][i] * scale : none;
      top[n].x = fmaxf(top[n].x, fmaxf(c[r][n][0], c[r][n][2]));
      top[n].y = fmaxf(top[n].y, fmaxf(c[r][n][1], c[r][n][3]));
    }
#pragma unroll
    for (int o = 4; o < 32; o *= 2)
      top[n] = make_float2(fmaxf(top[n].x, exchange(top[n].x, o)), fmaxf(top[n].y, exchange(top[n].y, o)));
  }
}
// Unnormalised weights of 16 keys to shared memory: operand B of the next product, in which column 2i is row i, column
// 2i + 1 row i + 8.
__device__ __forceinline__ void store_weights(const Block& b, const float (&c)[NT][4], int tile,
                                              const float2 (&top)[NT]) {
  byte* p = b.smem + M_X + X_P + (tile * 2 + (b.g() >> 2)) * NT * 128 + b.t() * 32 + (b.g() & 3) * 4;
#pragma unroll
  for (int n = 0; n < NT; ++n)
#pragma unroll
    for (int i = 0; i < 2; ++i) {
      const float at = i ? top[n].y : top[n].x;
      *(u32*)(p + n * 128 + i * 16) = pack(exp2_approx(c[n][i] - at), exp2_approx(c[n][i + 2] - at));
    }
}
// The largest logits of the rank's prefix.
__device__ __forceinline__ void load_tops(const Block& b, float2 (&top)[NT]) {
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    const int2 v = *(const int2*)(b.smem + M_PART + (n * 8 + 2 * b.t()) * 4);
    top[n] = make_float2(__int_as_float(ordered(v.x)), __int_as_float(ordered(v.y)));
  }
}
// Scoring warps: weights of tiles `tile`, tile + SCORERS.., of whose rows `rows`, rows - 16 SCORERS.. exist.
template <int R>
__device__ __forceinline__ void weigh_prefix(const Block& b, float (&c)[R][NT][4], int tile, int rows) {
  float2 top[NT];
  if (rows > 0) {
    scale_logits(b, c, rows, top);
#pragma unroll
    for (int n = 0; n < NT; ++n)
      if (b.g() < 2)
        atomicMax((int*)(b.smem + M_PART) + n * 8 + 2 * b.t() + b.g(), ordered(b.g() ? top[n].y : top[n].x));
  }
  sync<TOPS, SCORERS>();
  load_tops(b, top);
#pragma unroll
  for (int r = 0; r < R; ++r)
    if (rows > r * SCORERS * 16) store_weights(b, c[r], tile + r * SCORERS, top);
}
// Of each token something of this rank, to all ranks.
__device__ __forceinline__ void send_by_token(const Block& b, const float2 (&v)[NT], int region, int bar) {
  const u32 to = at_rank(b.base + M_X + region + (b.rank * NT * 8 + 2 * b.t()) * 4, b.g());
  const u32 at = at_rank(b.bar(bar), b.g());
#pragma unroll
  for (int n = 0; n < NT; ++n)
    if (n * 8 + 2 * b.t() < T) send(to + n * 32, __float_as_uint(v[n].x), __float_as_uint(v[n].y), at);
}
constexpr u32 TOPS_EXPECT = S * ((T + 1) / 2) * 8;
__device__ __forceinline__ u32 outputs_expect(const Block& b) {
  return S * ((T + 1) / 2) * 8 + S * b.qn() * ((T + 1) / 2) * 128;
}
// The suffix's keys come last. Their weights go by the prefix's largest logits, too, unless theirs are so much larger
// (2^64) that the prefix's weights count for nothing: then those are dropped, which `X_KEEP` says.
__device__ __forceinline__ void weigh_suffix(const Block& b, float (&c)[1][NT][4], int rows) {
  float2 own[NT], top[NT];
  scale_logits(b, c, rows, own);
  sync<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
  load_tops(b, top);
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    const bool x = own[n].x <= top[n].x + 64, y = own[n].y <= top[n].y + 64;
    if (b.g() == 0) *(float2*)(b.smem + M_X + X_KEEP + (n * 8 + 2 * b.t()) * 4) = make_float2(x, y);
    top[n] = make_float2(x ? top[n].x : own[n].x, y ? top[n].y : own[n].y);
  }
  store_weights(b, c[0], KT, top);
  if (HOLD) arrive<SUFFIX_WEIGHTS, WEIGHERS + 1>();
  send_by_token(b, top, X_TOPS, BAR_TOPS);
}
__device__ __forceinline__ void keep_prefix(const Block& b, float (&c)[NT][4]) {
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    const float2 keep = *(const float2*)(b.smem + M_X + X_KEEP + (n * 8 + 2 * b.t()) * 4);
    c[n][0] *= keep.x, c[n][1] *= keep.y, c[n][2] *= keep.x, c[n][3] *= keep.y;
  }
}
// The sums of the weights, as rounded: a product with ones.
__device__ __forceinline__ void send_sums(const Block& b, int tiles, int suffix) {
  float c[NT][4];
  clear(c);
  const u32 p = token_address(b, M_X + X_P), one = 0x3f803f80;
#pragma unroll
  for (int tile = 0; tile < KT; ++tile)
    if (tile < tiles) mma_tokens(c, make_uint4(one, one, one, one), p + tile * NT * 256);
  if (HOLD) sync<SUFFIX_WEIGHTS, WEIGHERS + 1>();
  keep_prefix(b, c);
  if (suffix > 0) mma_tokens(c, make_uint4(one, one, one, one), p + KT * NT * 256);
  float2 sums[NT];
#pragma unroll
  for (int n = 0; n < NT; ++n) sums[n] = make_float2(c[n][0], c[n][1]);
  send_by_token(b, sums, X_SUMS, BAR_COMB);
}

// Attention of this cluster's head, to region H of all ranks. Everything local lies in region X.
__device__ __forceinline__ void attend(Block& b, const float* kv, u32 bit, int prefix_all) {
  b.forget();
  asm volatile("" : "+r"(prefix_all));
  const int all = most(prefix_all, 16), tile0 = share(all, S, b.rank), tiles = share(all, S, b.rank + 1) - tile0;
  const int prefix = min(tiles * 16, prefix_all - tile0 * 16), slots = most(tiles, SLOT_TILES);
  const int suffix0 = share(T, S, b.rank), suffix = share(T, S, b.rank + 1) - suffix0;
  const bool scorer = b.warp < SCORERS, for_suffix = b.warp >= SUFFIX_WARP;
  const int column = (b.warp - (W - WEIGHERS)) * CT;  // this warp's first tile of them
  constexpr int MOST_SLOTS = most(KT, SLOT_TILES);
  auto pass = [&] {  // slots that a warp has no use for
#pragma unroll 1
    for (int i = 0; i < slots; ++i) give_slot(b, take_slot(b), 0);
  };
  // Keys: a warp those columns that it scores. Values: a warp those that it weighs, or the third warpgroup all.
  const int k0 = share(QT, 4, b.warp - SUFFIX_WARP), key_steps = share(QT, 4, b.warp - SUFFIX_WARP + 1) - k0;
  const bool some_keys = suffix > 0 && for_suffix && key_steps > 0;
  const bool some_values = suffix > 0 && (HOLD ? column < QT : b.warp >= SCORERS && !for_suffix);
  SuffixPart<most(SUFFIX * SUFFIX_STEPS * 4, 32)> suffix_keys{kv,      bit,    0,      b.lane,       32,
                                                              suffix0, suffix, k0 * 4, key_steps * 4};
  constexpr int VALUE_THREADS = HOLD ? 32 : 128;
  SuffixPart<most(SUFFIX * (HOLD ? CT * 4 : HD / 4), VALUE_THREADS)> suffix_values{
      kv,      bit,    1, int(threadIdx.x) & (VALUE_THREADS - 1), VALUE_THREADS,
      suffix0, suffix, HOLD ? column * 4 : 0, HOLD ? min(CT, QT - column) * 4 : HD / 4};
  auto ask_suffix = [&] {
    if (some_keys) suffix_keys.ask();
    if (some_values) suffix_values.ask();
  };
  auto of_suffix = [&] {
    float c[1][NT][4];
    clear(c[0]);
    if (some_keys) suffix_keys.keep(b);
    __syncwarp();
    if (suffix > 0) score_suffix(b, suffix, c[0]);
    if (b.warp == SUFFIX_WARP)
      weigh_suffix(b, c, suffix);
    else
      sync<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
  };
  auto clear_out = [&](float (&out)[CT][NT][4]) {
#pragma unroll
    for (int j = 0; j < CT; ++j) clear(out[j]);
  };
  uint4 last[CT];  // of the suffix's values
  u32 to[CT], to_bar[CT];
  auto prepare_outputs = [&] {
    const int row = min(((b.lane & 7) + (b.lane >> 4 << 3)) >> 1, suffix - 1);  // the others' weights are 0
#pragma unroll
    for (int j = 0; j < CT; ++j) {
      const int tile = min(column + j, QT - 1), owner = ((tile + 1) * S - 1) / QT, in = tile - share(QT, S, owner);
      last[j] = make_uint4(0, 0, 0, 0);
      if (suffix > 0)
        ldmatrix_transposed(last[j], b.base + M_X + X_SUFFIX + (SUFFIX + row) * RS + (tile * 16 + (b.lane & 8)) * 2);
      constexpr bool ONE_OWNER = QT % S == 0 && QTL % CT == 0;
      if (ONE_OWNER && j > 0) {
        to[j] = to[0] + j * NT * 512, to_bar[j] = to_bar[0];
        continue;
      }
      to[j] = at_rank(b.base + M_X + X_COMB + (b.rank * QTL + in) * NT * 512 + b.lane * 16, owner);
      to_bar[j] = at_rank(b.bar(BAR_COMB), owner);
    }
  };
  auto send_outputs = [&](float (&out)[CT][NT][4]) {  // after the suffix has had its part in them
    if (HOLD && b.warp != SUFFIX_WARP) sync<SUFFIX_WEIGHTS, WEIGHERS + 1>();
#pragma unroll
    for (int j = 0; j < CT; ++j)
      if (column + j < QT) {
        keep_prefix(b, out[j]);
        if (suffix > 0) mma_tokens(out[j], last[j], token_address(b, M_X + X_P) + KT * NT * 256);
#pragma unroll
        for (int n = 0; n < NT; ++n)
          if (n * 8 + 2 * b.t() < T)
            send(to[j] + n * 512, make_float4(out[j][n][0], out[j][n][1], out[j][n][2], out[j][n][3]), to_bar[j]);
      }
  };
  if constexpr (HOLD) {
    if (scorer) {
      uint4 keys[HELD_KEYS];  // zeros at first, or ptxas believes that those of the last layer are still wanted
#pragma unroll
      for (int k = 0; k < HELD_KEYS; ++k) keys[k] = make_uint4(0, 0, 0, 0);
      u32 mine = b.slot;  // the slot of this warp's tile
#pragma unroll 1
      for (int i = 0; i < slots; ++i) {
        const u32 slot = take_slot(b);
        if (b.warp / SLOT_TILES == i && b.warp < tiles) {
          mine = slot;
#pragma unroll
          for (int k = 0; k < HELD_KEYS; ++k)
            keys[k] = load_fragment(b.ring(slot) + b.warp % SLOT_TILES * KEY_TILE + k * FRAGMENT, b.lane);
        } else {
          give_slot(b, slot, 0);
        }
      }
      pass();
      receive(b, BAR_Q, b.n, Q_EXPECT, WAIT_Q);
      b.forget();
      MARK(3)
      float c[1][NT][4];
      clear(c[0]);
      if (b.warp < tiles) {
        const byte* from = b.ring(mine) + b.warp % SLOT_TILES * KEY_TILE;
        float rest[NT][4];
        score<HELD_KEYS, HELD_KEYS>(b, [&](int k) { return keys[k]; }, 0, QT, c[0]);
        auto fetch = [&](int k) { return load_fragment(from + (HELD_KEYS + k) * FRAGMENT, b.lane); };
        const u32 seen = score<QT - HELD_KEYS, 4>(b, fetch, HELD_KEYS, QT, rest);
#pragma unroll
        for (int n = 0; n < NT; ++n)
#pragma unroll
          for (int i = 0; i < 4; ++i) c[0][n][i] += rest[n][i];
        give_slot(b, mine, seen);
      }
      MARK(4)
      weigh_prefix(b, c, b.warp, prefix - b.warp * 16);
      arrive<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
      if (b.warp == LEADER) {
        sync<WEIGHTS, SCORERS + 4>();
        send_sums(b, tiles, suffix);
      } else {
        arrive<WEIGHTS, SCORERS + 4>();
      }
    } else {
      pass();
      uint4 values[HELD_TILES][CT];  // zeros at first, as the keys
      auto load = [&](u32 slot, int i, int j) {
        return load_fragment(b.ring(slot) + i * KEY_TILE + (column + j) * FRAGMENT, b.lane);
      };
      auto exists = [&](int j) { return QT % WEIGHERS == 0 || column + j < QT; };
#pragma unroll
      for (int i = 0; i < HELD_TILES; ++i)
#pragma unroll
        for (int j = 0; j < CT; ++j) values[i][j] = make_uint4(0, 0, 0, 0);
      u32 slot = 0;
#pragma unroll
      for (int i = 0; i < MOST_SLOTS; ++i)
        if (i < slots) {
          slot = take_slot(b);
          u32 seen = 0;
#pragma unroll
          for (int tile = i * SLOT_TILES; tile < HELD_TILES && tile < (i + 1) * SLOT_TILES; ++tile)
            if (tile < tiles)
#pragma unroll
              for (int j = 0; j < CT; ++j)
                if (exists(j)) values[tile][j] = load(slot, tile % SLOT_TILES, j), seen ^= fold(values[tile][j]);
          if (i == 0 || tiles <= HELD_TILES) give_slot(b, slot, seen);
        }
      b.forget();
      ask_suffix();
      if (for_suffix) {
        receive(b, BAR_Q, b.n, Q_EXPECT, WAIT_Q);
        of_suffix();
      }
      if (some_values) suffix_values.keep(b);
      __syncwarp();
      prepare_outputs();
      if (!for_suffix) sync<WEIGHTS, SCORERS + 4>();
      float out[CT][NT][4];
      clear_out(out);
      auto weigh = [&](int tile, int j, uint4 v) {
        mma_tokens(out[j], v, token_address(b, M_X + X_P) + tile * NT * 256);
      };
#pragma unroll
      for (int i = 0; i < HELD_TILES; ++i)
        if (i < tiles)
#pragma unroll
          for (int j = 0; j < CT; ++j)
            if (exists(j)) weigh(i, j, values[i][j]);
      if (tiles > HELD_TILES) {
        u32 seen = 0;
#pragma unroll 1
        for (int i = HELD_TILES; i < tiles; ++i)
#pragma unroll
          for (int j = 0; j < CT; ++j)
            if (exists(j)) {
              const uint4 v = load(slot, i - SLOT_TILES, j);
              seen ^= fold(v);
              weigh(i, j, v);
            }
        give_slot(b, slot, seen);
      }
      send_outputs(out);
    }
  } else {
    receive(b, BAR_Q, b.n, Q_EXPECT, WAIT_Q);
    MARK(3)
    float c[ROUNDS][NT][4];
#pragma unroll
    for (int r = 0; r < ROUNDS; ++r) clear(c[r]);
#pragma unroll
    for (int i = 0; i < MOST_SLOTS; ++i)
      if (i < slots) {
        const u32 slot = take_slot(b);
        u32 seen = 0;
#pragma unroll
        for (int r = 0; r < ROUNDS; ++r) {
          const int tile = b.warp + r * SCORERS;
          if (scorer && tile / SLOT_TILES == i && tile < tiles) {
            const byte* from = b.ring(slot) + tile % SLOT_TILES * KEY_TILE;
            seen ^= score<QT, 4>(b, [&](int k) { return load_fragment(from + k * FRAGMENT, b.lane); }, 0, QT, c[r]);
          }
        }
        give_slot(b, slot, seen);
      }
    MARK(4)
    if (scorer) {
      weigh_prefix(b, c, b.warp, prefix - b.warp * 16);
      arrive<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
    }
    ask_suffix();
    if (some_values) suffix_values.keep(b);
    if (for_suffix) of_suffix();
    consumers_sync();
  }
  MARK(5)
  if constexpr (!HOLD) {
    float out[CT][NT][4];
    clear_out(out);
#pragma unroll 1
    for (int i = 0; i < slots; ++i) {
      const u32 slot = take_slot(b);
      const byte* from = b.ring(slot) + b.warp * FRAGMENT;
      u32 seen = 0;
      if (b.warp < QT) {
#pragma unroll
        for (int sub = 0; sub < SLOT_TILES; ++sub)
          if (i * SLOT_TILES + sub < tiles) {
            const uint4 v = load_fragment(from + sub * KEY_TILE, b.lane);
            seen ^= fold(v);
            mma_tokens(out[0], v, token_address(b, M_X + X_P) + (i * SLOT_TILES + sub) * NT * 256);
          }
      }
      give_slot(b, slot, seen);
    }
    prepare_outputs();
    send_outputs(out);
    if (b.warp == LEADER) send_sums(b, tiles, suffix);
  }
  MARK(6)
  // Ranks' outputs, by their largest logits, which come first.
  b.forget();
  static_assert(QTL * NT <= W, "a warp for 8 tokens of a tile");
  const int qn = b.qn(), tile = b.warp % imax(qn, 1), n = b.warp / imax(qn, 1), token = n * 8 + 2 * b.t();
  const bool mine = b.warp < qn * NT;
  float2 w[S];
  receive(b, BAR_TOPS, b.n, TOPS_EXPECT, WAIT_TOPS);
  float2 highest = make_float2(LOWEST, LOWEST);
#pragma unroll
  for (int s = 0; s < S; ++s) {
    w[s] = *(const float2*)(b.smem + M_X + X_TOPS + (s * NT * 8 + min(token, NT * 8 - 2)) * 4);
    highest.x = fmaxf(highest.x, w[s].x), highest.y = fmaxf(highest.y, w[s].y);
  }
#pragma unroll
  for (int s = 0; s < S; ++s)
    w[s] = make_float2(exp2_approx(w[s].x - highest.x), exp2_approx(w[s].y - highest.y));
  MARK(7)
  receive(b, BAR_COMB, b.n, outputs_expect(b), WAIT_COMB);
  MARK(8)
  if (mine) {
    float4 o = make_float4(0, 0, 0, 0);
    float2 sum = make_float2(0, 0);
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const float4 v = *(const float4*)(b.smem + M_X + X_COMB + ((s * QTL + tile) * NT + n) * 512 + b.lane * 16);
      const float2 l = *(const float2*)(b.smem + M_X + X_SUMS + (s * NT * 8 + token) * 4);
      sum.x += w[s].x * l.x, sum.y += w[s].y * l.y;
      o.x += w[s].x * v.x, o.y += w[s].y * v.y, o.z += w[s].x * v.z, o.w += w[s].y * v.w;
    }
    const float x = __fdividef(1.0f, sum.x), y = __fdividef(1.0f, sum.y);
    send_columns(b, M_H + H_ATT, b.q0() + tile, n, make_float4(o.x * x, o.y * y, o.z * x, o.w * y), BAR_ATT, true);
  }
  MARK(9)
  receive(b, BAR_ATT, b.n, HD * T * 2, WAIT_ATT);
  MARK(10)
}
