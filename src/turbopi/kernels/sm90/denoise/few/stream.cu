// Few tokens: every cluster keeps the whole stream. Each CTA adds up its slice for all tokens, and the ranks send their
// slices to each other.

__device__ __forceinline__ Item stream_item(const Cta& b, int j) {
  const u32 i = b.warp() + j * W, xn = b.xn();  // unsigned: divisions become shifts
  const int tile = i < xn * NT ? i % xn : 0, n = i < xn * NT ? i / xn : 0;
  return {tile, n, n * 8 + 2 * b.t(), i < xn * NT, i < xn * NT && n * 8 + 2 * b.t() < T};
}

// Sums of squares to all ranks, which add them up: every warp sends those of its tiles, as soon as it has them.
__device__ __forceinline__ void send_tile_squares(const Cta& b, float2 q, int i, int bar) {
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
__device__ __forceinline__ void send_squares(const Cta& b, const float4 (&x)[ITEMS_X], int bar) {
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) send_tile_squares(b, squares_of(x[j]), b.warp() + j * W, bar);
}
constexpr u32 SQUARES_EXPECT = SQ * ((T + 1) / 2) * 8;
// A spare warp: until sums of squares of the stream's use `use` are here.
__device__ __forceinline__ void await_squares(const Cta& b, int use) { barrier_wait(b.bar(BAR_X), use & 1); }

constexpr u32 X_EXPECT = D16 * T * (OPERAND / 8) + SQUARES_EXPECT;
// The stream that comes before attention, or (half 1) the feed-forward.
__device__ __forceinline__ void receive_stream(const Cta& b, int half) {
  receive(b, BAR_X, half, X_EXPECT, WAIT_X);
}

// Partial sums of an item of the stream from all clusters, a lane's four of two
// clusters side by side in a word.
constexpr int FETCH = imin(PAIRS, 4);  // words at a time
__device__ __forceinline__ const uint4* partials(const Cta& b, const uint4* buffer, Item item) {
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

// For `advance`: a warp's item as [16 columns][8 tokens]. Region X is free: every rank's hidden units have
// come, so no sums of gate|up are still being read there.
__device__ __forceinline__ float* kept_item(const Cta& b, int i) {
  return (float*)(b.smem + M_X + X_XS + i * XS_ITEM);
}
__device__ __forceinline__ void keep_item(const Cta& b, int j, float4 y) {
  const int i = b.warp() + j * W;
  if (i >= b.xn() * NT) return;
  float* const to = kept_item(b, i) + b.g() * 16 + b.t() * 2;
  *(float2*)to = make_float2(y.x, y.y), *(float2*)(to + 8) = make_float2(y.z, y.w);
}

constexpr u32 PATIENCE = 500;  // clock cycles before sums are asked for: polls slow down what they wait for
// Fetch the clusters' partial sums of a product, add them times the gate to the stream and, if `send_on`, send the
// slice times the next norm's scale to all ranks, if `last` keep it. buffer: [D16][NT][PAIRS][32] 16-byte words.
__device__ __forceinline__ void gather(Cta& b, float4 (&x)[ITEMS_X], const uint4* buffer, u32 bit,
                                       const Factors (&gates)[ITEMS_X], const Factors (&scales)[ITEMS_X], bool send_on,
                                       int half, bool last) {
  const u32 since = u32(clock64());
  const uint4* words[ITEMS_X];  // addresses are made while there is nothing else to do
  Everyone places[ITEMS_X], bars = Everyone(b.bar(BAR_X));
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    words[j] = settled(partials(b, buffer, item));
    places[j] = Everyone(columns_place(b, M_X, b.x0() + item.tile, item.n));
  }
  pause(since, PATIENCE);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    const uint4* p = words[j];
    if (item.mine) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll 1
      for (int from = 0; from < PAIRS; from += FETCH) {
        const int first = min(from, max(PAIRS - FETCH, 0));  // the last round may ask for what the one before had
        take(sum, p + first * 32, first, from, bit, item.real);
      }
      add_gated(x[j], sum, gates[j], item.real);
    }
    __syncwarp();
    if (j == 0) {
      MARK(half ? MARK_DOWN_SUMS_HERE : MARK_OUT_SUMS_HERE)
    }
    if (send_on || last) {
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
}

// Where a cluster's partial sums of (tile, 8 tokens n) of the slice go, for `gather`.
__device__ __forceinline__ uint2* sums_place(const Cta& b, uint4* buffer, int tile, int n) {
  const uint4* const words = buffer + ((b.x0() + tile) * NT + n) * PAIRS * 32 + b.lane();
  return settled((uint2*)(words + b.cluster() / 2 * 32) + (b.cluster() & 1));
}

// Registers of sends, which are read when their turn comes: whatever else is written there waits some 500 cycles. So
// nothing is until the next product's weights have been read.
struct Sent {
  uint4 units, places;
  __device__ __forceinline__ void until_here() const { keep_until_here(units), keep_until_here(places); }
};
