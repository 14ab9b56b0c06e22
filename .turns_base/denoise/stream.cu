// Part 7 of 13: the residual stream, and what goes into it: sums across clusters, GeGLU.

// `columns_of` to all ranks, where `columns_place` says.
__device__ __forceinline__ u32 columns_place(const Block& b, int region, int block, int n) {
  const int token = 2 * b.t() + (b.g() & 1);
  const int in_row = FP8 ? (b.g() >> 1) * 4 : (b.g() >> 2) * 128 + (b.g() >> 1 & 1) * 8;
  return b.base + region + (block * NT + n) * OPERAND + token * 16 + in_row;
}
__device__ __forceinline__ void send_columns(const Block& b, const Everyone& data, const Everyone& bars, int n,
                                             float4 v, bool real) {
  const uint2 columns = columns_of(b, v);
  const int token = 2 * b.t() + (b.g() & 1);
  if (real && n * 8 + token < T) {
#pragma unroll
    for (int d = 0; d < S; ++d)
      if (FP8)
        send(data.at[d], columns.x, bars.at[d]);
      else
        send(data.at[d], columns.x, columns.y, bars.at[d]);
  }
}
// Sums of squares to all ranks, which add them up. If tokens are few every warp sends those of its tiles, as soon as it
// has them; else see `publish_stream`.
__device__ __forceinline__ void send_tile_squares(const Block& b, float2 q, int i, int bar) {
  const int xn = b.xn(), absent = i - xn * NT;  // tiles that a rank lacks are sent as zeros
  if (i >= DX * NT) return;
  const int lacks = imax(DX - xn, 1);
  const int tile = absent < 0 ? i % xn : xn + absent % lacks, n = absent < 0 ? i / xn : absent / lacks;
  if (absent >= 0) q = make_float2(0, 0);
  static_assert(S == 8, "lane g serves rank g");
  const u32 to = b.base + M_SSQ + ((b.rank() * DX + tile) * NT * 8 + n * 8 + 2 * b.t()) * 4;
  if (n * 8 + 2 * b.t() < T)
    send(at_rank(to, b.g()), __float_as_uint(q.x), __float_as_uint(q.y), at_rank(b.bar(bar), b.g()));
}
__device__ __forceinline__ void send_squares(const Block& b, const float4 (&x)[ITEMS_X], int bar) {
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) send_tile_squares(b, squares_of(x[j]), b.warp() + j * W, bar);
}
constexpr u32 SQUARES_EXPECT = SPREAD ? S * NT * 32 : SQ * ((T + 1) / 2) * 8;
// 1 / rms of tokens `token` and `token` + 1 (even), once the stream is here: a spare warp makes them.
__device__ __forceinline__ float2 known_rms(const Block& b, int token) {
  return *(const float2*)(b.smem + M_RMS + token * 4);
}
__device__ __forceinline__ float2 inverse_rms(const Block& b, int token, int half) {
  barrier_wait(b.bar(BAR_RMS), half);
  return known_rms(b, token);
}
__device__ __forceinline__ float rms_from(const Block& b, float squares) {  // 1 / rms
  return rsqrtf(squares * (1.0f / D) + b.a.eps);
}
__device__ __forceinline__ void make_inverse_rms(const Block& b) {
  const int uses = b.a.steps * L * 2;
#pragma unroll 1
  for (int use = 0; use < uses; ++use) {
    barrier_wait(b.bar(SPREAD ? int(BAR_SQUARES) : int(BAR_X)), use & 1);
    if (SPREAD && b.lane() == 0) barrier_expect(b.bar(BAR_SQUARES), SQUARES_EXPECT);
    constexpr int LANES = imax(32 / (NT * 8), 1), TOKENS = 32 / LANES;  // lanes of a token, tokens at once
#pragma unroll 1
    for (int token = b.lane() % TOKENS; token < NT * 8; token += 32) {
      float sum = 0;
#pragma unroll 8
      for (int s = b.lane() / TOKENS; s < SQ; s += LANES)
        sum += *(const float*)(b.smem + M_SSQ + (s * NT * 8 + token) * 4);
#pragma unroll
      for (int o = TOKENS; o < 32; o *= 2) sum += exchange(sum, o);
      *(float*)(b.smem + M_RMS + token * 4) = rms_from(b, sum);
    }
    __syncwarp();
    if (b.lane() == 0) barrier_arrive(b.bar(BAR_RMS));
  }
}
constexpr u32 X_EXPECT = D16 * (SPREAD ? NT * 8 : T) * (OPERAND / 8) + (SPREAD ? 0 : SQUARES_EXPECT);
// The stream that comes before attention, or (half 1) the feed-forward.
__device__ __forceinline__ void receive_stream(const Block& b, int half) {
  if constexpr (SPREAD) note(b, WAIT_X), await_slice(b);
  receive(b, BAR_X, half, X_EXPECT, WAIT_X);
}

