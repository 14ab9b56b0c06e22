// Many tokens: attention by products that warps make together (ASYNC).
//
// Queries of many tokens are more than shared memory can bring to each warp by itself, so the four warps of a warpgroup
// share them, with keys or values in registers. The first eight warps score a tile of prefix keys each (those without
// one multiply, too, whatever they read). The suffix's keys come through L2 and so later, so other warps fetch them,
// and what the rank has of loose prefix keys; four of them score these rows as one more tile, for 16 tokens each, while
// the others fetch the rows' values. Then all weigh values, a tile of columns a warp.

// Barriers: of those who fetch rows; of those who score tiles of the prefix; of all but those who only fetch.
constexpr int ROWS_HERE = 3, TOPS_FOR_ROWS = 4, TOPS_FOR_ROWS_WARPS = SUFFIX_WARP;
// Clock cycles before the suffix's keys are asked for, at least: with loose keys it takes longer anyway.
constexpr u32 SUFFIX_PATIENCE = 200;
static_assert(!ASYNC || (W == 16 && QT <= W && KT <= SCORERS && NT <= 8), "a warp's share");

// Logits of a warpgroup's keys: each warp has 16 of its own, whose first blocks it holds; fetch(k) is the k-th block.
constexpr int SCORE_CHUNK = QT % 4 == 0 ? 4 : 1;
template <typename Fetch>
__device__ __forceinline__ void score_together(const Cta& b, uint4 (&now)[SCORE_CHUNK], Fetch fetch,
                                               float (&c)[NT][4]) {
  const u32 queries = operand_place(b.start() + M_Q, NT * 128);
  float sums[NT * 4];
#pragma unroll
  for (int i = 0; i < NT * 4; ++i) sums[i] = 0;
  uint4 next[SCORE_CHUNK];
#pragma unroll
  for (int k = 0; k < QT; k += SCORE_CHUNK) {
    begin_products();
#pragma unroll
    for (int i = 0; i < SCORE_CHUNK; ++i)
      add_rows(sums, now[i].x, now[i].y, now[i].z, now[i].w, operand_at<128>(behind(queries, (k + i) * NT * 256)), 1);
    commit_products();
    if (k + SCORE_CHUNK < QT)
#pragma unroll
      for (int i = 0; i < SCORE_CHUNK; ++i) next[i] = fetch(k + SCORE_CHUNK + i);
    await_products<0>();
#pragma unroll
    for (int i = 0; i < SCORE_CHUNK; ++i) keep_until_here(now[i]), now[i] = next[i];
  }
#pragma unroll
  for (int i = 0; i < NT * 4; ++i) c[i / 4][i % 4] = sums[i];
}
// Logits of the rows' keys, by the last warpgroup: each warp has 16 tokens, which here are operand A; c[j][0], c[j][1]
// of token g and keys 8j + 2t, 8j + 2t + 1, the others of token g + 8. Tokens that don't exist are any.
__device__ __forceinline__ void score_rows(float (&c)[2][4]) {
  const u32 queries = operand_place(Cta::start() + M_Q, NT * 128),
            keys = operand_place(Cta::start() + M_X + X_KEY_ROWS, KEY_COLUMNS);
  float sums[8];
#pragma unroll
  for (int i = 0; i < 8; ++i) sums[i] = 0;
  begin_products();
#pragma unroll
  for (int k = 0; k < QT; ++k)
    add_keys(sums, operand_at<128>(behind(queries, k * NT * 256)),
             operand_at<128>(behind(keys, k * 2 * KEY_COLUMNS)), 1);
  commit_products();
  await_products<0>();
#pragma unroll
  for (int i = 0; i < 8; ++i) c[i / 4][i % 4] = sums[i];
}
// To the rank's largest logits: this one of token 2t + g % 2 of 8 tokens n.
__device__ __forceinline__ void raise_top(const Cta& b, int n, float logit) {
  if (n < NT) atomicMax((int*)(b.smem + M_PART) + n * 8 + 2 * b.t() + (b.g() & 1), ordered(logit));
}
// Of each pair one number goes to the lane that bit O of g tells apart, which keeps the other: the larger of both
// stays.
template <int PAIRS_, int O, int N>
__device__ __forceinline__ void exchange_tops(const Cta& b, float (&v)[N]) {
  const bool upper = b.g() >> O & 1;
#pragma unroll
  for (int i = 0; i < PAIRS_; ++i) {
    const float mine = upper ? v[2 * i + 1] : v[2 * i], other = upper ? v[2 * i] : v[2 * i + 1];
    v[i] = fmaxf(mine, exchange(other, 4 << O));
  }
}
// The largest logit of each token among a warp's keys. Lane (g, t) has those of its own keys, for tokens 2t and 2t + 1
// of each 8. By exchanges of half of them, a quarter, an eighth it gets those of all keys for token 2t + g % 2 of 8
// tokens g / 2 and g / 2 + 4.
__device__ __forceinline__ void raise_tops(const Cta& b, const float (&c)[NT][4]) {
  constexpr int N = NT > 4 ? 16 : 8;
  float v[N];
#pragma unroll
  for (int i = 0; i < N; ++i) v[i] = i / 2 < NT ? fmaxf(c[i / 2 % NT][i % 2], c[i / 2 % NT][i % 2 + 2]) : no_logit();
  exchange_tops<N / 2, 0>(b, v), exchange_tops<N / 4, 1>(b, v), exchange_tops<N / 8, 2>(b, v);
#pragma unroll
  for (int i = 0; i < N / 8; ++i) raise_top(b, (b.g() >> 1) + 4 * i, v[i]);
}

