// Attention with each warp's products its own: of few tokens, and of many behind many keys. The keys are split over the
// ranks of the head's cluster.

__device__ __forceinline__ void attend_by_warps(Cta& b, const float* kv, u32 bit, const Keys& keys) {
  const int tiles = keys.tiles, prefix = keys.keys, slots = keys.slots, suffix0 = keys.suffix0, suffix = keys.suffix;
  const bool scorer = b.warp() < SCORERS, for_suffix = b.warp() >= SUFFIX_WARP;
  const int column = (b.warp() - (W - WEIGHERS)) * CT;  // this warp's first tile of them
  constexpr int MOST_SLOTS = most(KT, SLOT_TILES);
  auto pass = [&] {  // slots that a warp has no use for
#pragma unroll 1
    for (int i = 0; i < slots; ++i) give_slot(b, take_slot(b), 0);
  };
  // Keys: a warp those columns that it scores. Values: a warp those that it weighs, or the third warpgroup all.
  const int k0 = share(QT, 4, b.warp() - SUFFIX_WARP);
  const int key_steps = QT % 4 == 0 ? QT / 4 : share(QT, 4, b.warp() - SUFFIX_WARP + 1) - k0;
  const bool some_keys = suffix > 0 && for_suffix && key_steps > 0;
  const bool some_values = suffix > 0 && (HOLD ? column < QT : b.warp() >= SCORERS && !for_suffix);
  SuffixPart<most(SUFFIX * SUFFIX_STEPS * 4, 32)> suffix_keys{kv,      bit,    0,      b.lane(),       32,
                                                              suffix0, suffix, k0 * 4, key_steps * 4};
  constexpr int VALUE_THREADS = HOLD ? 32 : 128;
  SuffixPart<most(SUFFIX * (HOLD ? CT * 4 : HD / 4), VALUE_THREADS)> suffix_values{
      kv,      bit,    1, int(b.thread) & (VALUE_THREADS - 1), VALUE_THREADS,
      suffix0, suffix, HOLD ? column * 4 : 0,
      !HOLD ? HD / 4 : QT % WEIGHERS == 0 ? CT * 4 : min(CT, QT - column) * 4};
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
    if (b.warp() == SUFFIX_WARP)
      weigh_suffix(b, c, suffix OF_PAIR(, Mask::of_suffix(suffix0)));
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
    const int row = min(((b.lane() & 7) + (b.lane() >> 4 << 3)) >> 1, suffix - 1);  // the others' weights are 0
#pragma unroll
    for (int j = 0; j < CT; ++j) {
      const int tile = min(column + j, QT - 1), owner = ((tile + 1) * S - 1) / QT, in = tile - share(QT, S, owner);
      last[j] = make_uint4(0, 0, 0, 0);
      if (suffix > 0)
        ldmatrix_transposed(last[j], b.base + M_X + X_VALUE_ROWS + row * RS + (tile * 16 + (b.lane() & 8)) * 2);
      constexpr bool ONE_OWNER = QT % S == 0 && QTL % CT == 0;
      if (ONE_OWNER && j > 0) {
        to[j] = to[0] + j * NT * OUTPUT, to_bar[j] = to_bar[0];
        continue;
      }
      to[j] = at_rank(b.base + M_X + X_COMB + (b.rank() * QTL + in) * NT * OUTPUT + b.lane() * (OUTPUT / 32), owner);
      to_bar[j] = at_rank(b.bar(BAR_COMB), owner);
    }
  };
  auto send_outputs = [&](float (&out)[CT][NT][4]) {  // after the suffix has had its part in them
    if (HOLD && b.warp() != SUFFIX_WARP) sync<SUFFIX_WEIGHTS, WEIGHERS + 1>();
#pragma unroll
    for (int j = 0; j < CT; ++j)
      if (column + j < QT) {
        keep_prefix(b, out[j]);
        if (suffix > 0) mma_tokens(out[j], last[j], token_address(b, M_X + X_P) + KT * NT * 256);
#pragma unroll
        for (int n = 0; n < NT; ++n)
          if (n * 8 + 2 * b.t() < T) {
            if constexpr (MANY)
              send(to[j] + n * OUTPUT, pack(out[j][n][0], out[j][n][1]), pack(out[j][n][2], out[j][n][3]), to_bar[j]);
            else
              send(to[j] + n * OUTPUT, make_float4(out[j][n][0], out[j][n][1], out[j][n][2], out[j][n][3]), to_bar[j]);
          }
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
        if (b.warp() / SLOT_TILES == i && b.warp() < tiles) {
          mine = slot;
#pragma unroll
          for (int k = 0; k < HELD_KEYS; ++k)
            keys[k] = load_fragment(b.ring(slot) + b.warp() % SLOT_TILES * KEY_TILE + k * FRAGMENT, b.lane());
        } else {
          give_slot(b, slot, 0);
        }
      }
      pass();
      receive(b, BAR_Q, b.n, Q_EXPECT, WAIT_Q);
      b.forget();
      MARK(MARK_QUERIES_HERE)
      float c[1][NT][4];
      clear(c[0]);
      if (b.warp() < tiles) {
        const byte* from = b.ring(mine) + b.warp() % SLOT_TILES * KEY_TILE;
        float rest[NT][4];
        const u32 held = score<HELD_KEYS, HELD_KEYS>(b, [&](int k) { return keys[k]; }, 0, QT, c[0]);
        auto fetch = [&](int k) { return load_fragment(from + (HELD_KEYS + k) * FRAGMENT, b.lane()); };
        u32 seen = score<QT - HELD_KEYS, 4>(b, fetch, HELD_KEYS, QT, rest);
        if (QT == HELD_KEYS) seen = held;
#pragma unroll
        for (int n = 0; n < NT; ++n)
#pragma unroll
          for (int i = 0; i < 4; ++i) c[0][n][i] += rest[n][i];
        give_slot(b, mine, seen);
      }
      MARK(MARK_PREFIX_SCORED)
      weigh_prefix(b, c, b.warp(), prefix - b.warp() * 16 OF_PAIR(, Mask()));  // never a pair
      arrive<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
      if (b.warp() == LEADER) {
        sync<WEIGHTS, SCORERS + 4>();
        send_sums(b, tiles, suffix);
      } else {
        arrive<WEIGHTS, SCORERS + 4>();
      }
    } else {
      pass();
      uint4 values[HELD_TILES][CT];  // zeros at first, as the keys
      auto load = [&](u32 slot, int i, int j) {
        return load_fragment(b.ring(slot) + i * KEY_TILE + (column + j) * FRAGMENT, b.lane());
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
      barrier_wait(b.bar(BAR_Q), b.n & 1);  // and so all sums have been read that lay where the suffix will
      pause(u32(clock64()), 150);           // asked for too early it comes later
      ask_suffix();
      if (for_suffix) of_suffix();
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
    MARK(MARK_QUERIES_HERE)
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
          const int tile = b.warp() + r * SCORERS;
          if (scorer && tile / SLOT_TILES == i && tile < tiles) {
            const byte* from = b.ring(slot) + tile % SLOT_TILES * KEY_TILE;
            seen ^= score<QT, 4>(b, [&](int k) { return load_fragment(from + k * FRAGMENT, b.lane()); }, 0, QT, c[r]);
          }
        }
        give_slot(b, slot, seen);
      }
    MARK(MARK_PREFIX_SCORED)
    if (scorer) {
      weigh_prefix(b, c, b.warp(), prefix - b.warp() * 16 OF_PAIR(, Mask::of_prefix(b, keys.first + b.warp())));
      arrive<WEIGHTS_FOR_SUFFIX, SCORERS + 4>();
    }
    ask_suffix();
    if (some_values) suffix_values.keep(b);
    if (for_suffix) of_suffix();
    consumers_sync();
  }
  MARK(MARK_WEIGHTS_STORED)
  if constexpr (!HOLD) {
    float out[CT][NT][4];
    clear_out(out);
#pragma unroll 1
    for (int i = 0; i < slots; ++i) {
      const u32 slot = take_slot(b);
      const byte* from = b.ring(slot) + b.warp() * FRAGMENT;
      u32 seen = 0;
      if (b.warp() < QT) {
#pragma unroll
        for (int sub = 0; sub < SLOT_TILES; ++sub)
          if (i * SLOT_TILES + sub < tiles) {
            const uint4 v = load_fragment(from + sub * KEY_TILE, b.lane());
            seen ^= fold(v);
            mma_tokens(out[0], v, token_address(b, M_X + X_P) + (i * SLOT_TILES + sub) * NT * 256);
          }
      }
      give_slot(b, slot, seen);
    }
    prepare_outputs();
    send_outputs(out);
    if (b.warp() == LEADER) send_sums(b, tiles, suffix);
  }
}
