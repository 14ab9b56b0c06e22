// Many tokens: who keeps which part of the residual stream, and how the parts come together.
//
// If tokens are few, every cluster keeps the whole stream. With more tokens the bytes of that cost more than another hop
// through L2. Then CTA (cluster, rank) keeps its rank's slice of tokens 8 cluster.. (and 8 (cluster + NC)..) alone, adds
// up for those, and puts what the next products take into L2. Of each cluster rank r asks for slice r until all of it is
// there, then a spare warp fetches it, and the copy engine writes it to all ranks at once.

__device__ __forceinline__ Item stream_item(const Cta& b, int j) {
  const u32 i = b.warp() + j * W, xn = b.xn();  // unsigned: divisions become shifts
  const int tile = i % DX, n = b.cluster() + i / DX * NC;
  const bool real = i < DX * OWN_N && u32(tile) < xn && n < NT;
  return {real ? tile : 0, real ? n : 0, (real ? n : 0) * 8 + 2 * b.t(), real, real && n * 8 + 2 * b.t() < T};
}

// Region X is used for everything, one thing after the other. Before any rank may write where all ranks read, all
// agree: before the stream comes, spare warps do (DONE, FREE); before queries and hidden units come, which lie over the
// stream, the consumers do (ROOM).

// This warp has read what it needs of region X, up to the next exchange of the stream.
__device__ __forceinline__ void done_with_x(const Cta& b) {
  show_to_products();  // the copy engine comes behind our reads and writes
  __syncwarp();
  if (b.lane() == 0) barrier_arrive(b.bar(BAR_DONE));
}
// All warps here have multiplied the stream; all ranks have.
__device__ __forceinline__ void give_room(const Cta& b) {
  if (b.thread < S) arrive_at(at_rank(b.bar(BAR_ROOM), b.thread));
}
__device__ __forceinline__ void await_room(const Cta& b) {
  barrier_wait(b.bar(BAR_ROOM), b.room & 1);
  __syncwarp();
}

// An item's sums of squares to float[8 tokens at a time][DX][8].
__device__ __forceinline__ void keep_squares(const Cta& b, float4 x, int j, bool real) {
  const float2 q = squares_of(x);
  if (const int i = b.warp() + j * W; i < DX * OWN_N && b.g() == 0)
    *(float2*)(b.smem + M_PART + (i * 8 + 2 * b.t()) * 4) = real ? make_float2(q.x, q.y) : make_float2(0, 0);
}
// Those of the slice of one of this CTA's tokens.
__device__ __forceinline__ float slice_squares(const Cta& b, int token) {
  float sum = 0;
#pragma unroll
  for (int tile = 0; tile < DX; ++tile)
    sum += *(const float*)(b.smem + M_PART + ((token / 8 * DX + tile) * 8 + token % 8) * 4);
  return sum;
}
// What this CTA keeps of the stream, times the next norm's scale, to L2 as products take it; behind it the slice's sums
// of squares, with flags in their lowest bits. A flag for the stream would need a fence before it, of 1,100 to 1,800
// cycles: instead its words themselves say whether they are there. Those of the turn before are ABSENT again, as all
// clusters have read them: what was published now follows sums that they made of them.
__device__ __forceinline__ void publish_stream(Cta& b, const float4 (&x)[ITEMS_X], const Factors (&scales)[ITEMS_X]) {
  auto stage = [&](u32 turn) { return (byte*)(b.a.scratch + B_STAGE + turn % STAGED * N_STAGE); };
  byte *const to = stage(b.turn), *const last = stage(b.turn + STAGED - 1);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    const int place = (b.x0() + item.tile) * NT + item.n, token = 2 * b.t() + (b.g() & 1);
    const uint2 columns = columns_of(b, scaled(x[j], scales[j]));
    const int at = FP8 ? place * OPERAND + token * 16 + (b.g() >> 1) * 4
                       : place * OPERAND + (b.g() >> 2) * 128 + token * 16 + (b.g() >> 1 & 1) * 8;
    if (item.real && item.n * 8 + token < T) {
      if (FP8)
        put(to + at, columns.x), put(last + at, ABSENT);
      else
        put(to + at, columns), put(last + at, make_uint2(ABSENT, ABSENT));
    }
  }
  constexpr int KEEPERS = imin(DX * OWN_N, W);
  if (b.warp() < KEEPERS) {
#pragma unroll
    for (int j = 0; j < ITEMS_X; ++j) keep_squares(b, x[j], j, stream_item(b, j).real);
    __syncwarp();
    asm volatile("bar.sync %0, %1;" ::"n"(SQUARES_KEPT), "n"(KEEPERS * 32) : "memory");
    if (b.thread < OWN_T)
      if (const int n = b.cluster() + int(b.thread) / 8 * NC; n < NT)
        publish((float*)(b.a.scratch + B_SQUARES + (b.turn & 1) * N_SQUARES) + (b.rank() * NT + n) * 8 + b.thread % 8,
                slice_squares(b, b.thread), flag(b.turn));
  }
  ++b.turn;
}

