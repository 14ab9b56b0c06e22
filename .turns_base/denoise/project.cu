// Part 8 of 13: queries, keys and values of the suffix.

constexpr int ITEMS_Q =
    most((QTL + KVL) * NT, W);  // (tile, 8 tokens) of queries, keys and values that one warp finishes

// Cosine and sine of a warp's items, for tokens 2t and 2t + 1; values aren't turned. To shared memory if there is room.
__device__ __forceinline__ void make_rope(const Block& b, int prefix, float2 (&rope)[ITEMS_Q][2]) {
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp() + j * W, qn = b.qn(), kvn = b.kvn(), k = i - qn * NT;
    rope[j][0] = rope[j][1] = make_float2(1, 0);
    if (i >= (qn + kvn) * NT) continue;
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
      if (b.warp() + j * W < (QTL + KVL) * NT)
        *(float4*)(b.smem + M_ROPE + (b.warp() + j * W) * 512 + b.lane() * 16) =
            make_float4(rope[j][0].x, rope[j][0].y, rope[j][1].x, rope[j][1].y);
}

// Floats as integers of the same order, and back. Even where a rank has no keys, the largest logit is LOWEST.
constexpr float LOWEST = -3e38f;
__device__ __forceinline__ int ordered(int v) { return v ^ ((v >> 31) & 0x7fffffff); }
__device__ __forceinline__ int ordered(float v) { return ordered(__float_as_int(v)); }

// q|k|v by mma, for few tokens: of wgmma's 64 rows a third or half would be empty. A warp has all tiles of a
// 16th of the reduction, so each block's activations are read once; its weights, which all lie in one slot, wait in
// registers for the stream, and their slots are free early.
struct QkvProduct {
  uint4 weights[QKV_ROUNDS * KB][QKV];
  float sums[QKV][NT][4];
  int tiles;