// The rank's loose prefix keys (kind 0) or values (1), behind those of the suffix: asked for first and kept later, by
// THREADS_ threads.
template <int THREADS_>
struct LooseRows {
  static constexpr int EIGHTS = HD / 8, MOST = imax(most((ROWS - SUFFIX) * EIGHTS, THREADS_), 1);
  int kind, me, first, rows;  // of the rows behind them
  uint4 v[MOST];
  float times;
  __device__ __forceinline__ bool exists(int i) const { return me + i * THREADS_ < rows * EIGHTS; }
  __device__ __forceinline__ void ask(const Cta& b, int from) {
    const byte* const all = (kind ? b.a.cache_v : b.a.cache_k) + (b.n % L) * b.a.layer_stride + size_t(from) * HD * 2;
#pragma unroll
    for (int i = 0; i < MOST; ++i)
      if (exists(i)) v[i] = __ldg((const uint4*)all + me + i * THREADS_);
    if (FP8 && kind) times = __ldg(b.a.values_times + b.n % L);
  }
  __device__ __forceinline__ void keep(const Cta& b) {
    auto scaled = [&](u32 two) { return pack(bf16_low(two) * times, bf16_high(two) * times); };
#pragma unroll
    for (int i = 0; i < MOST; ++i)
      if (exists(i)) {
        const int at = me + i * THREADS_, row = first + at / EIGHTS, eight = at % EIGHTS;
        if (FP8 && kind) v[i] = make_uint4(scaled(v[i].x), scaled(v[i].y), scaled(v[i].z), scaled(v[i].w));
        *(uint4*)(b.smem + (kind ? M_X + X_VALUE_ROWS + row * RS + eight * 16 : key_row(row, eight))) = v[i];
      }
  }
};
// Of 16 tokens from 8 n on the rows' logits, `count` of which exist, to weights of the tile behind all others, as
// `store_weights` has them. They go by the largest logits of the prefix's tiles, too, unless theirs are 2^100 times as
// large: then the tiles' weights count for nothing, whatever they go by. What a token's weights go by to all ranks.
__device__ __forceinline__ void weigh_rows(const Cta& b, int n, int count) {
  float c[2][4], own[2] = {no_logit(), no_logit()};
  score_rows(c);
  MARK(MARK_ROWS_SCORED)
#pragma unroll
  for (int j = 0; j < 2; ++j)
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      c[j][i] = 8 * j + 2 * b.t() + i % 2 < count ? c[j][i] : no_logit();
      own[i / 2] = fmaxf(own[i / 2], c[j][i]);
    }
