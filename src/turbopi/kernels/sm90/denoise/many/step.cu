// Many tokens, between steps: each cluster sees to its own.

constexpr u32 V_EXPECT = S * (V_PARTS * A + 1) * OWN_T * 4;

// Threads per action number; those that keep x_t (the others help to add up), tokens that each of them keeps.
constexpr int GROUPS = CONSUMERS / A, OWNERS = imin(GROUPS, OWN_T), HELD = most(OWN_T, OWNERS);

// Thread (action number, token group) keeps x_t of the CTA's own tokens group, group + OWNERS..
struct Actions {
  float kept[HELD];

  static __device__ __forceinline__ int number(const Cta& b) { return b.thread % A; }
  static __device__ __forceinline__ int group(const Cta& b) { return b.thread / A; }
  static __device__ __forceinline__ int index(const Cta& b, int i) {  // among the OWN_T
    return group(b) % OWNERS + i * OWNERS;
  }
  static __device__ __forceinline__ int token(const Cta& b, int i) {
    return (b.cluster() + index(b, i) / 8 * NC) * 8 + index(b, i) % 8;
  }
  static __device__ __forceinline__ bool exists(const Cta& b, int i) {
    return group(b) < OWNERS && index(b, i) < OWN_T && token(b, i) < T;
  }
  static __device__ __forceinline__ int place(const Cta& b, int i) { return token(b, i) * A + number(b); }

  __device__ __forceinline__ explicit Actions(const Cta& b) {
#pragma unroll
    for (int i = 0; i < HELD; ++i) {
      const bool real = exists(b, i);
      kept[i] = real ? b.a.noise[place(b, i)] : 0;
      if (real && b.rank() == 0) b.a.x_t[place(b, i)] = kept[i];
    }
  }
};

// x_t to the stream: action_in_proj, this rank's slice.
__device__ __forceinline__ void embed_own(Cta& b, const Actions& actions, float4 (&x)[ITEMS_X], const float* scale) {
  float* const xt = (float*)(b.smem + M_X + X_OWN_XT);
#pragma unroll
  for (int i = 0; i < HELD; ++i)  // of tokens that don't exist zeros
    if (Actions::group(b) < OWNERS && Actions::index(b, i) < OWN_T)
      xt[Actions::index(b, i) * A + Actions::number(b)] = actions.kept[i];
  consumers_sync();
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    x[j] = make_float4(0, 0, 0, 0);
    const int col = (b.x0() + item.tile) * 16 + 2 * b.g();
    if (item.real) {
      const float* w = b.a.in_w + size_t(col) * A;
      const float* x0 = xt + (item.n / NC * 8 + 2 * b.t()) * A;
      float4 c = make_float4(b.a.in_b[col], b.a.in_b[col], b.a.in_b[col + 1], b.a.in_b[col + 1]);
#pragma unroll 4
      for (int k = 0; k < A; k += 4)
        add_actions(c, __ldg((const float4*)(w + k)), __ldg((const float4*)(w + A + k)), *(const float4*)(x0 + k),
                    *(const float4*)(x0 + A + k));
      x[j] = c;
    }
    __syncwarp();
  }
  Factors scales[ITEMS_X];
  load_columns(b, scales, scale);
  done_with_x(b);
  publish_stream(b, x, scales);
}

// Final norm, action_out_proj and the Euler step; as many threads as there are share the columns.
__device__ __forceinline__ void advance_own(Cta& b, Actions& actions, const float4 (&x)[ITEMS_X], const float* scale,
                                            int step) {
  float* const xs = (float*)(b.smem + M_X + X_OWN_XS);
  const KeptRow later(b, step + 1);
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    const float4 y = scaled(x[j], factors(scale, (b.x0() + item.tile) * 16 + 2 * b.g(), rows_of(b, item.token)));
    float* p = xs + (item.tile * 16 + 2 * b.g()) * OWN_T + item.n / NC * 8 + 2 * b.t();
    if (item.real) p[0] = y.x, p[OWN_T] = y.z;
    if (item.real && item.token + 1 < T) p[1] = y.y, p[OWN_T + 1] = y.w;
    keep_squares(b, x[j], j, item.real);
  }
  consumers_sync();
  auto to_all = [&](u32 at, float v) {
#pragma unroll
    for (int d = 0; d < S; ++d) send(at_rank(b.base + at, d), __float_as_uint(v), at_rank(b.bar(BAR_V), d));
  };
  float sum[HELD];
#pragma unroll
  for (int i = 0; i < HELD; ++i) sum[i] = 0;
  const int part = Actions::group(b) / OWNERS;
  const u32 mine = (b.rank() * V_PARTS + part) * OWN_T * A + (Actions::index(b, 0) * A + Actions::number(b));
  if (part < V_PARTS) {
    const float* w = b.a.out_w + size_t(b.x0()) * 16 * A + Actions::number(b);
    const int end = share(b.xn() * 16, V_PARTS, part + 1);
#pragma unroll(HELD == 1 ? 32 : 8)
    for (int c = share(b.xn() * 16, V_PARTS, part); c < end; ++c) {
      const float v = __ldg(w + c * A);
#pragma unroll
      for (int i = 0; i < HELD; ++i) sum[i] += v * xs[c * OWN_T + min(Actions::index(b, i), OWN_T - 1)];
    }
#pragma unroll
    for (int i = 0; i < HELD; ++i)
      if (Actions::index(b, i) < OWN_T) to_all(M_X + X_OWN_V + (mine + i * OWNERS * A) * 4, sum[i]);
  }
  if (b.thread < OWN_T) to_all(M_SSQ + (b.rank() * OWN_T + b.thread) * 4, slice_squares(b, b.thread));
  receive(b, BAR_V, step, V_EXPECT, WAIT_V);
  const float* const parts = (const float*)(b.smem + M_X + X_OWN_V);
  const float* const squares = (const float*)(b.smem + M_SSQ);
  float shift[HELD];
#pragma unroll
  for (int i = 0; i < HELD; ++i) shift[i] = __ldg(action_shifts(b, step, Actions::token(b, i)) + Actions::number(b));
#pragma unroll
  for (int i = 0; i < HELD; ++i)
    if (Actions::exists(b, i)) {
      const int own = Actions::index(b, i), at = Actions::place(b, i);
      float v = 0, q = 0;
#pragma unroll
      for (int s = 0; s < S * V_PARTS; ++s) v += parts[(s * OWN_T + own) * A + Actions::number(b)];
#pragma unroll
      for (int s = 0; s < S; ++s) q += squares[s * OWN_T + own];
      v = v * rms_from(b, q) + shift[i];
      actions.kept[i] = EulerStep(b, step, Actions::token(b, i), Actions::number(b))(b, actions.kept[i], v);
      if (b.rank() == 0) put_out(b, step, at, v, actions.kept[i]);
    }
  later.keep(b);
  MARK(MARK_STEP_DONE)
}