// A lane's columns of a row of the table. Asked for well before `gather`: its polls would queue up behind them.
__device__ __forceinline__ void load_columns(const Block& b, float2 (&v)[ITEMS_X], const float* row) {
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j)
    v[j] = __ldg((const float2*)(row + (b.x0() + stream_item(b, j).tile) * 16 + 2 * b.g()));
}

// Partial sums of an item of the stream from all clusters, two in a word (SPREAD: see `take_singly`).
constexpr int FETCH = imin(PAIRS, 4);  // words at a time
__device__ __forceinline__ const uint4* partials(const Block& b, const uint4* buffer, Item item) {
  return buffer + ((b.x0() + item.tile) * NT + item.n) * PAIRS * 32 + b.lane();
}
// Asks until what the clusters send is there, in words `first` and on (of `real` tokens: others never come); adds it up,
// without what comes before `from`.
__device__ __forceinline__ void take(float4& sum, const uint4* p, int first, int from, u32 bit, bool real) {
  uint4 v[FETCH];
#pragma unroll
  for (int i = 0; i < FETCH; ++i) v[i] = peek(p + i * 32);
#pragma unroll 1
  for (;;) {
    u32 missing[FETCH], any = 0;
#pragma unroll
    for (int i = 0; i < FETCH; ++i) {
      missing[i] = differing(v[i].x, bit, differing(v[i].y, bit, differing(v[i].z, bit, v[i].w ^ bit)));
      any |= missing[i];
    }
    if (!__any_sync(~0u, real && any & 1)) break;
#pragma unroll
    for (int i = 0; i < FETCH; ++i)
      if (missing[i] & 1) v[i] = peek(p + i * 32);
  }
#pragma unroll
  for (int i = 0; i < FETCH; ++i) {
    if (PAIRS == FETCH || first + i >= from) {
      const float2 a = unpack_half(v[i].x), c = unpack_half(v[i].y);
      sum.x += a.x, sum.y += a.y, sum.z += c.x, sum.w += c.y;
      const float2 a1 = unpack_half(v[i].z), c1 = unpack_half(v[i].w);
      sum.x += a1.x, sum.y += a1.y, sum.z += c1.x, sum.w += c1.y;
    }
  }
}

// The same if SPREAD, where a word is of one cluster.
constexpr int FETCH_SINGLY = imin(NC, 8);
__device__ __forceinline__ void take_singly(float4& sum, const uint2* p, int from, u32 bit, bool real) {
  constexpr int N = FETCH_SINGLY;
  const int first = min(from, max(NC - N, 0));
  uint2 v[N];
  auto ask = [&](int i) { v[i] = peek(p + (first + i) * 32); };
#pragma unroll
  for (int i = 0; i < N; ++i) ask(i);
#pragma unroll 1
  for (;;) {
    u32 missing[N], any = 0;
#pragma unroll
    for (int i = 0; i < N; ++i) missing[i] = differing(v[i].x, bit, v[i].y ^ bit), any |= missing[i];
    if (!__any_sync(~0u, real && any & 1)) break;
#pragma unroll
    for (int i = 0; i < N; ++i)
      if (missing[i] & 1) ask(i);
  }
#pragma unroll
  for (int i = 0; i < N; ++i)
    if (first + i >= from) {
      const float2 a = unpack_half(v[i].x), c = unpack_half(v[i].y);
      sum.x += a.x, sum.y += a.y, sum.z += c.x, sum.w += c.y;
    }
}

// For `advance`, of few tokens: a warp's item as [16 columns][8 tokens]. Region X is free: every rank's hidden units have
// come, so no sums of gate|up are still being read there.
__device__ __forceinline__ float* kept_item(const Block& b, int i) {
  return (float*)(b.smem + M_X + X_XS + i * XS_ITEM);
}
__device__ __forceinline__ void keep_item(const Block& b, int j, float4 y) {
  const int i = b.warp() + j * W;
  if (i >= b.xn() * NT) return;
  float* const to = kept_item(b, i) + b.g() * 16 + b.t() * 2;
  *(float2*)to = make_float2(y.x, y.y), *(float2*)(to + 8) = make_float2(y.z, y.w);
}

