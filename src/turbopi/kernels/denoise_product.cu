// Part 4 of 6: matrix products and the residual stream.

__device__ __forceinline__ u32 take_slot(Block& b) {
  const u32 slot = b.slot;
  mbar_wait(b.full(slot), b.phase);
  __syncwarp();
  if (++b.slot == STAGES) b.slot = 0, b.phase ^= 1;
  return slot;
}
// Give a slot back. Not before the loads from it have arrived: the copy engine isn't ordered behind loads that are
// still on their way (seen as wrong sums). Hence an address that needs what they brought.
__device__ __forceinline__ void give_slot(const Block& b, u32 slot, u32 seen) {
  __syncwarp();
  if (b.lane == 0) mbar_arrive(b.empty(slot) + (seen & b.a.zero));
}

__device__ __forceinline__ uint4 load_fragment(const byte* p, int lane) { return *(const uint4*)(p + lane * 16); }
__device__ __forceinline__ u32 fold(uint4 v) { return v.x; }

// One group of tiles, this warp's share of it. x: activations in shared memory; `blocks` of the reduction, a multiple
// of EVEN.
template <int TILES_, bool WIDE, int EVEN>
__device__ __forceinline__ void multiply_group(Block& b, const byte* x, int blocks, float (*acc)[NT][4]) {
  using G = Group<TILES_, WIDE>;
  constexpr int TPW = G::TPW, KS = G::KS, KPS = RPS / TPW;  // steps along the reduction in one slot
  static_assert(KPS > 0, "a slot holds a step");
  constexpr bool EXACT = EVEN % (KB * KS * KPS) == 0;
  constexpr bool ROOM = !FP8 || FEW;  // registers for a slot's activations
  const int ks = b.warp % KS, slots = most(most(most(blocks, KB), KS), KPS);
#pragma unroll
  for (int i = 0; i < TPW; ++i) clear(acc[i]);
  const byte* mine = x + ks * KB * NT * 256 + b.lane * 8;
#pragma unroll 1
  for (int s0 = 0; s0 < slots; ++s0) {
    uint4 w[KPS][TPW];
    uint2 v[KPS][KB][NT];
    auto exists = [&](int k, int h) { return EXACT || ((s0 * KPS + k) * KS + ks) * KB + h < blocks; };
    auto activation = [&](int k, int h, int n) {
      return *(const uint2*)(mine + (((s0 * KPS + k) * KS * KB + h) * NT + n) * 256);
    };
    auto load_activations = [&] {
#pragma unroll
      for (int k = 0; k < KPS; ++k)
#pragma unroll
        for (int h = 0; h < KB; ++h)
          if (exists(k, h))
#pragma unroll
            for (int n = 0; n < NT; ++n) v[k][h][n] = activation(k, h, n);
    };
    if (FEW) load_activations();  // they don't wait for the slot
    const u32 slot = take_slot(b);
    const byte* from = b.ring(slot) + b.warp * FRAGMENT;
#pragma unroll
    for (int k = 0; k < KPS; ++k)
#pragma unroll
      for (int j = 0; j < TPW; ++j) w[k][j] = load_fragment(from + (k * TPW + j) * ROW, b.lane);
    if (!FEW && ROOM) load_activations();
    u32 seen = 0;
#pragma unroll
    for (int k = 0; k < KPS; ++k)
#pragma unroll
      for (int h = 0; h < KB; ++h)
        if (exists(k, h)) {
#pragma unroll
          for (int j = 0; j < TPW; ++j) {
            if (h == 0) seen ^= fold(w[k][j]);
#pragma unroll
            for (int n = 0; n < NT; ++n) mma_weights(acc[j][n], w[k][j], h, ROOM ? v[k][h][n] : activation(k, h, n));
          }
        }
    give_slot(b, slot, seen);
  }
}

// Up to MT tiles (`tiles` of them; groups that would be empty are left out, in the weights too) times the activations.
template <int MT, bool WIDE, int EVEN, int FIRST = 0, int AT = 0>
__device__ __forceinline__ void multiply(Block& b, const byte* x, int blocks, int tiles, float (*acc)[NT][4]) {
  if constexpr (FIRST < MT) {
    constexpr int N = group_tiles(MT - FIRST);
    if (FIRST < tiles) {
      multiply_group<N, WIDE, EVEN>(b, x, blocks, acc + AT);
      multiply<MT, WIDE, EVEN, FIRST + N, AT + Group<N, WIDE>::TPW>(b, x, blocks, tiles, acc);
    }
  }
}

