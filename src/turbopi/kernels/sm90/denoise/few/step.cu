// Few tokens, between steps: x_t lies in shared memory, token w is warp w's.

constexpr u32 V_EXPECT = S * T * A * 4 + SQUARES_EXPECT;

// action_in_proj of a warp's items. What it needs besides x_t is asked for before x_t is there.
struct Embedding {
  static constexpr bool EARLY = ITEMS_X == 1 && A <= 32;
  float4 weights[EARLY ? A / 4 : 1][2];
  float2 bias[ITEMS_X];
  Factors scale[ITEMS_X];

  static __device__ __forceinline__ int column(const Cta& b, int j) {
    return (b.x0() + stream_item(b, j).tile) * 16 + 2 * b.g();
  }
  static __device__ __forceinline__ float4 weight(const Cta& b, int column, int k, int odd) {
    return __ldg((const float4*)(b.a.in_w + size_t(column + odd) * A) + k);
  }
  __device__ __forceinline__ Embedding(const Cta& b, const float* scales, int step) {
#pragma unroll
    for (int j = 0; j < ITEMS_X; ++j) {
      bias[j] = __ldg((const float2*)(b.a.in_b + column(b, j)));
      scale[j] = factors(scales, column(b, j), asked_rows(b, step, stream_item(b, j).token));
    }
    if (EARLY)
#pragma unroll
      for (int i = 0; i < A / 2; ++i) weights[i / 2][i % 2] = weight(b, column(b, 0), i / 2, i % 2);
  }
  __device__ __forceinline__ void multiply(const Cta& b, float4 (&x)[ITEMS_X]) const {
#pragma unroll
    for (int j = 0; j < ITEMS_X; ++j) {
      const Item item = stream_item(b, j);
      const float4* const x0 = (const float4*)(b.smem + M_XT) + min(item.token, T - 1) * (A / 4);
      const float4* const x1 = (const float4*)(b.smem + M_XT) + min(item.token + 1, T - 1) * (A / 4);
      float4 c = make_float4(bias[j].x, bias[j].x, bias[j].y, bias[j].y);
#pragma unroll(EARLY ? A / 4 : 4)
      for (int k = 0; k < A / 4; ++k) {
        const float4 w0 = EARLY ? weights[EARLY ? k : 0][0] : weight(b, column(b, j), k, 0),
                     w1 = EARLY ? weights[EARLY ? k : 0][1] : weight(b, column(b, j), k, 1);
        add_actions(c, w0, w1, x0[k], x1[k]);
      }
      x[j] = item.real ? c : make_float4(0, 0, 0, 0);
    }
  }
  __device__ __forceinline__ void send(const Cta& b, const float4 (&x)[ITEMS_X]) const {
    __syncwarp();
#pragma unroll
    for (int j = 0; j < ITEMS_X; ++j) {
      const Item item = stream_item(b, j);
      send_columns(b, Everyone(columns_place(b, M_X, b.x0() + item.tile, item.n)), Everyone(b.bar(BAR_X)), item.n,
                   scaled(x[j], scale[j]), item.real);
    }
    send_squares(b, x, BAR_X);
  }
};