#pragma unroll
  for (int o = 1; o < 4; o *= 2)
#pragma unroll
    for (int i = 0; i < 2; ++i) own[i] = fmaxf(own[i], exchange(own[i], o));
  sync<TOPS_FOR_ROWS, TOPS_FOR_ROWS_WARPS>();
#pragma unroll
  for (int i = 0; i < 2; ++i)
    if (n + i < NT) {
      const int token = (n + i) * 8 + b.g();
      const float tiles_top = __int_as_float(ordered(*(const int*)(b.smem + M_PART + token * 4))) * logit_scale();
      const float top = fmaxf(tiles_top, own[i] * logit_scale() - 100);
      auto of = [&](float logit) { return weight(logit, top, logit_scale()); };
      auto both = [&](int key) { return pack(of(c[0][2 * i + key]), of(c[1][2 * i + key])); };
      *(uint2*)(b.smem + M_X + X_P + ((KT * 2 + (b.t() >> 1)) * NT + n + i) * 128 + b.g() * 16 + (b.t() & 1) * 8) =
          make_uint2(both(0), both(1));
      const u32 to = b.base + M_X + X_TOPS + (b.rank() * NT * 8 + token) * 4;
      if (token < T + T % 2)  // they are counted in pairs
#pragma unroll
        for (int d = b.t(); d < S; d += 4) send(at_rank(to, d), __float_as_uint(top), at_rank(b.bar(BAR_TOPS), d));
    }
}

