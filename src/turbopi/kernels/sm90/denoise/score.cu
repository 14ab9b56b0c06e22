// Attention's steps, of which attention.cu and many/attention.cu make the whole.

// Who does what: the first SCORERS warps score a tile of prefix keys each, and the next if there are more; the last
// four score the suffix's keys, a quarter of the columns each, as they come through L2 and so later than the queries.
// If tokens are few (HOLD) the other eight warps weigh the values, and keys and values wait in registers for queries
// and weights; else all warps weigh, and the third warpgroup fetches the suffix's values. Queries of many tokens are
// more than shared memory can bring to each warp by itself (ASYNC): see many/attention.cu.
constexpr int LEADER = SCORERS - 1, SUFFIX_WARP = 12;
// Blocks of its keys that a scoring warp holds, tiles of values that a weighing warp does: more would spill.
constexpr int HELD_KEYS = QT < 12 ? QT : 12, HELD_TILES = KT < 4 ? KT : 4;
constexpr int WEIGHERS = HOLD ? W - SCORERS : W, CT = most(QT, WEIGHERS);  // tiles of columns of a weighing warp
constexpr int SUFFIX_STEPS = most(QT, 4);                                   // blocks of columns of a suffix warp
// Barriers of some warps; 1 is consumers_sync's.
constexpr int TOPS = 2, SUFFIX_SUMS = 3, WEIGHTS = 4, WEIGHTS_FOR_SUFFIX = 5, SUFFIX_WEIGHTS = 6;

// The keys of this rank.
struct Keys : PrefixShare {
  int slots;            // that tiles of prefix keys, or values, take
  int suffix0, suffix;  // the first of the suffix's keys, how many
  __device__ __forceinline__ Keys(const Cta& b, int all) : PrefixShare(all, b.rank()) {
    slots = most(tiles, SLOT_TILES);
    suffix0 = share(T, S, b.rank()), suffix = share(T, S, b.rank() + 1) - suffix0;
  }
};