// Fetch the clusters' partial sums of a product, add them times the gate to the stream and, if `send_on`, send the
// slice times the next norm's scale to all ranks (SPREAD: publish it), if `last` keep it. buffer:
// [D16][NT][PAIRS][32] 16-byte words, or [D16][NT][NC][32] 8-byte words.
__device__ __forceinline__ void gather(Block& b, float4 (&x)[ITEMS_X], const uint4* buffer, u32 bit,
                                       const float2 (&gates)[ITEMS_X], const float2 (&scales)[ITEMS_X], bool send_on,
                                       int half, bool last) {
  const u32 since = u32(clock64());
  const uint4* words[ITEMS_X];  // addresses are made while there is nothing else to do
  Everyone places[ITEMS_X], bars;
  if (!SPREAD) bars = Everyone(b.bar(BAR_X));
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    words[j] = partials(b, buffer, item);
    if (PATIENCE) words[j] = settled(words[j]);
    if (!SPREAD) places[j] = Everyone(columns_place(b, M_X, b.x0() + item.tile, item.n));
  }
  pause(since, PATIENCE);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    const uint4* p = words[j];
    if (item.mine) {
      float4 sum = make_float4(0, 0, 0, 0);
      if constexpr (SPREAD) {
#pragma unroll 1
        for (int from = 0; from < NC; from += FETCH_SINGLY)
          take_singly(sum, (const uint2*)(p - b.lane()) + b.lane(), from, bit, item.real);
      } else {
#pragma unroll 1
        for (int from = 0; from < PAIRS; from += FETCH) {
          const int first = min(from, max(PAIRS - FETCH, 0));  // the last round may ask for what the one before had
          take(sum, p + first * 32, first, from, bit, item.real);
        }
      }
      const float2 gate = make_float2(gates[j].x / PARTIAL_SCALE, gates[j].y / PARTIAL_SCALE);
      if (item.real)
        x[j].x += gate.x * sum.x, x[j].y += gate.x * sum.y, x[j].z += gate.y * sum.z, x[j].w += gate.y * sum.w;
    }
    __syncwarp();
    if (j == 0) {
      MARK(half ? MARK_DOWN_SUMS_HERE : MARK_OUT_SUMS_HERE)
    }
    if (!SPREAD && (send_on || last)) {
      const float4 y = scaled(x[j], scales[j]);
      if (send_on) {
        const float2 q = squares_of(x[j]);  // first: what lanes exchange waits behind sends
        send_columns(b, places[j], bars, item.n, y, item.real);
        send_tile_squares(b, q, b.warp() + j * W, BAR_X);
      } else {
        keep_item(b, j, y);
      }
    }
  }
  if (send_on) {
    if constexpr (SPREAD) publish_stream(b, x, scales);
  }
}

// Registers of sends, which are read when their turn comes: whatever else is written there waits some 500 cycles. So
// nothing is until the next product's weights have been read. (Few tokens: with more there are no registers to spare.)
struct Sent {
  uint4 units, places;
};

// A product back into the stream: this cluster's partial sums of the slice, for the CTAs of equal rank. Its partial
// sums lie over its own operand, region H, unless they have a place of their own. Nothing for region H can arrive
// before it is read: a peer sends queries or hidden units only when it has this rank's whole slice of the stream, which
// follows what is published here. `sent` is kept until weights have been read; `await` until the operand is here;
// `then`, behind the product, what else there is.
template <int EVEN, typename Await, typename Then>
__device__ __forceinline__ void residual_product(Block& b, int x, int blocks, int region, uint4* buffer, u32 bit,
                                                 Await await, Then then, const Sent& sent) {
  Ahead<group_tiles(DX), RESIDUAL_AHEAD> ahead(b);
  Own<DX> own(b, b.xn());
  uint2* place[plan_groups(DX)][OWN<DX>];  // in the buffer
#pragma unroll
  for (int i = 0; i < plan_groups(DX); ++i)
#pragma unroll
    for (int k = 0; k < OWN<DX>; ++k) {
      const uint4* const words = buffer + ((b.x0() + own.tile[i]) * NT + own.n[i][k]) * PAIRS * 32 + b.lane();
      if (SPREAD)
        place[i][k] = (uint2*)(words - b.lane()) + b.cluster() * 32 + b.lane();
      else
        place[i][k] = (uint2*)(words + b.cluster() / 2 * 32) + (b.cluster() & 1);
      if (FEW) place[i][k] = settled(place[i][k]);
    }
  if (FEW) keep_until_here(sent.units), keep_until_here(sent.places);
  await();
  show_to_products();
  float sums[plan_groups(DX)][NT * 4];
  multiply<DX, EVEN>(b, x, blocks, b.xn(), sums, ahead);
  then();
  own.add_up(b, region, b.xn(), sums);
#pragma unroll
  for (int i = 0; i < plan_groups(DX); ++i)
#pragma unroll
    for (int k = 0; k < OWN<DX>; ++k) {
      const int n = own.n[i][k];
      if (own.mine[i][k] && n * 8 + 2 * b.t() < T) {
        const float4 c = own.sums[i][k];
        publish(place[i][k], pack_half(c.x * PARTIAL_SCALE, c.y * PARTIAL_SCALE),
                pack_half(c.z * PARTIAL_SCALE, c.w * PARTIAL_SCALE), bit);
      }
    }
}