__device__ __forceinline__ u32 slot_behind(u32 first, u32 i) {
  return first + i < STAGES ? first + i : first + i - STAGES;
}
// Values times weights, of a warp's tile of columns: of so many slots from the i-th on (missing tiles are zeros), and,
// if given, of the rows behind the tiles.
template <int SLOTS>
__device__ __forceinline__ void weigh_some(Cta& b, int i, u32 first, int tiles, u32 weights, float (&sums)[NT * 4],
                                           const uint4* rows = nullptr) {
  constexpr int N = SLOTS * SLOT_TILES;
  uint4 v[imax(N, 1)];
#pragma unroll
  for (int k = 0; k < N; ++k) {
    if (k % SLOT_TILES == 0) take_slot(b);
    v[k] = make_uint4(0, 0, 0, 0);
    if (i * SLOT_TILES + k < tiles)
      v[k] = load_fragment(b.ring(slot_behind(first, i + k / SLOT_TILES)) + min(b.warp(), QT - 1) * FRAGMENT +
                               k % SLOT_TILES * KEY_TILE,
                           b.lane());
  }
  begin_products();
#pragma unroll
  for (int k = 0; k < N; ++k)
    add_rows(sums, v[k].x, v[k].y, v[k].z, v[k].w,
             operand_at<128>(behind(weights, min(i * SLOT_TILES + k, tiles - 1) * NT * 256)), 1);
  if (rows) add_rows(sums, rows->x, rows->y, rows->z, rows->w, operand_at<128>(behind(weights, KT * NT * 256)), 1);
  commit_products();
  await_products<0>();
}
// Partial outputs of the rank's keys for all tokens: each rank's columns to it.
__device__ __forceinline__ void attend_together(Cta& b, const float* kv, u32 bit, const Keys& keys) {
  const int tiles = keys.tiles, slots = keys.slots, rows = keys.suffix + keys.loose;
  const u32 first_keys = b.slot;
  if (b.warp() < SCORERS) {
#pragma unroll 1
    for (int i = 0; i < slots; ++i) take_slot(b);
    const byte* const from = b.ring(slot_behind(first_keys, imax(imin(b.warp(), tiles - 1), 0) / SLOT_TILES)) +
                             b.warp() % SLOT_TILES * KEY_TILE;
    auto fetch = [&](int k) {
      return b.warp() < tiles ? load_fragment(from + k * FRAGMENT, b.lane()) : make_uint4(0, 0, 0, 0);
    };
    uint4 first[SCORE_CHUNK];
#pragma unroll
    for (int k = 0; k < SCORE_CHUNK; ++k) first[k] = fetch(k);
    receive(b, BAR_Q, b.n, Q_EXPECT, WAIT_Q);
    MARK(MARK_QUERIES_HERE)
    float c[NT][4];
    clear(c);
    if (b.warp() / 4 * 4 < tiles) {
      show_to_products();
      score_together(b, first, fetch, c);
    }
#pragma unroll 1
    for (int i = 0; i < slots; ++i) give_slot(b, slot_behind(first_keys, i));
    MARK(MARK_PREFIX_SCORED)
    if (b.warp() < tiles) {
      if (const int exist = keys.keys - b.warp() * 16; exist < 16)
#pragma unroll
        for (int n = 0; n < NT; ++n)
#pragma unroll
          for (int i = 0; i < 4; ++i) c[n][i] = b.g() + (i >> 1) * 8 < exist ? c[n][i] : no_logit();
      raise_tops(b, c);
      arrive<TOPS_FOR_ROWS, TOPS_FOR_ROWS_WARPS>();
      sync<TOPS, SCORERS>();
      byte* const to = weights_place(b, b.warp());
      float2 top[NT];
      load_tops(b, top, logit_scale());  // the scale goes into the exponents of the weights
      store_weights(to, c, top, logit_scale());
    } else {
      arrive<TOPS_FOR_ROWS, TOPS_FOR_ROWS_WARPS>();
      arrive<TOPS, SCORERS>();
    }
  } else {
    constexpr int FETCHERS = CONSUMERS / 2;
    const int me = int(b.thread) % FETCHERS;
    const u32 since = u32(clock64());
    const bool for_values = b.warp() < SUFFIX_WARP;
    LooseRows<FETCHERS> loose_keys{0, me, keys.suffix, keys.loose};
    LooseRows<FETCHERS / 2> loose_values{1, me, keys.suffix, keys.loose};
    SuffixPart<most(SUFFIX * (HD / 4), FETCHERS)> suffix_keys{
        kv, bit, 0, me, FETCHERS, keys.suffix0, keys.suffix, 0, HD / 4};
    loose_keys.ask(b, keys.loose0);
    if (for_values) loose_values.ask(b, keys.loose0);
#pragma unroll 1
    for (int i = 0; i < slots; ++i) give_slot(b, take_slot(b));
    pause(since, SUFFIX_PATIENCE);
    __syncwarp();
    suffix_keys.ask();
    loose_keys.keep(b);
    suffix_keys.keep(b);
    show_to_products();
    if (for_values) {
      arrive<ROWS_HERE, W - SCORERS>();
      SuffixPart<most(SUFFIX * (HD / 4), FETCHERS / 2)> suffix_values{
          kv, bit, 1, me, FETCHERS / 2, keys.suffix0, keys.suffix, 0, HD / 4};
      suffix_values.ask(), loose_values.keep(b), suffix_values.keep(b);
    } else {
      sync<ROWS_HERE, W - SCORERS>();
      MARK(MARK_ROWS_HERE)
      barrier_wait(b.bar(BAR_Q), b.n & 1);
      __syncwarp();
      show_to_products();
      weigh_rows(b, (b.warp() - SUFFIX_WARP) * 2, rows);
      MARK(MARK_ROWS_WEIGHED)
    }
  }
  show_to_products();
  consumers_sync();
  MARK(MARK_WEIGHTS_STORED)

  const u32 first_values = b.slot, weights = operand_place(b.start() + M_X + X_P, NT * 128);
  float sums[NT * 4], out[NT][4];
#pragma unroll
  for (int i = 0; i < NT * 4; ++i) sums[i] = 0;
  const int column = imin(b.warp(), QT - 1), owner = ((column + 1) * S - 1) / QT, in = column - share(QT, S, owner);
  uint4 last;
  {
    const int k = (b.lane() & 7) + (b.lane() >> 4 << 3), row = min((k >> 1) + (k & 1) * 8, rows - 1);  // others weigh 0
    ldmatrix_transposed(last, b.base + M_X + X_VALUE_ROWS + row * RS + (column * 16 + (b.lane() & 8)) * 2);
  }
  if (b.warp() < NT) send_some_sums(b, b.warp(), tiles, rows);
  int i = imin(slots, 2);
  if (slots > 1)
    weigh_some<2>(b, 0, first_values, tiles, weights, sums, &last);
  else if (slots == 1)
    weigh_some<1>(b, 0, first_values, tiles, weights, sums, &last);
  else
    weigh_some<0>(b, 0, first_values, tiles, weights, sums, &last);
#pragma unroll 1
  for (; i < slots; ++i) weigh_some<1>(b, i, first_values, tiles, weights, sums);
#pragma unroll 1
  for (i = 0; i < slots; ++i) give_slot(b, slot_behind(first_values, i));
#pragma unroll
  for (int i = 0; i < NT * 4; ++i) out[i / 4][i % 4] = sums[i];
  if (b.warp() < QT) {
    const u32 at = M_X + X_COMB + (b.rank() * QTL + in) * NT * OUTPUT + b.lane() * (OUTPUT / 32);
    const u32 to = at_rank(b.base + at, owner), to_bar = at_rank(b.bar(BAR_COMB), owner);
    const bool own = owner == b.rank();
#pragma unroll
    for (int n = 0; n < NT; ++n)
      if (n * 8 + 2 * b.t() < T) {
        const u32 even = pack(out[n][0], out[n][1]), odd = pack(out[n][2], out[n][3]);
        if (own)
          *(uint2*)(b.smem + at + n * OUTPUT) = make_uint2(even, odd);
        else
          send(to + n * OUTPUT, even, odd, to_bar);
      }
    __syncwarp();
    if (own && b.lane() == 0) barrier_arrive(b.bar(BAR_COMB));
  }
}

