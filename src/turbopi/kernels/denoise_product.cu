// Part 5 of 7: matrix products and the residual stream.

__device__ __forceinline__ u32 take_slot(Block& b, bool full = false) {
  const u32 slot = b.slot;
  if (!full) mbar_wait(b.full(slot), b.phase);
  __syncwarp();
  if (++b.slot == STAGES) b.slot = 0, b.phase ^= 1;
  return slot;
}
// Give a slot back. Not before the loads from it have arrived: the copy engine isn't ordered behind loads that are
// still on their way (seen as wrong sums). Hence an address that needs what they brought.
__device__ __forceinline__ void give_slot(const Block& b, u32 slot, u32 seen = 0) {
  __syncwarp();
  if (b.lane == 0) mbar_arrive(b.empty(slot) + (seen & b.a.zero));
}

// The same without a branch, which would make products wait for each other, for what products alone have read.
__device__ __forceinline__ void give_slot_if(const Block& b, u32 slot, bool really) {
  asm volatile("{.reg .pred p; setp.ne.u32 p, %1, 0; @p mbarrier.arrive.shared::cta.b64 _, [%0];}" ::"r"(b.empty(slot)),
               "r"(u32(really && b.lane == 0))
               : "memory");
}

__device__ __forceinline__ uint4 load_fragment(const byte* p, int lane) { return *(const uint4*)(p + lane * 16); }
__device__ __forceinline__ u32 fold(uint4 v) { return v.x; }

// A warp's share of a group whose reduction has so many parts: its tile, the first of its warpgroup, its part.
struct Share {
  int part, first, tile;
  __device__ __forceinline__ Share(const Block& b, int parts) {
    const int group = b.warp >> 2, rows = W / 4 / parts;
    part = group / rows, first = group % rows * 4, tile = first + (b.warp & 3);
  }
};

// One group of tiles, this warp's share of it. x: activations in shared memory; `blocks` of the reduction, a multiple
// of EVEN. A product is issued when the one before has begun, so what else there is to do stands between two.
template <int TILES_, int EVEN>
__device__ __forceinline__ void multiply_group(Block& b, u32 x, int blocks, int tiles, float (&sums)[NT * 4]) {
  constexpr int PARTS = group_parts(TILES_), COLUMNS = NT * 8;
  constexpr bool EXACT = EVEN % (KB * PARTS * 4) == 0;
  const Share my(b, PARTS);
  const int rounds = plan_rounds(PARTS, blocks), rounds_of_slot = slot_rounds(PARTS, tiles);
  const int first = my.first < tiles ? my.first : 0;
  const u64 weights = operand(b.base + M_RING + (my.part * tiles + first) * FRAGMENT, 256, 128);
  const u64 all = operand(x, 256, 128);
  // Of a block's activations; blocks that fill up a round have no weight, their activations are any.
  auto activations = [&](int unit, int half) {
    const int block = unit * KB + half;
    return behind(all, (EXACT ? block : min(block, blocks - 1)) * NT * 256);
  };
#pragma unroll
  for (int i = 0; i < NT * 4; ++i) sums[i] = 0;
  u32 slot = 0, from = 0, previous = ~0u;
  int left = 0;  // rounds of the slot
  bool full = false;
#pragma unroll 1
  for (int r = 0; r < rounds; ++r) {
    if (left == 0) slot = take_slot(b, full), left = rounds_of_slot, from = slot * SLOT, full = false;
    const int unit = r * RPS * PARTS + my.part;
    if constexpr (FP8) {
      const byte* p = b.smem + M_RING + from + (my.part * tiles + min(my.tile, tiles - 1)) * FRAGMENT;
      uint4 w = load_fragment(p, b.lane);
#pragma unroll 1  // with room for two fragments, others' registers would spill
      for (int i = 0; i < RPS; ++i) {
        const uint4 even = from_e4m3(w.x, w.y), odd = from_e4m3(w.z, w.w);
        if (i + 1 < RPS) w = load_fragment(p + (i + 1) * PARTS * tiles * FRAGMENT, b.lane);
        begin_products();
        add_product<COLUMNS>(sums, even, activations(unit + i * PARTS, 0), r | i);
        add_product<COLUMNS>(sums, odd, activations(unit + i * PARTS, 1), 1);
        commit_products();
        await_products<0>();  // it reads these registers; other warpgroups multiply meanwhile
      }
      if (--left == 0 || r + 1 == rounds) give_slot(b, slot);
    } else {
      begin_products();
#pragma unroll
      for (int i = 0; i < RPS; ++i) {
        add_product<COLUMNS>(sums, behind(weights, from + i * PARTS * tiles * FRAGMENT),
                             activations(unit + i * PARTS, 0), r | i);
        if (i == 0) {
          commit_products();
          await_products<1>();  // the round before is done
          give_slot_if(b, previous, previous != ~0u);
          full = left == 1 && r + 1 < rounds && test_wait(b.full(b.slot), b.phase);
        }
      }
      commit_products();
      previous = --left == 0 ? slot : ~0u;
    }
    from += RPS * PARTS * tiles * FRAGMENT;
  }
  await_products<0>();
  if (!FP8 && rounds > 0) give_slot(b, slot);
}