// x (1 + tanh u) / 2 = x / (1 + exp(-2 u)). E4M3 rounds far more coarsely than an approximate tanh, which takes one
// turn of the special function unit instead of two.
__device__ __forceinline__ float gelu(float x) {
  if constexpr (FP8 && SPREAD) {
    float tanh_u;
    asm("tanh.approx.f32 %0, %1;" : "=f"(tanh_u) : "f"(x * (0.7978845608f + 0.0356774081f * x * x)));
    return 0.5f * x * tanh_u + 0.5f * x;
  }
  return __fdividef(x, 1.0f + exp2_approx(-2.302208198f * (x + 0.044715f * x * x * x)));  // 2 sqrt(2 / pi) log2 e
}

// Awaits the stream. gate|up and GeGLU: a tile has 8 units' gate rows, then their up rows. The next slice of the stream
// arrives in region X only when a peer has all of this rank's hidden units.
__device__ __forceinline__ void gate_up(Block& b, const float* shifted, const float* row_scales, Sent& sent) {
  constexpr int GROUPS_ = plan_groups(GTL);
  const int gn = b.gn();
  Own<GTL> own(b, gn);
  float2 shift[GROUPS_], scale[GROUPS_];
  const int token = 2 * b.t() + (b.g() & 1);
  u32 place[GROUPS_][OWN<GTL>];  // of the hidden units, at any rank
#pragma unroll
  for (int i = 0; i < GROUPS_; ++i) {
    const int row = (QTL + KVL + min(own.tile[i], GTL - 1)) * 16 + b.g();
    shift[i] = make_float2(__ldg(shifted + row), __ldg(shifted + row + 8));
    if (FP8) scale[i] = make_float2(__ldg(row_scales + row), __ldg(row_scales + row + 8));
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k) {
      const int at = b.g0() + own.tile[i];
      place[i][k] =
          b.base + M_HID + ((at >> 1) * NT + own.n[i][k]) * OPERAND + (at & 1) * (FP8 ? 8 : 128) + token * 16;
      if (COPY_HIDDEN) place[i][k] += X_OWN_HIDDEN - (b.g0() >> 1) * NT * OPERAND;
      if (FEW) place[i][k] = settled(place[i][k]);
    }
  }
  Ahead<group_tiles(GTL), GATE_UP_AHEAD> ahead(b);
  receive_stream(b, 1);
  MARK(MARK_STREAM_FOR_FEED_FORWARD)
  float sums[GROUPS_][NT * 4];
  if (!SPREAD) show_to_products();  // what the copy engine wrote needs none
  multiply<GTL, D16>(b, M_X, D16, gn, sums, ahead);
  MARK(MARK_GATE_UP_MULTIPLIED)
  if constexpr (SPREAD) consumers_sync(), give_room(b);
  own.add_up(b, SPREAD ? M_X + X_FF_SUMS : M_X, gn, sums);
  constexpr int QUARTER = most(S, 4);
  static_assert(S % 4 == 0, "four lanes share the ranks");
  u32 window[QUARTER], hidden_bars[QUARTER];  // if SPREAD: this CTA's shared memory as theirs
  if constexpr (SPREAD && !COPY_HIDDEN) {
#pragma unroll
    for (int d = 0; d < QUARTER; ++d) {
      const int rank = (b.g() >> 1) * QUARTER + d;
      window[d] = at_rank(b.base, rank), hidden_bars[d] = at_rank(b.bar(BAR_HID), rank);
    }
  }
  if constexpr (SPREAD) inverse_rms(b, 0, 1);