// Where a lane's partial sums of 8 tokens lie. Of the last 8 only pairs that exist are kept.
__device__ __forceinline__ int partial_place(const Block& b, int n) {
  return n * 512 + (TAIL == 4 || n + 1 < NT ? b.lane : b.g() * TAIL + min(b.t(), TAIL - 1)) * 16;
}
// The warps' partial sums to shared memory, and a tile's total back, always in the same order.
template <int MT, bool WIDE, int FIRST = 0, int AT = 0>
__device__ __forceinline__ void store_partials(const Block& b, byte* to, int tiles, float (*acc)[NT][4]) {
  if constexpr (FIRST < MT) {
    constexpr int N = group_tiles(MT - FIRST);
    using G = Group<N, WIDE>;
    if (FIRST < tiles) {
#pragma unroll
      for (int j = 0; j < G::TPW; ++j)
#pragma unroll
        for (int n = 0; n < NT; ++n) {
          const int tile = j * G::MG + b.warp / G::KS, part = AT * W + tile * G::KS + b.warp % G::KS;
          if (n + 1 < NT || b.t() < TAIL)
            *(float4*)(to + part * PARTIAL + partial_place(b, n)) =
                make_float4(acc[AT + j][n][0], acc[AT + j][n][1], acc[AT + j][n][2], acc[AT + j][n][3]);
        }
      store_partials<MT, WIDE, FIRST + N, AT + G::TPW>(b, to, tiles, acc);
    }
  }
}
template <int MT, bool WIDE, int FIRST = 0, int AT = 0>
__device__ __forceinline__ float4 total(const Block& b, const byte* from, int tile, int n) {
  constexpr int N = group_tiles(MT - FIRST);
  using G = Group<N, WIDE>;
  if constexpr (FIRST + N < MT)
    if (tile >= FIRST + N) return total<MT, WIDE, FIRST + N, AT + G::TPW>(b, from, tile, n);
  const byte* p = from + (AT * W + (tile - FIRST) * G::KS) * PARTIAL + partial_place(b, n);
  float4 v[G::KS];
#pragma unroll
  for (int i = 0; i < G::KS; ++i) v[i] = *(const float4*)(p + i * PARTIAL);
#pragma unroll
  for (int d = 1; d < G::KS; d *= 2)
#pragma unroll
    for (int i = 0; i + d < G::KS; i += 2 * d)
      v[i].x += v[i + d].x, v[i].y += v[i + d].y, v[i].z += v[i + d].z, v[i].w += v[i + d].w;
  return v[0];
}

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
// Permuted order: 16 bytes with eight columns of one token (even g: 2t, odd g: 2t + 1) to all ranks. Two lanes come to
// have the same: they share the ranks.
__device__ __forceinline__ void send_columns(const Block& b, int region, int block, int n, float4 v, int bar,
                                             bool real) {
  const bool odd = b.g() & 1, high = b.g() & 2;
  const u32 w0 = pack_operand(v.x, v.z), w1 = pack_operand(v.y, v.w), got = exchange(odd ? w0 : w1, 4);
  const u32 x = odd ? got : w0, y = odd ? w1 : got, other_x = exchange(x, 8), other_y = exchange(y, 8);
  const int token = 2 * b.t() + (b.g() & 1), d0 = high ? S / 2 : 0;
  const u32 to = b.base + region + (block * NT + n) * 256 + token * 32 + (b.g() >> 2) * 16;
  static_assert(S % 2 == 0, "half of the ranks each");
  if (real && n * 8 + token < T) {
    const float4 all = make_float4(__uint_as_float(high ? other_x : x), __uint_as_float(high ? other_y : y),
                                   __uint_as_float(high ? x : other_x), __uint_as_float(high ? y : other_y));
    u32 data[S / 2], bars[S / 2];
#pragma unroll
    for (int d = 0; d < S / 2; ++d) data[d] = at_rank(to, d0 + d), bars[d] = at_rank(b.bar(bar), d0 + d);
#pragma unroll
    for (int d = 0; d < S / 2; ++d) send(data[d], all, bars[d]);
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

// Fetch `parts` clusters' partial sums of a product, add them times the gate to the stream and, if `send_on`, send the
// slice times the next norm's scale to all ranks. buffer: [NC][D16][NT][32] 16-byte words.
__device__ __forceinline__ void gather(const Block& b, float4 (&x)[ITEMS_X], const uint4* buffer, int parts, u32 bit,
                                       const float2 (&gates)[ITEMS_X], const float2 (&scales)[ITEMS_X], bool send_on,
                                       int half) {
  constexpr int FETCH = NH < 8 ? NH : 8;  // no more than there ever are
  constexpr size_t STRIDE = size_t(D16) * NT * 32;
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    for (const u32 since = u32(clock64()); u32(clock64()) - since < PATIENCE;);
    if (item.real) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll 1
      for (int c0 = 0; c0 < parts; c0 += FETCH) {
        uint4 v[FETCH];
        const int first = min(c0, max(parts - FETCH, 0));  // the last round may ask again for what the one before had
        poll(v, buffer + first * STRIDE + ((b.x0() + item.tile) * NT + item.n) * 32 + b.lane, STRIDE, bit);
#pragma unroll
        for (int i = 0; i < FETCH; ++i)
          if (NC == FETCH || first + i >= c0) {
            sum.x += __uint_as_float(v[i].x), sum.y += __uint_as_float(v[i].y);
            sum.z += __uint_as_float(v[i].z), sum.w += __uint_as_float(v[i].w);
          }
      }
      x[j].x += gates[j].x * sum.x, x[j].y += gates[j].x * sum.y, x[j].z += gates[j].y * sum.z,
          x[j].w += gates[j].y * sum.w;
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
__device__ __forceinline__ void residual_product(Block& b, const byte* x, int blocks, uint4* buffer, u32 bit) {
  float acc[plan_tpw(DX, false)][NT][4];
  constexpr int EVEN = F16 % NC == 0 && HC % 16 == 0 && QT % 16 == 0 ? 16
                       : HC % 8 == 0 && F16 % NC == 0 && QT % 8 == 0 ? 8
                                                                     : 1;
  multiply<DX, false, EVEN>(b, x, blocks, b.xn(), acc);
  consumers_sync();
  store_partials<DX, false>(b, b.smem + M_H, b.xn(), acc);
  consumers_sync();
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    if (item.real)
      publish(buffer + ((size_t(b.cluster) * D16 + b.x0() + item.tile) * NT + item.n) * 32 + b.lane,
              total<DX, false>(b, b.smem + M_H, item.tile, item.n), bit);
  }
}

// x (1 + tanh u) / 2 = x / (1 + exp(-2 u))
__device__ __forceinline__ float gelu(float x) {
  return __fdividef(x, 1.0f + exp2_approx(-2.302208198f * (x + 0.044715f * x * x * x)));  // 2 sqrt(2 / pi) log2 e
}

// gate|up and GeGLU: a tile has 8 units' gate rows, then their up rows. Its partial sums lie over the stream in region
// X, where the next slice arrives only when a peer has all of this rank's hidden units.
__device__ __forceinline__ void gate_up(Block& b, const float* shifted, const float* row_scales) {
  constexpr int ITEMS = most(GTL * NT, W);
  const int gn = b.gn();
  float2 shift[ITEMS], scale[ITEMS];
#pragma unroll
  for (int j = 0; j < ITEMS; ++j) {
    const int i = b.warp + j * W;
    const int row = (QTL + KVL + (i < gn * NT ? i % gn : 0)) * 16 + b.g();
    shift[j] = make_float2(__ldg(shifted + row), __ldg(shifted + row + 8));
    if (FP8) scale[j] = make_float2(__ldg(row_scales + row), __ldg(row_scales + row + 8));
  }
  float acc[plan_tpw(GTL, true)][NT][4];
  multiply<GTL, true, D16>(b, b.smem + M_X, D16, gn, acc);
  MARK(15)
  consumers_sync();
  store_partials<GTL, true>(b, b.smem + M_X, gn, acc);
  consumers_sync();
#pragma unroll
  for (int j = 0; j < ITEMS; ++j) {
    const int i = b.warp + j * W;
    if (i < gn * NT) {
      const int tile = i % gn, n = i / gn, at = b.g0() + tile, token = 2 * b.t() + (b.g() & 1);
      float4 c = total<GTL, true>(b, b.smem + M_X, tile, n);
      if (FP8) c = make_float4(c.x * scale[j].x, c.y * scale[j].x, c.z * scale[j].y, c.w * scale[j].y);
      const float2 r = inverse_rms(b, n * 8 + 2 * b.t());
      const float h0 = gelu(c.x * r.x + shift[j].x) * (c.z * r.x + shift[j].y),
                  h1 = gelu(c.y * r.y + shift[j].x) * (c.w * r.y + shift[j].y);
      const float got = exchange(b.g() & 1 ? h0 : h1, 4);
      const u32 word = b.g() & 1 ? pack_operand(got, h1) : pack_operand(h0, got),
                other = exchange(word, 8);  // units g & ~1.. and the next two
      const u32 to = b.base + M_H + ((at >> 1) * NT + n) * 256 + (token * 4 + (at & 1) * 2 + (b.g() >> 2)) * 8;
      if (n * 8 + token < T) {  // two lanes have the same 8 bytes: they share the ranks
        constexpr int HALF = (S + 1) / 2;
        const u32 lo = b.g() & 2 ? other : word, hi = b.g() & 2 ? word : other;
        const int d0 = b.g() & 2 ? HALF : 0;
        u32 data[HALF], bars[HALF];
#pragma unroll
        for (int d = 0; d < HALF; ++d) data[d] = at_rank(to, d0 + d), bars[d] = at_rank(b.bar(BAR_HID), d0 + d);
#pragma unroll
        for (int d = 0; d < HALF; ++d)
          if (S % 2 == 0 || d0 + d < S) send(data[d], lo, hi, bars[d]);
      }
    }
  }
  if (IDLE && threadIdx.x < S) send(at_rank(b.base + M_TOKEN, threadIdx.x), 0, at_rank(b.bar(BAR_HID), threadIdx.x));
}