// Up to MT tiles (`tiles` of them) times the activations.
template <int MT, int EVEN, int FIRST = 0>
__device__ __forceinline__ void multiply(Block& b, u32 x, int blocks, int tiles, float (*sums)[NT * 4]) {
  if constexpr (FIRST == 0) show_to_products();
  if constexpr (FIRST < MT) {
    constexpr int N = group_tiles(MT - FIRST);
    if (FIRST < tiles) {
      multiply_group<N, EVEN>(b, x, blocks, min(tiles - FIRST, N), sums[FIRST / 8]);
      multiply<MT, EVEN, FIRST + N>(b, x, blocks, tiles, sums);
    }
  }
}

// Where a lane's partial sums of 8 tokens lie. Of the last 8 only pairs that exist are kept.
__device__ __forceinline__ int partial_place(const Block& b, int n) {
  return n * 512 + (TAIL == 4 || n + 1 < NT ? b.lane : b.g() * TAIL + min(b.t(), TAIL - 1)) * 16;
}
// The warps' partial sums to shared memory, and a tile's total back, always in the same order.
template <int MT, int FIRST = 0>
__device__ __forceinline__ void store_partials(const Block& b, byte* to, int tiles, float (*sums)[NT * 4]) {
  if constexpr (FIRST < MT) {
    constexpr int N = group_tiles(MT - FIRST), PARTS = group_parts(N);
    const Share my(b, PARTS);
    const float* sum = sums[FIRST / 8];
    if (FIRST + my.tile < tiles && my.tile < N) {
#pragma unroll
      for (int n = 0; n < NT; ++n)
        if (n + 1 < NT || b.t() < TAIL)
          *(float4*)(to + (plan_partials(FIRST) + my.tile * PARTS + my.part) * PARTIAL + partial_place(b, n)) =
              make_float4(sum[n * 4], sum[n * 4 + 1], sum[n * 4 + 2], sum[n * 4 + 3]);
    }
    store_partials<MT, FIRST + N>(b, to, tiles, sums);
  }
}
template <int MT, int FIRST = 0>
__device__ __forceinline__ float4 total(const Block& b, const byte* from, int tile, int n) {
  constexpr int N = group_tiles(MT - FIRST), PARTS = group_parts(N);
  if constexpr (FIRST + N < MT)
    if (tile >= FIRST + N) return total<MT, FIRST + N>(b, from, tile, n);
  const byte* p = from + (plan_partials(FIRST) + (tile - FIRST) * PARTS) * PARTIAL + partial_place(b, n);
  float4 v[PARTS];
#pragma unroll
  for (int i = 0; i < PARTS; ++i) v[i] = *(const float4*)(p + i * PARTIAL);
#pragma unroll
  for (int d = 1; d < PARTS; d *= 2)
#pragma unroll
    for (int i = 0; i + d < PARTS; i += 2 * d)
      v[i].x += v[i + d].x, v[i].y += v[i + d].y, v[i].z += v[i + d].z, v[i].w += v[i + d].w;
  return v[0];
}

// Or else: the warps that share a tile divide its tokens, part p has 8 tokens n = p, p + parts, ... An item is (tile, 8
// tokens), a warp has OWN of them in each group of tiles.
template <int MT>
constexpr int OWN = most(NT, group_parts(group_tiles(MT)));
template <int MT>
struct Own {
  float4 sums[plan_groups(MT)][OWN<MT>];
  int tile[plan_groups(MT)], n[plan_groups(MT)][OWN<MT>];
  bool mine[plan_groups(MT)][OWN<MT>];

