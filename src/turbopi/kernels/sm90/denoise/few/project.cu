// Few tokens: queries, keys and values of the suffix.

// q|k|v by mma: of wgmma's 64 rows a third or half would be empty. A warp has all tiles of a
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
  __device__ __forceinline__ void load(Cta& b) {
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
  __device__ __forceinline__ void multiply(const Cta& b) {
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
  __device__ __forceinline__ void store(const Cta& b, byte* to) {
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
  static __device__ __forceinline__ float4 total(const Cta& b, const byte* from, int tile, int n) {
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

__device__ __forceinline__ void keep_rope(const Cta& b, int prefix) {
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j)
    if (const int i = b.warp() + j * W; i < QKV * NT)
      *(float4*)(b.smem + M_ROPE + i * 512 + b.lane() * 16) = rope_of(b, prefix, QkvItem(b, j));
}

// Awaits the stream. q to all ranks, k and v to all clusters as float32 with their flags. The partial sums lie over the
// stream; queries are sent when all of those have been read, so what a peer sends after it has them may lie there too.
__device__ __forceinline__ void project(Cta& b, const Shifts& shifts, const float* row_scales, float* kv, u32 bit) {
  const int tiles = b.qn() + b.kvn();
  Factors shift[ITEMS_Q];
  float2 scale[ITEMS_Q];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const QkvItem item(b, j);
    const int row = item.row(b);
    shift[j] = shifts(b, row, item.mine ? item.n : 0);
    if (FP8) scale[j] = make_float2(__ldg(row_scales + row), __ldg(row_scales + row + 8));
  }
  auto await_stream = [&] {
    receive_stream(b, 0);
    MARK(MARK_STREAM_FOR_ATTENTION)
  };
  if constexpr (MMA_QKV) {
    QkvProduct product(tiles);
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
    show_to_products();
    multiply<QKV, D16>(b, M_X, D16, tiles, sums, ahead);
    MARK(MARK_QKV_MULTIPLIED)
    consumers_sync();
    store_partials<QKV>(b, b.smem + M_X, tiles, sums);
  }
  consumers_sync();
  if (b.thread < NT * 8) ((int*)(b.smem + M_PART))[b.thread] = ordered(LOWEST);  // for `weigh_prefix`
  byte* const staged = b.smem + M_ATT;  // free until all have what attention sends
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j)
    if (const QkvItem item(b, j); item.mine) {
      float4 c = MMA_QKV ? QkvProduct::total(b, b.smem + M_X, item.at, item.n)
                         : total<QKV>(b, b.smem + M_X, item.at, item.n);
      if (FP8) c = scaled(c, scale[j]);
      const float4 turn = *(const float4*)(b.smem + M_ROPE + item.i * 512 + b.lane() * 16);
      finish_item<64>(b, item, c, shift[j], turn, staged + item.i * 256, kv, bit);
    }
  // All sums have been read. Warps without items, which weigh values, needn't wait for that.
  constexpr bool GO_ON = !IDLE_Q && QKV * NT <= W / 2;
  if (GO_ON && b.warp() >= W / 2)
    consumers_arrive();
  else
    consumers_sync();
  send_queries(b, staged);
}
constexpr u32 Q_EXPECT = HD * T * 2 + (IDLE_Q ? S * 4 : 0);