// action_out_proj of what `gather` kept, behind the final norm's scale: this rank's partial sums of v_t to all ranks. A
// warp multiplies its items, then a warp has a token. Region X is free for the sums, see `kept_item`.
__device__ __forceinline__ void send_v(const Cta& b) {
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const int i = b.warp() + j * W, xn = b.xn();
    if (i >= xn * NT) continue;
    const float* const w = b.a.out_w + size_t((b.x0() + i % xn) * 16) * A;
    const float4* const y = (const float4*)kept_item(b, i);
    const bool more = i / xn + 1 < NT || TAIL > 2;  // than four tokens
#pragma unroll 1
    for (int first = 0; first < A; first += 32) {
      const int number = min(first + b.lane(), A - 1);
      float4 low = make_float4(0, 0, 0, 0), high = low;
#pragma unroll
      for (int c = 0; c < 16; ++c) {
        const float v = __ldg(w + c * A + number);
        const float4 y0 = y[c * 2];
        low.x += v * y0.x, low.y += v * y0.y, low.z += v * y0.z, low.w += v * y0.w;
        if (more) {
          const float4 y1 = y[c * 2 + 1];
          high.x += v * y1.x, high.y += v * y1.y, high.z += v * y1.z, high.w += v * y1.w;
        }
      }
      __syncwarp();
      float* const to = kept_item(b, i) + XS_PART / 4 + number;
      to[0] = low.x, to[A] = low.y, to[2 * A] = low.z, to[3 * A] = low.w;
      if (more) to[4 * A] = high.x, to[5 * A] = high.y, to[6 * A] = high.z, to[7 * A] = high.w;
    }
  }
  consumers_sync();
  const int token = b.warp();
  if (token < T) {
    static_assert(S % 4 == 0, "a lane serves every fourth rank");
    const float4* const parts = (const float4*)(kept_item(b, token / 8 * b.xn()) + XS_PART / 4 + token % 8 * A);
#pragma unroll 1
    for (int q = b.lane() % 8; q < A / 4; q += 8) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll
      for (int tile = 0; tile < DX; ++tile)
        if (D16 % S == 0 || tile < b.xn()) {
          const float4 v = parts[tile * (XS_ITEM / 16) + q];
          sum.x += v.x, sum.y += v.y, sum.z += v.z, sum.w += v.w;
        }
      const u32 to = b.base + M_X + X_VPART + ((b.rank() * T + token) * A + q * 4) * 4;
#pragma unroll
      for (int d = b.lane() / 8; d < S; d += 4) send(at_rank(to, d), sum, at_rank(b.bar(BAR_V), d));
    }
  }
}

// From the step's end to the next one's stream, whose norm has these scales: v_t, the Euler step, action_in_proj.
__device__ __forceinline__ void advance(Cta& b, float4 (&x)[ITEMS_X], const float* scales, int step) {
  const KeptRow later(b, step + 1);
  send_squares(b, x, BAR_V);
  __syncwarp();
  send_v(b);
  const int token = b.warp();
  const Embedding embedding(b, scales, imin(step + 1, b.a.steps - 1));
  const float* const shifts = action_shifts(b, step, token);
  const float shift = __ldg(shifts + min(b.lane(), A - 1));
  const EulerStep first(b, step, token, b.lane());
  receive(b, BAR_V, step, V_EXPECT, WAIT_V);
  if (token < T) {
    const float* const parts = (const float*)(b.smem + M_X + X_VPART) + token * A;
    float q = 0;
#pragma unroll
    for (int s = 0; s < most(SQ, 32); ++s)
      if (SQ % 32 == 0 || s * 32 + b.lane() < SQ)
        q += ((const float*)(b.smem + M_SSQ))[(s * 32 + b.lane()) * NT * 8 + token];
#pragma unroll
    for (int o = 1; o < 32; o *= 2) q += exchange(q, o);
    const float inverse = rms_from(b, q);
#pragma unroll 1
    for (int number = b.lane(); number < A; number += 32) {
      float v = 0;
#pragma unroll
      for (int s = 0; s < S; ++s) v += parts[s * T * A + number];
      v = v * inverse + (number < 32 ? shift : __ldg(shifts + number));
      const int at = token * A + number;
      float* const xt = (float*)(b.smem + M_XT) + at;
      const float next = (number < 32 ? first : EulerStep(b, step, token, number))(b, *xt, v);
      *xt = next;
      if (b.cta == 0) put_out(b, step, at, v, next);
    }
  }
  later.keep(b);
  MARK(MARK_STEP_DONE)
  if (step + 1 == b.a.steps) return;
  consumers_sync();
  if (b.thread < S) arrive_at(at_rank(b.bar(BAR_GO), b.thread));
  embedding.multiply(b, x);
  note(b, WAIT_GO);
  barrier_wait(b.bar(BAR_GO), step & 1);  // a peer's slice lands where this rank has read the partial sums
  embedding.send(b, x);
}