  __device__ __forceinline__ Own(const Block& b, int tiles) {
#pragma unroll
    for (int i = 0; i < plan_groups(MT); ++i) {
      const int size = group_tiles(MT - i * 8), parts = group_parts(size);
      const Share my(b, parts);
      tile[i] = i * 8 + my.tile;
#pragma unroll
      for (int k = 0; k < OWN<MT>; ++k)
        n[i][k] = k * parts + my.part, mine[i][k] = my.tile < size && tile[i] < tiles && n[i][k] < NT;
    }
  }
  // To `sums` come all parts' sums of what is mine. They lie over the operand of the product, or APART.
  __device__ __forceinline__ void add_up(const Block& b, int region, int tiles, const float (*mixed)[NT * 4]) {
    byte* const place = b.smem + (APART ? M_SUMS : region);
    auto other = [&](int i, int parts, int part, int n) {
      return (float4*)(place + (plan_others(i * 8) + (tile[i] & 7) * (parts - 1) + part) * PARTIAL +
                       partial_place(b, n));
    };
    if (!APART) consumers_sync();
#pragma unroll
    for (int i = 0; i < plan_groups(MT); ++i) {
      const int size = group_tiles(MT - i * 8), parts = group_parts(size);
      const Share my(b, parts);
#pragma unroll
      for (int n = 0; n < NT; ++n) {
        const float4 sum = make_float4(mixed[i][n * 4], mixed[i][n * 4 + 1], mixed[i][n * 4 + 2], mixed[i][n * 4 + 3]);
        const int owner = n % parts;
        if (my.part == owner)
          sums[i][n / parts] = sum;
        else if (my.tile < size && tile[i] < tiles && (n + 1 < NT || b.t() < TAIL))
          *other(i, parts, my.part - (my.part > owner), n) = sum;
      }
    }
    if (APART && plan_groups(MT) == 1) {  // for the warps of my tile
      __syncwarp();
      asm volatile("bar.sync %0, %1;" ::"r"(8 + (tile[0] & 7)), "n"(group_parts(group_tiles(MT)) * 32) : "memory");
    } else {
      consumers_sync();
    }
#pragma unroll
    for (int i = 0; i < plan_groups(MT); ++i) {
      const int parts = group_parts(group_tiles(MT - i * 8));
#pragma unroll
      for (int k = 0; k < OWN<MT>; ++k)
        if (mine[i][k])
#pragma unroll
          for (int part = 0; part + 1 < parts; ++part) {
            const float4 v = *other(i, parts, part, n[i][k]);
            sums[i][k].x += v.x, sums[i][k].y += v.y, sums[i][k].z += v.z, sums[i][k].w += v.w;
          }
    }
  }
};

// ---- the residual stream. An item is (tile, 8 tokens); lane (g, t) has columns 2g, 2g + 1 of tokens 2t, 2t + 1 of it,
// as x y (first column) and z w (second). A warp keeps its items in registers for good.