__device__ __forceinline__ void attend_keys(Cta& b, const float* kv, u32 bit, const Keys& keys) {
  if constexpr (ASYNC)
    attend_together(b, kv, bit, keys);
  else
    attend_by_warps(b, kv, bit, keys);
}
__device__ __forceinline__ u32 outputs_expect(const Cta& b) {
  return S * ((T + 1) / 2) * 8 + (S - ASYNC) * b.qn() * ((T + 1) / 2) * (OUTPUT / 4);  // ASYNC: its own by stores
}

constexpr u32 ATT_EXPECT = HD * (COPY_ATTENTION ? NT * 8 : T) * (OPERAND / 128) + (IDLE_Q ? S * 4 : 0);
// How 8 tokens of a tile of this rank's attention get to all ranks.
struct AttentionSender {
  Everyone places, bars;
  __device__ __forceinline__ AttentionSender(const Cta& b, int tile, int n) {
    if (!COPY_ATTENTION) places = Everyone(columns_place(b, M_ATT, b.q0() + tile, n)), bars = Everyone(b.bar(BAR_ATT));
  }
  __device__ __forceinline__ void send(const Cta& b, int tile, int n, float4 v) const {
    if (!COPY_ATTENTION) return send_columns(b, places, bars, n, v, true);
    const uint2 columns = columns_of(b, v);
    byte* const p = b.smem + (columns_place(b, M_ATT, b.q0() + tile, n) - b.base);
    if (FP8)
      *(u32*)p = columns.x;
    else
      *(uint2*)p = columns;
  }
  // By all warps, when all that this rank has is sent.
  static __device__ __forceinline__ void end(const Cta& b) {
    if (!COPY_ATTENTION) return;
    consumers_sync();
    if (b.warp() == COPY_WARP) {
      if (b.lane() == 0) {
        constexpr u32 BYTES = QTL * NT * OPERAND;
        const u32 place = b.q0() * NT * OPERAND;
        byte* const there = (byte*)(b.a.scratch + B_ATT) + size_t(b.cluster()) * QT * NT * OPERAND + place;
        show_to_products();
        copy_to_all(b, M_ATT + place, there, M_ATT + place, BYTES, BAR_ATT);
      }
      __syncwarp();
    }
  }
};