  __device__ __forceinline__ explicit QkvProduct(int n) : tiles(n) {}
  __device__ __forceinline__ bool some() const { return QT % S == 0 || tiles > 0; }
  static __host__ __device__ constexpr int slot_log2(int tiles) {
    int log = 0;
    while ((2 << log) <= slot_rounds(group_parts(QKV), tiles) * W) ++log;
    return log;
  }
  // Missing tiles are loaded, too: whatever lies there. A warp waits for its own slot alone; the others are full, too,
  // before it waits for their next contents, as all warps meet behind the products.
  __device__ __forceinline__ void load(Block& b) {
    if (!some()) return;
    // A slot has 2^in_slot fragments a tile, and a warp QKV_ROUNDS: both powers of two, so shifts are enough.
    const int in_slot = tiles == QKV       ? slot_log2(QKV)
                        : tiles == QKV - 1 ? slot_log2(imax(QKV - 1, 1))
                                           : slot_log2(1);
    const int first = b.warp() * QKV_ROUNDS;
    const u32 slots = imax(QKV_ROUNDS * W >> in_slot, 1);
    u32 slot = b.slot + (first >> in_slot), phase = b.phase;
    if (slot >= STAGES) slot -= STAGES, phase ^= 1;
    b.slot += slots;
    if (b.slot >= STAGES) b.slot -= STAGES, b.phase ^= 1;
    barrier_wait(b.full(slot), phase);
    __syncwarp();
    const u32 at = M_RING + slot * SLOT + (first & ((1 << in_slot) - 1)) * tiles * FRAGMENT;
    u32 seen = 0;
#pragma unroll
    for (int r = 0; r < QKV_ROUNDS; ++r) {
#pragma unroll
      for (int i = 0; i < QKV; ++i) {
        const uint4 v = load_weights(b, at + (r * tiles + i) * FRAGMENT);
        seen ^= fold(v);
        if constexpr (FP8) {
          const uint2 a = from_e4m3(v.x), a_8 = from_e4m3(v.y), c = from_e4m3(v.z), c_8 = from_e4m3(v.w);
          weights[r * KB][i] = make_uint4(a.x, a_8.x, a.y, a_8.y);
          weights[r * KB + KB - 1][i] = make_uint4(c.x, c_8.x, c.y, c_8.y);
        } else {
          weights[r][i] = v;
        }
      }
    }
    give_slot(b, slot, seen, slots);
  }
  __device__ __forceinline__ void multiply(const Block& b) {
    constexpr bool EXACT = D16 % (KB * W) == 0;
    auto add = [&](int k, int n, uint2 x) {
#pragma unroll
      for (int i = 0; i < QKV; ++i)
        if (FP8)
          mma_half(sums[i][n], weights[k][i], x);
        else
          mma(sums[i][n], weights[k][i], x);
    };
#pragma unroll
    for (int i = 0; i < QKV; ++i) clear(sums[i]);
    if (!some()) return;
#pragma unroll
    for (int k = 0; k < QKV_ROUNDS * KB; k += KB) {
      const int block = b.warp() * QKV_ROUNDS * KB + k;
      uint4 v;  // of the first 8 tokens 8 (E4M3: 16) columns, the next ones, then of the next 8 tokens
      if constexpr (FP8) {
        const int mine = block + (b.lane() >> 3 & 1);
        ldmatrix(v, b.base + M_X + ((EXACT ? mine : min(mine, D16 - 1)) * NT + (b.lane() >> 4)) * 128 +
                        (b.lane() & 7) * 16);
        add(k, 0, from_e4m3(v.x)), add(k + 1, 0, from_e4m3(v.y));
        if (NT > 1) add(k, NT - 1, from_e4m3(v.z)), add(k + 1, NT - 1, from_e4m3(v.w));
      } else {
        ldmatrix(v, b.base + M_X + (EXACT ? block : min(block, D16 - 1)) * NT * 256 + b.lane() * 16);
        add(k, 0, make_uint2(v.x, v.y));
        if (NT > 1) add(k, NT - 1, make_uint2(v.z, v.w));
      }
    }
  }
  // With QKV_PAIRS warps i and i + 8 add up their sums, each of them half.
  __device__ __forceinline__ void store(const Block& b, byte* to) {
    const int upper = b.warp() / QKV_PARTS, part = b.warp() % QKV_PARTS;
    auto exists = [&](int i, int n) { return i < tiles && (n + 1 < NT || b.t() < TAIL); };
    auto place = [&](int i, int n) {
      return (float4*)(to + (i * QKV_PARTS + part) * PARTIAL + partial_place(b, n));
    };
#pragma unroll
    for (int i = 0; i < QKV; ++i)
#pragma unroll
      for (int n = 0; n < NT; ++n)
        if ((!QKV_PAIRS || (i * NT + n) % 2 != upper) && exists(i, n))
          *place(i, n) = make_float4(sums[i][n][0], sums[i][n][1], sums[i][n][2], sums[i][n][3]);
    if (!QKV_PAIRS) return;
    __syncwarp();
    asm volatile("bar.sync %0, 64;" ::"r"(TILE_MEETS + part) : "memory");
#pragma unroll
    for (int i = 0; i < QKV; ++i)
#pragma unroll
      for (int n = 0; n < NT; ++n)
        if ((i * NT + n) % 2 == upper && exists(i, n)) {
          const float4 v = *place(i, n);
          *place(i, n) =
              make_float4(sums[i][n][0] + v.x, sums[i][n][1] + v.y, sums[i][n][2] + v.z, sums[i][n][3] + v.w);
        }
  }
  static __device__ __forceinline__ float4 total(const Block& b, const byte* from, int tile, int n) {
    const byte* p = from + tile * QKV_PARTS * PARTIAL + partial_place(b, n);
    float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll
    for (int first = 0; first < QKV_PARTS; first += 8) {
      const float4 v = add_up<8>(p + first * PARTIAL);
      sum.x += v.x, sum.y += v.y, sum.z += v.z, sum.w += v.w;
    }
    return sum;
  }
};

// By one warp: this rank's queries, staged [half][tile][NT][8 tokens][8] at M_ATT, to all ranks when there is room.
__device__ __forceinline__ void copy_queries(const Block& b) {
  constexpr u32 BYTES = QTL * NT * 128, HALF = QT * NT * 128;  // of half the columns: this rank's, all
  const u32 place = b.q0() * NT * 128;
  byte* const there = (byte*)(b.a.scratch + B_QUERIES) + size_t(b.cluster()) * 2 * HALF + place;
  if (b.lane() == 0) {
    show_to_products();
    bulk_store(there, b.base + M_ATT, BYTES), bulk_store(there + HALF, b.base + M_ATT + BYTES, BYTES);
    await_stored();
  }
  __syncwarp();
  await_room(b);
  if (b.lane() == 0) {
    load_for_all(b.base + M_Q + place, there, BYTES, b.bar(BAR_Q));
    load_for_all(b.base + M_Q + place + HALF, there + HALF, BYTES, b.bar(BAR_Q));
  }
  __syncwarp();
}