struct Item {
  int tile, n, token;  // token: the lane's first
  bool real;           // of this warp, and tokens that exist
};
__device__ __forceinline__ Item stream_item(const Block& b, int j) {
  const int i = b.warp + j * W, xn = b.xn();
  const int tile = i < xn * NT ? i % xn : 0, n = i < xn * NT ? i / xn : 0;
  return {tile, n, n * 8 + 2 * b.t(), i < xn * NT && n * 8 + 2 * b.t() < T};
}
// 8 bytes with the lane pair's four columns 2g.. of one token (even g: 2t, odd g: 2t + 1) to all ranks.
__device__ __forceinline__ void send_columns(const Block& b, int region, int block, int n, float4 v, int bar,
                                             bool real) {
  const u32 w0 = pack_operand(v.x, v.z), w1 = pack_operand(v.y, v.w), got = exchange(b.g() & 1 ? w0 : w1, 4);
  const int token = 2 * b.t() + (b.g() & 1);
  const u32 to = b.base + region + (block * NT + n) * 256 + (b.g() >> 2) * 128 + token * 16 + (b.g() >> 1 & 1) * 8;
  if (real && n * 8 + token < T) {
    const u32 lo = b.g() & 1 ? got : w0, hi = b.g() & 1 ? w1 : got;
    const Everyone data(to), bars(b.bar(bar));
#pragma unroll
    for (int d = 0; d < S; ++d) send(data.at[d], lo, hi, bars.at[d]);
  }
}
// Sums of squares to all ranks, which add them up. If tokens are few every warp sends those of its tiles, as soon as it
// has them; else they are added up for the slice before.
__device__ __forceinline__ void send_tile_squares(const Block& b, float4 x, int i, int bar) {
  const int xn = b.xn(), absent = i - xn * NT;  // tiles that a rank lacks are sent as zeros
  if (i >= DX * NT) return;
  const int lacks = imax(DX - xn, 1);
  const int tile = absent < 0 ? i % xn : xn + absent % lacks, n = absent < 0 ? i / xn : absent / lacks;
  float q0 = x.x * x.x + x.z * x.z, q1 = x.y * x.y + x.w * x.w;
#pragma unroll
  for (int o = 4; o < 32; o *= 2) q0 += exchange(q0, o), q1 += exchange(q1, o);
  if (absent >= 0) q0 = q1 = 0;
  static_assert(S == 8, "lane g serves rank g");
  const u32 to = b.base + M_SSQ + ((b.rank * DX + tile) * NT * 8 + n * 8 + 2 * b.t()) * 4;
  if (n * 8 + 2 * b.t() < T)
    send(at_rank(to, b.g()), __float_as_uint(q0), __float_as_uint(q1), at_rank(b.bar(bar), b.g()));
}
__device__ __forceinline__ void send_squares(const Block& b, const float4 (&x)[ITEMS_X], int bar) {
  if constexpr (FEW) {
#pragma unroll
    for (int j = 0; j < ITEMS_X; ++j) send_tile_squares(b, x[j], b.warp + j * W, bar);
    return;
  }
  float* part = (float*)(b.smem + M_PART);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    float q0 = x[j].x * x[j].x + x[j].z * x[j].z, q1 = x[j].y * x[j].y + x[j].w * x[j].w;
#pragma unroll
    for (int o = 4; o < 32; o *= 2) q0 += exchange(q0, o), q1 += exchange(q1, o);
    if (item.real && b.g() == 0) *(float2*)(part + (item.tile * NT + item.n) * 8 + 2 * b.t()) = make_float2(q0, q1);
  }
  consumers_sync();
  static_assert(T * S <= CONSUMERS, "a thread for each token and rank");
  if (const int i = threadIdx.x; i < T * S) {
    const int token = i / S, d = i % S;
    float sum = 0;
#pragma unroll
    for (int tile = 0; tile < DX; ++tile)
      if (tile < b.xn()) sum += part[tile * NT * 8 + token];
    send(at_rank(b.base + M_SSQ + (b.rank * NT * 8 + token) * 4, d), __float_as_uint(sum), at_rank(b.bar(bar), d));
  }
}
constexpr u32 SQUARES_EXPECT = FEW ? SQ * ((T + 1) / 2) * 8 : SQ * T * 4;
// 1 / rms of tokens `token` and `token` + 1 (even), once the stream is here: a spare warp makes them.
__device__ __forceinline__ float2 inverse_rms(const Block& b, int token) {
  mbar_wait(b.bar(BAR_RMS), b.x_parity ^ 1);
  return *(const float2*)(b.smem + M_RMS + token * 4);
}
__device__ __forceinline__ void make_inverse_rms(const Block& b) {
  const int uses = b.a.steps * L * (b.attends() ? 2 : 1);
#pragma unroll 1
  for (int use = 0; use < uses; ++use) {
    mbar_wait(b.bar(BAR_X), use & 1);
#pragma unroll 1
    for (int token = b.lane; token < NT * 8; token += 32) {
      float sum = 0;
#pragma unroll 8
      for (int s = 0; s < SQ; ++s) sum += *(const float*)(b.smem + M_SSQ + (s * NT * 8 + token) * 4);
      *(float*)(b.smem + M_RMS + token * 4) = rsqrtf(sum * (1.0f / D) + b.a.eps);
    }
    __syncwarp();
    if (b.lane == 0) mbar_arrive(b.bar(BAR_RMS));
  }
}
constexpr u32 X_EXPECT = D16 * T * 32 + SQUARES_EXPECT;

// A lane's columns of a row of the table. Asked for well before `gather`: its polls would queue up behind them.
__device__ __forceinline__ void load_columns(const Block& b, float2 (&v)[ITEMS_X], const float* row) {
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j)
    v[j] = __ldg((const float2*)(row + (b.x0() + stream_item(b, j).tile) * 16 + 2 * b.g()));
}