#pragma unroll
  for (int i = 0; i < GROUPS_; ++i)
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k)
      if (own.mine[i][k]) {
        const int n = own.n[i][k];
        float4 c = own.sums[i][k];
        if (FP8) c = scaled(c, scale[i]);
        const float2 r = SPREAD ? known_rms(b, n * 8 + 2 * b.t()) : inverse_rms(b, n * 8 + 2 * b.t(), 1);
        const float h0 = gelu(c.x * r.x + shift[i].x) * (c.z * r.x + shift[i].y),
                    h1 = gelu(c.y * r.y + shift[i].x) * (c.w * r.y + shift[i].y);
        // first two, then four, then all 8 units of a token in a lane: four lanes have the same, they share the ranks
        const float got = exchange(b.g() & 1 ? h0 : h1, 4);
        const u32 two = b.g() & 1 ? pack_operand(got, h1) : pack_operand(h0, got);
        if constexpr (COPY_HIDDEN) {  // of a token that doesn't exist any
          byte* const p = b.smem + (place[i][k] - b.base) + (b.g() >> 1) * (FP8 ? 2 : 4);
          if (FP8)
            *(unsigned short*)p = (unsigned short)two;
          else
            *(u32*)p = two;
          continue;
        }
        const u32 next = exchange(two, 8);
        const u32 lo = b.g() & 2 ? next : two, hi = b.g() & 2 ? two : next;
        uint4 units;  // E4M3: the first two words
        if constexpr (FP8) {
          const u32 four = lo | hi << 16, far = exchange(four, 16);
          units = b.g() & 4 ? make_uint4(far, four, 0, 0) : make_uint4(four, far, 0, 0);
        } else {
          const u32 far_lo = exchange(lo, 16), far_hi = exchange(hi, 16);
          units = b.g() & 4 ? make_uint4(far_lo, far_hi, lo, hi) : make_uint4(lo, hi, far_lo, far_hi);
        }
        if (SPREAD && i + k == 0) await_room(b);
        if (n * 8 + token < T) {
          u32 data[QUARTER], bars[QUARTER];
#pragma unroll
          for (int d = 0; d < QUARTER; ++d) {
            const int rank = (b.g() >> 1) * QUARTER + d;
            data[d] = SPREAD ? window[d] + (place[i][k] - b.base) : at_rank(place[i][k], rank);
            bars[d] = SPREAD ? hidden_bars[d] : at_rank(b.bar(BAR_HID), rank);
          }
#pragma unroll
          for (int d = 0; d < QUARTER; ++d)
            if (FP8)
              send(data[d], units.x, units.y, bars[d]);
            else
              send(data[d], units, bars[d]);
          static_assert(QUARTER == 2, "what `sent` has room for");
          if (FEW) sent = {units, make_uint4(data[0], data[1], bars[0], bars[1])};
        }
      }
  if constexpr (COPY_HIDDEN) {
    show_to_products();  // to the copy engine, that is
    if (const int block = own.tile[0] >> 1; block < GTL / 2) {
      __syncwarp();
      asm volatile("bar.sync %0, 128;" ::"r"(HIDDEN_BLOCK_MADE + block) : "memory");  // attention's barriers are free
      await_room(b);
      if ((own.tile[0] & 1) == 0 && Share(b, group_parts(GTL)).part == 0 && b.lane() == 0) {  // of the four warps one
        constexpr u32 BYTES = NT * OPERAND;
        const u32 mine = (b.g0() >> 1) * BYTES + block * BYTES;
        byte* const there = (byte*)(b.a.scratch + B_HIDDEN) + b.cluster() * (HC * BYTES) + mine;
        copy_to_all(b, M_X + X_OWN_HIDDEN + block * BYTES, there, M_HID + mine, BYTES, BAR_HID);
      }
      __syncwarp();
    }
  }
  if constexpr (SPREAD) await_room(b), ++b.room;
  if (IDLE) {
    inverse_rms(b, 0, 1), consumers_sync();  // no warp may be left behind by a whole use of a barrier
    if (b.thread < S) send(at_rank(b.base + M_TOKEN, b.thread), 0, at_rank(b.bar(BAR_HID), b.thread));
  }
}