// A lane's address for `mma_tokens` in activations [block][half][NT][8 tokens][8 columns], standard order.
__device__ __forceinline__ u32 token_address(const Cta& b, u32 region) {
  return b.base + region + ((b.lane() >> 3 & 1) * NT + (b.lane() >> 4)) * 128 + (b.lane() & 7) * 16;
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
__device__ __forceinline__ u32 score(const Cta& b, Fetch fetch, int first, int steps, float (&c)[NT][4]) {
  constexpr int CHAINS = !MANY && STEPS > 4 ? 2 : 1;
  float sums[CHAINS][NT][4];
#pragma unroll
  for (int i = 0; i < CHAINS; ++i) clear(sums[i]);
  u32 seen = 0;
  const u32 q = token_address(b, M_Q) + first * NT * 256;
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
  __device__ __forceinline__ void keep(const Cta& b) {
#pragma unroll 1
    for (bool again = true; again;) {
      again = false;
#pragma unroll
      for (int i = 0; i < MOST; ++i)
        if (missing(v[i], bit)) v[i] = peek(place(i)), again = true;
      again = __any_sync(~0u, again);
    }
#pragma unroll
    for (int i = 0; i < MOST; ++i) {
      const int row = item(i) / quads, quad = first + item(i) % quads;
      const uint2 four = make_uint2(pack(__uint_as_float(v[i].x), __uint_as_float(v[i].y)),
                                    pack(__uint_as_float(v[i].z), __uint_as_float(v[i].w)));
      *(uint2*)(b.smem + suffix_place(kind, row, quad)) = four;
    }
  }
};

// Logits of the rank's suffix keys, by the last four warps; SUFFIX_WARP gets them.
__device__ __forceinline__ void score_suffix(const Cta& b, int count, float (&c)[NT][4]) {
  const int part = b.warp() - SUFFIX_WARP, first = share(QT, 4, part), steps = share(QT, 4, part + 1) - first;
  const u32 from = b.base + M_X + X_KEY_ROWS + min(b.lane() & 7, count - 1) * RS + first * 32 + (b.lane() >> 4) * 16;
  auto fetch = [&](int k) {  // rows beyond the last key hold anything
    uint4 v;
    ldmatrix(v, from + k * 32);
    return v;
  };
  score<SUFFIX_STEPS, SUFFIX_STEPS>(b, fetch, first, steps, c);
  float2* sums = (float2*)(b.smem + M_X + X_SUFFIX_SUMS) + b.lane();
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

__device__ __forceinline__ float no_logit() { return __int_as_float(0xff800000); }  // of a key that doesn't exist
__device__ __forceinline__ float logit_scale() { return rsqrtf(float(HD)) * 1.4426950408889634f; }  // and log2 e
// Logits times the scale, or none in rows that don't exist (or that a token of a pair doesn't see); the largest of each
// token.
template <int R>
__device__ __forceinline__ void scale_logits(const Cta& b, float (&c)[R][NT][4], int rows OF_PAIR(, Mask mask),
                                             float2 (&top)[NT]) {
  const float scale = logit_scale(), none = no_logit();
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    top[n] = make_float2(none, none);
#pragma unroll
    for (int r = 0; r < R; ++r) {
#pragma unroll
      for (int i = 0; i < 4; ++i)
        c[r][n][i] = b.g() + (i >> 1) * 8 < rows - r * SCORERS * 16 OF_PAIR(
                         && mask.sees(r * SCORERS * 16 + b.g() + (i >> 1) * 8, n * 8 + 2 * b.t() + (i & 1)))
                         ? c[r][n][i] * scale
                         : none;
      top[n].x = fmaxf(top[n].x, fmaxf(c[r][n][0], c[r][n][2]));
      top[n].y = fmaxf(top[n].y, fmaxf(c[r][n][1], c[r][n][3]));
    }
#pragma unroll
    for (int o = 4; o < 32; o *= 2)
      top[n] = make_float2(fmaxf(top[n].x, exchange(top[n].x, o)), fmaxf(top[n].y, exchange(top[n].y, o)));
  }
}
// Unnormalised weights of logits that lack a scale, by `top`. 16 keys' to shared memory, `to` a tile's place: operand B
// of the next product, in which column 2i is row i, column 2i + 1 row i + 8.
__device__ __forceinline__ float weight(float logit, float top, float scale = 1) {
  return exp2_approx(logit * scale - top);
}
__device__ __forceinline__ byte* weights_place(const Cta& b, int tile) {
  return b.smem + M_X + X_P + (tile * 2 + (b.g() >> 2)) * NT * 128 + b.t() * 32 + (b.g() & 3) * 4;
}
__device__ __forceinline__ void store_weights(byte* to, const float (&c)[NT][4], const float2 (&top)[NT],
                                              float scale = 1) {
#pragma unroll
  for (int n = 0; n < NT; ++n)
#pragma unroll
    for (int i = 0; i < 2; ++i) {
      const float at = i ? top[n].y : top[n].x;
      *(u32*)(to + n * 128 + i * 16) = pack(weight(c[n][i], at, scale), weight(c[n][i + 2], at, scale));
    }
}
// The largest logits of the rank's prefix.
__device__ __forceinline__ void load_tops(const Cta& b, float2 (&top)[NT], float scale = 1) {
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    const int2 v = *(const int2*)(b.smem + M_PART + (n * 8 + 2 * b.t()) * 4);
    top[n] = make_float2(__int_as_float(ordered(v.x)) * scale, __int_as_float(ordered(v.y)) * scale);
  }
}
// Warps that score: weights of tiles `tile`, tile + SCORERS.., of whose rows `rows`, rows - 16 SCORERS.. exist. The
// mask is that of the first one.
template <int R>
__device__ __forceinline__ void weigh_prefix(const Cta& b, float (&c)[R][NT][4], int tile,
                                             int rows OF_PAIR(, Mask mask)) {
  float2 top[NT];
  if (rows > 0) {
    scale_logits(b, c, rows OF_PAIR(, mask), top);
#pragma unroll
    for (int n = 0; n < NT; ++n)
      if (b.g() < 2)
        atomicMax((int*)(b.smem + M_PART) + n * 8 + 2 * b.t() + b.g(), ordered(b.g() ? top[n].y : top[n].x));
  }
  sync<TOPS, SCORERS>();
  load_tops(b, top);
#pragma unroll
  for (int r = 0; r < R; ++r)
    if (rows > r * SCORERS * 16) store_weights(weights_place(b, tile + r * SCORERS), c[r], top);
}
// Of each token something of this rank, to all ranks.
__device__ __forceinline__ void send_by_token(const Cta& b, const float2 (&v)[NT], int region, int bar) {
  const u32 to = at_rank(b.base + M_X + region + (b.rank() * NT * 8 + 2 * b.t()) * 4, b.g());
  const u32 at = at_rank(b.bar(bar), b.g());
#pragma unroll
  for (int n = 0; n < NT; ++n)
    if (n * 8 + 2 * b.t() < T) send(to + n * 32, __float_as_uint(v[n].x), __float_as_uint(v[n].y), at);
}
constexpr u32 TOPS_EXPECT = S * ((T + 1) / 2) * 8;
// The suffix's keys come last. Their weights go by the prefix's largest logits, too, unless theirs are
// so much larger (2^64) that the prefix's weights count for nothing: then those are dropped, which `X_KEEP` says.
__device__ __forceinline__ void weigh_suffix(const Cta& b, float (&c)[1][NT][4], int rows OF_PAIR(, Mask mask)) {
  float2 own[NT], top[NT];
  scale_logits(b, c, rows OF_PAIR(, mask), own);
  sync<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
  load_tops(b, top);
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    const bool x = own[n].x <= top[n].x + 64, y = own[n].y <= top[n].y + 64;
    if (b.g() == 0) *(float2*)(b.smem + M_X + X_KEEP + (n * 8 + 2 * b.t()) * 4) = make_float2(x, y);
    top[n] = make_float2(x ? top[n].x : own[n].x, y ? top[n].y : own[n].y);
  }
  store_weights(weights_place(b, KT), c[0], top);
  if (HOLD) arrive<SUFFIX_WEIGHTS, WEIGHERS + 1>();
  send_by_token(b, top, X_TOPS, BAR_TOPS);
}
__device__ __forceinline__ void keep_prefix(const Cta& b, float (&c)[NT][4]) {
#pragma unroll
  for (int n = 0; n < NT; ++n) {
    const float2 keep = *(const float2*)(b.smem + M_X + X_KEEP + (n * 8 + 2 * b.t()) * 4);
    c[n][0] *= keep.x, c[n][1] *= keep.y, c[n][2] *= keep.x, c[n][3] *= keep.y;
  }
}
// The sums of the weights of 8 tokens, as rounded: a product with ones.
__device__ __forceinline__ void send_some_sums(const Cta& b, int n, int tiles, int suffix) {
  float c[4] = {0, 0, 0, 0};
  const u32 one = 0x3f803f80;
  const u32 from = b.base + M_X + X_P + ((b.lane() >> 3) * NT + n) * 128 + (b.lane() & 7) * 16;
  auto add = [&](int tile, bool both) {
    uint4 v;
    ldmatrix(v, from + tile * NT * 256);
    mma(c, make_uint4(one, one, one, one), make_uint2(v.x, v.y));
    if (both) mma(c, make_uint4(one, one, one, one), make_uint2(v.z, v.w));
  };
#pragma unroll
  for (int tile = 0; tile < KT; tile += 2)
    if (tile < tiles) add(tile, tile + 1 < tiles);
  if (suffix > 0) add(KT, false);
  const u32 to = at_rank(b.base + M_X + X_SUMS + ((b.rank() * NT + n) * 8 + 2 * b.t()) * 4, b.g());
  if (n * 8 + 2 * b.t() < T)
    send(to, __float_as_uint(c[0]), __float_as_uint(c[1]), at_rank(b.bar(BAR_COMB), b.g()));
}
// The same of all tokens, by one warp.
__device__ __forceinline__ void send_sums(const Cta& b, int tiles, int suffix) {
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