// Partial sums of an item of the stream from all clusters, two in a word.
constexpr int FETCH = most(NH, 2) < 4 ? most(NH, 2) : 4;  // words at a time: no more than there ever are
__device__ __forceinline__ const uint4* partials(const Block& b, const uint4* buffer, Item item) {
  return buffer + ((b.x0() + item.tile) * NT + item.n) * PAIRS * 32 + b.lane;
}
// Asks until what `parts` clusters send is there, in words `first` and on; adds it up, what comes before `from` left out.
__device__ __forceinline__ void take(float4& sum, const uint4* p, int first, int from, int parts, u32 bit) {
  uint4 v[FETCH];
#pragma unroll
  for (int i = 0; i < FETCH; ++i) v[i] = peek(p + i * 32);
#pragma unroll 1
  for (;;) {
    bool again = false;
#pragma unroll
    for (int i = 0; i < FETCH; ++i) {
      const bool both = (NC % 2 == 0 && NH % 2 == 0) || 2 * (first + i) + 1 < parts;
      if (((v[i].x ^ bit) | (v[i].y ^ bit) | (both ? (v[i].z ^ bit) | (v[i].w ^ bit) : 0)) & 1)
        v[i] = peek(p + i * 32), again = true;
    }
    if (!again) break;
  }
#pragma unroll
  for (int i = 0; i < FETCH; ++i) {
    const bool both = (NC % 2 == 0 && NH % 2 == 0) || 2 * (first + i) + 1 < parts;
    if (PAIRS == FETCH || first + i >= from) {
      const float2 a = unpack_half(v[i].x), c = unpack_half(v[i].y);
      sum.x += a.x, sum.y += a.y, sum.z += c.x, sum.w += c.y;
      if (both) {
        const float2 a1 = unpack_half(v[i].z), c1 = unpack_half(v[i].w);
        sum.x += a1.x, sum.y += a1.y, sum.z += c1.x, sum.w += c1.y;
      }
    }
  }
}

// Fetch `parts` clusters' partial sums of a product, add them times the gate to the stream and, if `send_on`, send the
// slice times the next norm's scale to all ranks. buffer: [D16][NT][PAIRS][32] 16-byte words.
__device__ __forceinline__ void gather(const Block& b, float4 (&x)[ITEMS_X], const uint4* buffer, int parts, u32 bit,
                                       const float2 (&gates)[ITEMS_X], const float2 (&scales)[ITEMS_X], bool send_on,
                                       int half) {
  for (const u32 since = u32(clock64()); u32(clock64()) - since < PATIENCE;);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    const uint4* p = partials(b, buffer, item);
    if (item.real) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll 1
      for (int from = 0, words = most(parts, 2); from < words; from += FETCH) {
        const int first = min(from, max(words - FETCH, 0));  // the last round may ask for what the one before had
        take(sum, p + first * 32, first, from, parts, bit);
      }
      const float2 gate = make_float2(gates[j].x / PARTIAL_SCALE, gates[j].y / PARTIAL_SCALE);
      x[j].x += gate.x * sum.x, x[j].y += gate.x * sum.y, x[j].z += gate.y * sum.z, x[j].w += gate.y * sum.w;
    }
    __syncwarp();
    if (j == 0) {
      MARK(21 + half)
    }
    if (send_on) {
      const float4 y =
          make_float4(x[j].x * scales[j].x, x[j].y * scales[j].x, x[j].z * scales[j].y, x[j].w * scales[j].y);
      send_columns(b, M_X, b.x0() + item.tile, item.n, y, BAR_X, item.real);
    }
  }
  if (send_on) send_squares(b, x, BAR_X);
}

// A product back into the stream: this cluster's partial sums of the slice, for the CTAs of equal rank. Its partial
// sums lie over its own operand, region H. Nothing for region H can arrive before it is read: a peer sends queries or
// hidden units only when it has this rank's whole slice of the stream, which follows what is published here.
__device__ __forceinline__ void residual_product(Block& b, u32 x, int blocks, uint4* buffer, u32 bit) {
  float sums[plan_groups(DX)][NT * 4];
  constexpr int EVEN = F16 % NC == 0 && HC % 16 == 0 && QT % 16 == 0 ? 16
                       : F16 % NC == 0 && HC % 8 == 0 && QT % 8 == 0 ? 8
                                                                     : 1;
  multiply<DX, EVEN>(b, x, blocks, b.xn(), sums);
  Own<DX> own(b, b.xn());
  own.add_up(b, M_H, b.xn(), sums);
#pragma unroll
  for (int i = 0; i < plan_groups(DX); ++i)
#pragma unroll
    for (int k = 0; k < OWN<DX>; ++k) {
      const int n = own.n[i][k];
      if (own.mine[i][k] && n * 8 + 2 * b.t() < T) {
        const float4 c = own.sums[i][k];
        const uint4* const words = buffer + ((b.x0() + own.tile[i]) * NT + n) * PAIRS * 32 + b.lane;
        publish((uint2*)(words + b.cluster / 2 * 32) + (b.cluster & 1), pack_half(c.x * PARTIAL_SCALE, c.y * PARTIAL_SCALE),
                pack_half(c.z * PARTIAL_SCALE, c.w * PARTIAL_SCALE), bit);
      }
    }
}