// The warps that multiply: until the slice of the stream that was published last is in L2, all of it. One question at a
// time: more of them slow down what they ask for.
__device__ __forceinline__ void await_slice(const Cta& b) {
  constexpr int WORDS = OPERAND / 16, MOST = most(DX * NT * WORDS, CONSUMERS);
  const uint4* const from = b.a.scratch + B_STAGE + (b.turn - 1) % STAGED * N_STAGE + b.x0() * NT * WORDS;
  const uint4* words[MOST];  // in the place of those that are never written the first one
  uint4 v[MOST];
#pragma unroll
  for (int k = 0; k < MOST; ++k) {
    const int i = b.thread + k * CONSUMERS;
    words[k] = from + (i < b.xn() * NT * WORDS && word_exists(i) ? i : 0);
    v[k] = peek(words[k]);
  }
#pragma unroll 1
  for (bool again = true; again;) {
    again = false;
#pragma unroll
    for (int k = 0; k < MOST; ++k)
      if (max(max(v[k].x, v[k].y), max(v[k].z, v[k].w)) == ABSENT) v[k] = peek(words[k]), again = true;
    again = __any_sync(~0u, again);
  }
  if (b.lane() == 0) barrier_arrive(b.bar(BAR_HERE));
}
// All lanes of a spare warp: the slice's sums of squares, use `turn`, to all ranks when they are there. Answers take
// long, so three questions are on their way at any time.
__device__ __forceinline__ void pass_on_squares(const Cta& b, u32 turn) {
  const int mine = imin(b.lane(), NT * 4 - 1);
  const uint2* const from =
      (const uint2*)(b.a.scratch + B_SQUARES + (turn & 1) * N_SQUARES) + b.rank() * NT * 4 + mine;
  uint2 q[3];
#pragma unroll
  for (int i = 0; i < 3; ++i) {
    q[i] = peek(from);
    if (i < 2) pause(u32(clock64()), 150);
  }
  uint2 seen;
#pragma unroll 1
  for (bool here = false; !here;)
#pragma unroll
    for (int i = 0; i < 3; ++i)
      if (!here) {
        here = __all_sync(~0u, !missing(q[i], flag(turn))), seen = q[i];
        if (!here) q[i] = peek(from);
      }
  if (b.lane() < NT * 4)
#pragma unroll
    for (int d = 0; d < S; ++d)
      send(at_rank(b.base + M_SSQ + (b.rank() * NT * 4 + mine) * 8, d), seen.x, seen.y, at_rank(b.bar(BAR_SQUARES), d));
  __syncwarp();
}
// A spare warp. The copy engine reads L2, as those did who have seen that the slice is there, and only then. Sums of
// squares have a barrier of their own, as they come later and are needed later.
__device__ __forceinline__ void fetch_stream(const Cta& b) {
  const u32 place = b.x0() * NT, items = b.xn() * NT;
  u32 uses = 0, turn = 0;
#pragma unroll 1
  for (int step = 0; step < b.a.steps; ++step)
#pragma unroll 1
    for (int i = 0; i < 2 * L; ++i, ++turn) {  // embedded, then behind attention, behind the feed-forward, ...
      barrier_wait(b.bar(BAR_DONE), uses & 1);
      __syncwarp();
      if (b.lane() < S) arrive_at(at_rank(b.bar(BAR_FREE), b.lane()));
      barrier_wait(b.bar(BAR_FREE), uses & 1);
      __syncwarp();
      barrier_wait(b.bar(BAR_HERE), uses++ & 1);
      show_to_copy_engine();
      __syncwarp();
      if (b.lane() == 0 && items > 0)
        load_for_all(b.base + M_X + place * OPERAND,
                     b.a.scratch + B_STAGE + turn % STAGED * N_STAGE + place * (OPERAND / 16), items * OPERAND,
                     b.bar(BAR_X));
      pass_on_squares(b, turn);
      // A release whose word nobody reads: what is ABSENT now is so in L2 before this warp fetches again, and so before
      // this CTA publishes again, three turns before anybody asks for it.
      if (b.lane() == 0)
        asm volatile("st.release.gpu.global.u32 [%0], %1;" ::"l"(b.a.scratch + B_ORDER + b.cta), "r"(turn) : "memory");
      if (i == 2 * L - 1) {  // what the end of the step needs, to L2
#pragma unroll 1
        for (int at = b.lane() * 32; at < b.xn() * 16 * A; at += 32 * 32) {
          prefetch_line(b.a.out_w + size_t(b.x0()) * 16 * A + at);
          prefetch_line(b.a.in_w + size_t(b.x0()) * 16 * A + at);
        }
      }
    }
}