// Awaits the stream. q to all ranks, k and v to all clusters as float32 with their flags. The partial sums lie over the
// stream; queries are sent when all of those have been read, so what a peer sends after it has them may lie there too.
__device__ __forceinline__ void project(Block& b, const float* shifted, const float* row_scales, float* kv, u32 bit,
                                        const float2 (&rope)[ITEMS_Q][2]) {
  const int qn = b.qn(), kvn = b.kvn();
  float2 shift[ITEMS_Q], scale[ITEMS_Q];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp() + j * W, k = i - qn * NT;
    const int tile = i >= (qn + kvn) * NT ? 0 : k < 0 ? i % qn : QTL + (KVL == 1 ? 0 : k % kvn);
    shift[j] = make_float2(__ldg(shifted + tile * 16 + b.g()), __ldg(shifted + tile * 16 + b.g() + 8));
    if (FP8) scale[j] = make_float2(__ldg(row_scales + tile * 16 + b.g()), __ldg(row_scales + tile * 16 + b.g() + 8));
  }
  auto await_stream = [&] {
    receive_stream(b, 0);
    MARK(MARK_STREAM_FOR_ATTENTION)
  };
  if constexpr (MMA_QKV) {
    QkvProduct product(qn + kvn);
    product.load(b);
    await_stream();
    product.multiply(b);
    MARK(MARK_QKV_MULTIPLIED)
    consumers_sync();
    product.store(b, b.smem + M_X);
  } else {
    Ahead<group_tiles(QKV), 0> ahead(b);
    await_stream();
    float sums[plan_groups(QKV)][NT * 4];
    if (!SPREAD) show_to_products();
    multiply<QKV, D16>(b, M_X, D16, qn + kvn, sums, ahead);
    MARK(MARK_QKV_MULTIPLIED)
    consumers_sync();
    if constexpr (SPREAD) give_room(b);
    store_partials<QKV>(b, b.smem + M_X, qn + kvn, sums);
  }
  consumers_sync();
  if (b.thread < NT * 8) ((int*)(b.smem + M_PART))[b.thread] = ordered(LOWEST);  // for `weigh_prefix`
  // Free until all have what attention sends: [item][half][8 tokens][8], or see `copy_queries`.
  byte* const staged = b.smem + M_ATT;
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const int i = b.warp() + j * W, k = i - qn * NT;
    if (i < (qn + kvn) * NT) {
      const int n = k < 0      ? i / qn
                    : KVL == 1 ? k
                               : k / kvn,
                kv_tile = KVL == 1 ? 0 : k % kvn, token = n * 8 + 2 * b.t();
      const int at = k < 0 ? i % qn : qn + kv_tile;
      constexpr int OTHER_HALF = COPY_QUERIES ? QTL * NT * 64 : 64;
      float4 c = MMA_QKV ? QkvProduct::total(b, b.smem + M_X, at, n) : total<QKV>(b, b.smem + M_X, at, n);
      if (FP8) c = scaled(c, scale[j]);
      const float2 r = inverse_rms(b, token, 0);
      float4 turn = make_float4(rope[j][0].x, rope[j][0].y, rope[j][1].x, rope[j][1].y);
      if (FEW) turn = *(const float4*)(b.smem + M_ROPE + i * 512 + b.lane() * 16);
      const float2 u = make_float2(turn.x, turn.y), v = make_float2(turn.z, turn.w);
      const float a0 = c.x * r.x + shift[j].x, a1 = c.z * r.x + shift[j].y, c0 = c.y * r.y + shift[j].x,
                  c1 = c.w * r.y + shift[j].y;
      const float f0 = a0 * u.x - a1 * u.y, s0 = a1 * u.x + a0 * u.y, f1 = c0 * v.x - c1 * v.y,
                  s1 = c1 * v.x + c0 * v.y;
      if (k < 0) {
        const u32 f = pack(f0, f1), s = pack(s0, s1);
        const int place = COPY_QUERIES ? (at * NT + n) * 128 : i * 256;
        unsigned short* p = (unsigned short*)(staged + place + b.t() * 32) + b.g();
        p[0] = (unsigned short)f, p[8] = (unsigned short)(f >> 16);
        p[OTHER_HALF] = (unsigned short)s, p[OTHER_HALF + 8] = (unsigned short)(s >> 16);
      } else {
        const int tile = b.kv0() + kv_tile, col = tile < QT ? tile * 8 + b.g() : HD + (tile - QT) * 16 + b.g(),
                  up = tile < QT ? HD / 2 : 8;
        float* p = kv + size_t(token) * 2 * HD + col;
        if (token < T) publish(p, f0, bit), publish(p + up, s0, bit);
        if (token + 1 < T) publish(p + 2 * HD, f1, bit), publish(p + 2 * HD + up, s1, bit);
      }
    }
  }
  // All sums have been read. Warps without items, which weigh values, needn't wait for that.
  constexpr bool GO_ON = FEW && !IDLE_Q && (QTL + KVL) * NT <= W / 2;
  if (GO_ON && b.warp() >= W / 2)
    consumers_arrive();
  else
    consumers_sync();
  if constexpr (COPY_QUERIES) {
    if (b.warp() == COPY_WARP) copy_queries(b);
    ++b.room;
    return;
  }
  if constexpr (SPREAD) await_room(b), ++b.room;
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
constexpr u32 Q_EXPECT = HD * (COPY_QUERIES ? NT * 8 : T) * 2 + (IDLE_Q ? S * 4 : 0);