// x (1 + tanh u) / 2 = x / (1 + exp(-2 u))
__device__ __forceinline__ float gelu(float x) {
  return __fdividef(x, 1.0f + exp2_approx(-2.302208198f * (x + 0.044715f * x * x * x)));  // 2 sqrt(2 / pi) log2 e
}

// Awaits the stream. gate|up and GeGLU: a tile has 8 units' gate rows, then their up rows. The next slice of the stream arrives in region X
// only when a peer has all of this rank's hidden units.
__device__ __forceinline__ void gate_up(Block& b, const float* shifted, const float* row_scales) {
  constexpr int GROUPS_ = plan_groups(GTL);
  const int gn = b.gn();
  Own<GTL> own(b, gn);
  float2 shift[GROUPS_], scale[GROUPS_];
#pragma unroll
  for (int i = 0; i < GROUPS_; ++i) {
    const int row = (QTL + KVL + min(own.tile[i], GTL - 1)) * 16 + b.g();
    shift[i] = make_float2(__ldg(shifted + row), __ldg(shifted + row + 8));
    if (FP8) scale[i] = make_float2(__ldg(row_scales + row), __ldg(row_scales + row + 8));
  }
  receive(b, BAR_X, b.x_parity, X_EXPECT, WAIT_X);
  b.x_parity ^= 1;
  MARK(13)
  float sums[GROUPS_][NT * 4];
  multiply<GTL, D16>(b, b.base + M_X, D16, gn, sums);
  MARK(15)
  own.add_up(b, M_X, gn, sums);
#pragma unroll
  for (int i = 0; i < GROUPS_; ++i)
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k)
      if (own.mine[i][k]) {
        const int n = own.n[i][k], at = b.g0() + own.tile[i], token = 2 * b.t() + (b.g() & 1);
        float4 c = own.sums[i][k];
        if (FP8) c = make_float4(c.x * scale[i].x, c.y * scale[i].x, c.z * scale[i].y, c.w * scale[i].y);
        const float2 r = inverse_rms(b, n * 8 + 2 * b.t());
        const float h0 = gelu(c.x * r.x + shift[i].x) * (c.z * r.x + shift[i].y),
                    h1 = gelu(c.y * r.y + shift[i].x) * (c.w * r.y + shift[i].y);
        // first two, then four, then all 8 units of a token in a lane: four lanes have the same, they share the ranks
        const float got = exchange(b.g() & 1 ? h0 : h1, 4);
        const u32 two = b.g() & 1 ? pack_operand(got, h1) : pack_operand(h0, got), next = exchange(two, 8);
        const u32 lo = b.g() & 2 ? next : two, hi = b.g() & 2 ? two : next;
        const u32 far_lo = exchange(lo, 16), far_hi = exchange(hi, 16);
        const uint4 units =
            b.g() & 4 ? make_uint4(far_lo, far_hi, lo, hi) : make_uint4(lo, hi, far_lo, far_hi);
        const u32 to = b.base + M_H + ((at >> 1) * NT + n) * 256 + (at & 1) * 128 + token * 16;
        if (n * 8 + token < T) {
          constexpr int QUARTER = most(S, 4);
          u32 data[QUARTER], bars[QUARTER];
#pragma unroll
          for (int d = 0; d < QUARTER; ++d) {
            const int rank = (b.g() >> 1) * QUARTER + d;
            data[d] = at_rank(to, rank), bars[d] = at_rank(b.bar(BAR_HID), rank);
          }
          static_assert(S % 4 == 0, "four lanes share the ranks");
#pragma unroll
          for (int d = 0; d < QUARTER; ++d) send(data[d], units, bars[d]);
        }
      }
  if (IDLE && threadIdx.x < S) send(at_rank(b.base + M_TOKEN, threadIdx.x), 0, at_rank(b.bar(BAR_HID), threadIdx.x));
}