constexpr u32 SQUARES_EXPECT = S * NT * 32;
// A spare warp: until sums of squares of the stream's use `use` are here.
__device__ __forceinline__ void await_squares(const Cta& b, int use) {
  barrier_wait(b.bar(BAR_SQUARES), use & 1);
  if (b.lane() == 0) barrier_expect(b.bar(BAR_SQUARES), SQUARES_EXPECT);
}

constexpr u32 X_EXPECT = D16 * NT * 8 * (OPERAND / 8);
// The stream that comes before attention, or (half 1) the feed-forward.
__device__ __forceinline__ void receive_stream(const Cta& b, int half) {
  note(b, WAIT_X), await_slice(b);
  receive(b, BAR_X, half, X_EXPECT, WAIT_X);
}

// Partial sums of an item of the stream from all clusters: asks until what they send is there (of `real` tokens: others
// never come) and adds it up, without what comes before `from`. A cluster's lie together, for sectors of L2 that are half
// written cost as much as whole ones.
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

constexpr u32 PATIENCE = FP8 ? 300 : 400;  // clock cycles before sums are asked for: polls slow down what they wait for
// Fetch the clusters' partial sums of a product, add them times the gate to the stream and, if `send_on`, publish the
// slice times the next norm's scale. buffer: [D16][NT][NC][32] 8-byte words.
__device__ __forceinline__ void gather(Cta& b, float4 (&x)[ITEMS_X], const uint4* buffer, u32 bit,
                                       const Factors (&gates)[ITEMS_X], const Factors (&scales)[ITEMS_X], bool send_on,
                                       int half) {
  const u32 since = u32(clock64());
  const uint2* words[ITEMS_X];  // addresses are made while there is nothing else to do
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    words[j] = settled((const uint2*)(buffer + ((b.x0() + item.tile) * NT + item.n) * PAIRS * 32) + b.lane());
  }
  pause(since, PATIENCE);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    if (item.mine) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll 1
      for (int from = 0; from < NC; from += FETCH_SINGLY) take_singly(sum, words[j], from, bit, item.real);
      add_gated(x[j], sum, gates[j], item.real);
    }
    __syncwarp();
    if (j == 0) {
      MARK(half ? MARK_DOWN_SUMS_HERE : MARK_OUT_SUMS_HERE)
    }
  }
  if (send_on) publish_stream(b, x, scales);
}

// Where a cluster's partial sums of (tile, 8 tokens n) of the slice go, for `gather`.
__device__ __forceinline__ uint2* sums_place(const Cta& b, uint4* buffer, int tile, int n) {
  const uint4* const words = buffer + ((b.x0() + tile) * NT + n) * PAIRS * 32;
  return (uint2*)words + b.cluster() * 32 + b.lane();
}

struct Sent {  // of few tokens
  __device__ __forceinline__ void until_here() const {}
};
