// Part 11 of 11: between steps, the loop, the kernel.

// Threads per action number; those that keep x_t (if SPREAD the others help to add up), tokens that each of them keeps.
constexpr int GROUPS = CONSUMERS / A, OWNERS = SPREAD ? imin(GROUPS, OWN_T) : GROUPS, HELD = most(OWN_T, OWNERS);

// Thread (action number, token group) looks after x_t[group + i * OWNERS][number], or if SPREAD that of the CTA's own
// tokens. It keeps them in shared memory if tokens are few, as registers are dear in the loop.
struct Actions {
  float kept[SPREAD ? HELD : 1];

  static __device__ __forceinline__ int number(const Block& b) { return b.thread % A; }
  static __device__ __forceinline__ int group(const Block& b) { return b.thread / A; }
  static __device__ __forceinline__ int index(const Block& b, int i) {  // among the OWN_T
    return (SPREAD ? group(b) % OWNERS : group(b)) + i * OWNERS;
  }
  static __device__ __forceinline__ int token(const Block& b, int i) {
    return SPREAD ? (b.cluster() + index(b, i) / 8 * NC) * 8 + index(b, i) % 8 : index(b, i);
  }
  static __device__ __forceinline__ bool exists(const Block& b, int i) {
    return group(b) < OWNERS && index(b, i) < OWN_T && token(b, i) < T;
  }
  static __device__ __forceinline__ int place(const Block& b, int i) { return token(b, i) * A + number(b); }
  static __device__ __forceinline__ bool writes(const Block& b) { return SPREAD ? b.rank() == 0 : b.cta == 0; }
  __device__ __forceinline__ float get(const Block& b, int i) const {
    return SPREAD ? kept[SPREAD ? i : 0] : ((const float*)(b.smem + M_XT))[place(b, i)];
  }
  __device__ __forceinline__ void set(const Block& b, int i, float x) {
    if (SPREAD)
      kept[SPREAD ? i : 0] = x;
    else
      ((float*)(b.smem + M_XT))[place(b, i)] = x;
  }
};

// x_t to the stream: action_in_proj, this rank's slice.
__device__ __forceinline__ void embed(Block& b, const Actions& actions, float4 (&x)[ITEMS_X], const float* scale) {
  float* xt = (float*)(b.smem + (SPREAD ? M_X + X_OWN_XT : M_XT));
  if (SPREAD)
#pragma unroll
    for (int i = 0; i < HELD; ++i)  // of tokens that don't exist zeros
      if (Actions::group(b) < OWNERS && Actions::index(b, i) < OWN_T)
        xt[Actions::index(b, i) * A + Actions::number(b)] = actions.get(b, i);
  consumers_sync();
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    x[j] = make_float4(0, 0, 0, 0);
    const int col = (b.x0() + item.tile) * 16 + 2 * b.g();
    if (item.real) {
      const float* w = b.a.in_w + size_t(col) * A;
      const float* x0 = xt + (SPREAD ? item.n / NC * 8 + 2 * b.t() : item.token) * A;
      const float* x1 = SPREAD ? x0 + A : xt + min(item.token + 1, T - 1) * A;
      float4 c = make_float4(b.a.in_b[col], b.a.in_b[col], b.a.in_b[col + 1], b.a.in_b[col + 1]);
#pragma unroll(FEW ? 8 : 4)
      for (int k = 0; k < A; k += 4) {
        const float4 w0 = __ldg((const float4*)(w + k)), w1 = __ldg((const float4*)(w + A + k));
        const float4 y0 = *(const float4*)(x0 + k), y1 = *(const float4*)(x1 + k);
        c.x += w0.x * y0.x + w0.y * y0.y + w0.z * y0.z + w0.w * y0.w,
            c.y += w0.x * y1.x + w0.y * y1.y + w0.z * y1.z + w0.w * y1.w;
        c.z += w1.x * y0.x + w1.y * y0.y + w1.z * y0.z + w1.w * y0.w,
            c.w += w1.x * y1.x + w1.y * y1.y + w1.z * y1.z + w1.w * y1.w;
      }
      x[j] = c;
    }
    __syncwarp();
    if (!SPREAD && b.attends()) {
      const float2 s = __ldg((const float2*)(scale + col));
      send_columns(b, Everyone(columns_place(b, M_X, b.x0() + item.tile, item.n)), Everyone(b.bar(BAR_X)), item.n,
                   make_float4(x[j].x * s.x, x[j].y * s.x, x[j].z * s.y, x[j].w * s.y), item.real);
    }
  }
  if constexpr (SPREAD) {
    float2 scales[ITEMS_X];
    load_columns(b, scales, scale);
    if (b.attends()) done_with_x(b);
    publish_stream(b, x, scales);
  } else if (b.attends()) {
    send_squares(b, x, BAR_X);
  }
}

constexpr u32 V_EXPECT = SPREAD ? S * (V_PARTS * A + 1) * OWN_T * 4 : S * T * A * 4 + SQUARES_EXPECT;

// Final norm, action_out_proj and the Euler step. Each rank's slice gives partial sums of v_t, which go to all ranks.
// Region X is free for them: every rank's hidden units have come, so no gate|up sums are still being read there. If
// SPREAD each cluster does so for its own tokens, and more threads than there are sums share the columns.
__device__ __forceinline__ void advance(Block& b, Actions& actions, const float4 (&x)[ITEMS_X], const float* scale,
                                        int step) {
  float* xs = (float*)(b.smem + M_X + (SPREAD ? X_OWN_XS : X_XS));
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    const float2 s = __ldg((const float2*)(scale + (b.x0() + item.tile) * 16 + 2 * b.g()));
    float* p = xs + (item.tile * 16 + 2 * b.g()) * OWN_T + (SPREAD ? item.n / NC * 8 + 2 * b.t() : item.token);
    if (item.real) p[0] = x[j].x * s.x, p[OWN_T] = x[j].z * s.y;
    if (item.real && item.token + 1 < T) p[1] = x[j].y * s.x, p[OWN_T + 1] = x[j].w * s.y;
    if constexpr (SPREAD) keep_squares(b, x[j], j, item.real);
  }
  if constexpr (!SPREAD) send_squares(b, x, BAR_V);
  consumers_sync();
  auto to_all = [&](u32 at, float v) {
#pragma unroll
    for (int d = 0; d < S; ++d) send(at_rank(b.base + at, d), __float_as_uint(v), at_rank(b.bar(BAR_V), d));
  };
  float sum[HELD];
#pragma unroll
  for (int i = 0; i < HELD; ++i) sum[i] = 0;
  const int part = SPREAD ? Actions::group(b) / OWNERS : 0;
  const bool active = SPREAD ? part < V_PARTS : Actions::exists(b, 0);
  const u32 mine = (b.rank() * V_PARTS + part) * OWN_T * A + (Actions::index(b, 0) * A + Actions::number(b));
  if (active) {
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
      if (SPREAD ? Actions::index(b, i) < OWN_T : Actions::exists(b, i))
        to_all(M_X + (SPREAD ? X_OWN_V : X_VPART) + (mine + i * OWNERS * A) * 4, sum[i]);
  }
  if constexpr (SPREAD)
    if (b.thread < OWN_T) to_all(M_SSQ + (b.rank() * OWN_T + b.thread) * 4, slice_squares(b, b.thread));
  receive(b, BAR_V, step, V_EXPECT, WAIT_V);
  if (active) {
    const float* parts = (const float*)(b.smem + M_X + (SPREAD ? X_OWN_V : X_VPART));
    const float* squares = (const float*)(b.smem + M_SSQ);
    const float shift = __ldg(b.a.out_shift + step * A + Actions::number(b));
#pragma unroll
    for (int i = 0; i < HELD; ++i) {
      const int own = Actions::index(b, i), at = own * A + Actions::number(b), place = Actions::place(b, i);
      if (Actions::exists(b, i)) {
        float v = 0, q = 0;
#pragma unroll
        for (int s = 0; s < S * V_PARTS; ++s) v += parts[s * OWN_T * A + at];
#pragma unroll
        for (int s = 0; s < SQ; ++s) q += squares[s * (SPREAD ? OWN_T : NT * 8) + own];
        v = v * rsqrtf(q * (1.0f / D) + b.a.eps) + shift;
        const float next = __fadd_rn(actions.get(b, i), __fmul_rn(b.a.dt, v));
        actions.set(b, i, next);
        if (Actions::writes(b)) {
          b.a.v_t[size_t(step) * T * A + place] = v;
          b.a.x_t[size_t(step + 1) * T * A + place] = next;
        }
      }
    }
  }
  if (!SPREAD && step + 1 < b.a.steps) {  // a peer's next slice lands where this rank has read the partial sums
    consumers_sync();
    if (b.thread < S) arrive_at(at_rank(b.bar(BAR_GO), b.thread));
    note(b, WAIT_GO);
    barrier_wait(b.bar(BAR_GO), step & 1);
  }
}

__device__ __forceinline__ u32 hidden_bytes(const Block& b) { return b.hn() * 16 * T * 2 + (IDLE ? S * 4 : 0); }

__device__ __forceinline__ void consume(Block& b) {
  const Args& a = b.a;
  const int prefix = int(*a.length);
  Actions actions;
#pragma unroll
  for (int i = 0; i < HELD; ++i)
    if (Actions::exists(b, i)) {
      const float noise = a.noise[Actions::place(b, i)];
      actions.set(b, i, noise);
      if (Actions::writes(b)) a.x_t[Actions::place(b, i)] = noise;
    } else if (SPREAD) {
      actions.set(b, i, 0);
    }
  float2 rope[ITEMS_Q][2];
  make_rope(b, prefix, rope);
  float4 x[ITEMS_X];
  const u32 expect_hidden = hidden_bytes(b);
#ifdef TP_TRACE
  if (threadIdx.x < 32) ((u32*)(b.smem + M_BAR + 256))[threadIdx.x] = threadIdx.x ? 0 : u32(clock64());
  consumers_sync();
#endif
#pragma unroll 1
  for (int step = 0; step < a.steps; ++step) {
    embed(b, actions, x, a.table + size_t(step) * (2 * L + 1) * 3 * D);
    MARK(19)
#pragma unroll 1
    for (; b.n < u32(step + 1) * L; ++b.n) {
      const bool last = b.n + 1 == u32(step + 1) * L;
#pragma unroll 1
      for (int half = 0; half < 2; ++half) {  // attention, feed-forward; what they share is one piece of code
        b.forget();
        const u32 bit = flag(b.n);
        auto of_tiles = [&](const float* all, u32 layer) {  // a CTA's rows of all tiles
          return all + (settled(layer) * (NC * S) + b.cta) * (TILES * 16);
        };
        float2 gates[ITEMS_X], scales[ITEMS_X];
        auto load_norm = [&] {
          const float* const table = a.table + (2 * settled(b.n) + step) * (3 * D);
          load_columns(b, gates, table + (half ? 5 : 2) * D);
          load_columns(b, scales, table + (half ? 6 : 3) * D);  // of the next norm, the final one behind the last layer
        };
        if (half || b.attends()) {
          if (half) {
            gate_up(b, of_tiles(a.shifted, b.n), of_tiles(a.row_scales, b.n - step * L));
            MARK(16)
            load_norm();
          } else {
            float* const kv = (float*)(a.scratch + B_KV + (b.n & 1) * N_KV);
            project(b, of_tiles(a.shifted, b.n), of_tiles(a.row_scales, b.n - step * L), kv, bit, rope);
            MARK(2)
            attend(b, kv, bit, prefix);
          }
        }
        uint4* const buffer = a.scratch + (half ? B_X1 : B_X2) + (settled(b.n) & 1) * N_STREAM;
        auto await = [&] {
          if (half) {
            receive(b, BAR_HID, b.n, expect_hidden, WAIT_HID);
            MARK(17)
          } else {
            receive(b, BAR_ATT, b.n, ATT_EXPECT, WAIT_ATT);
            MARK(10)
          }
        };
        auto then = [&] {
          if (!half) load_norm();
        };
        if (half || b.attends())
          residual_product(b, b.base + (half ? M_HID : M_ATT), half ? b.hn() : QT,
                           SPREAD ? M_X + (half ? X_FF_SUMS : 0) : M_H, buffer, bit, await, then);
        else
          load_norm();
        if constexpr (SPREAD)  // behind the last layer `embed` says it
          if (!half || (b.attends() && !last)) done_with_x(b);
        MARK(half ? 18 : 11)
        note(b, half ? WAIT_X1 : WAIT_X2);
        gather(b, x, buffer, half ? NC : NH, bit, gates, scales,
               !half || (!last && (SPREAD || b.attends())), half);
        MARK(half ? 14 : 12)
      }
    }
    advance(b, actions, x, a.table + (size_t(step + 1) * (2 * L + 1) - 1) * 3 * D, step);
    MARK(20)
  }
  note(b, FINISHED);
#ifdef TP_TRACE
  consumers_sync();
  if (threadIdx.x < 32) a.trace[blockIdx.x * 64 + threadIdx.x] = ((u32*)(b.smem + M_BAR + 256))[threadIdx.x];
#endif
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) __cluster_dims__(S, 1, 1)
    turbopi_denoise(const __grid_constant__ Args args) {
  extern __shared__ __align__(128) byte smem[];
  Block b(args, smem);
  if (threadIdx.x == 0) {
    note(b, WAIT_NONE);
    for (u32 i = 0; i < STAGES; ++i) barrier_init(b.full(i), 1), barrier_init(b.empty(i), W);
    for (int i = BAR_X; i <= BAR_V; ++i) barrier_init(b.bar(i), 1);
    barrier_init(b.bar(BAR_GO), S), barrier_init(b.bar(BAR_RMS), 1);
    if constexpr (SPREAD) {
      barrier_init(b.bar(BAR_DONE), W), barrier_init(b.bar(BAR_FREE), S);
      barrier_init(b.bar(BAR_ROOM), S);
    }
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    barrier_expect(b.bar(BAR_X), X_EXPECT);
    barrier_expect(b.bar(BAR_Q), Q_EXPECT);
    barrier_expect(b.bar(BAR_TOPS), TOPS_EXPECT);
    barrier_expect(b.bar(BAR_COMB), outputs_expect(b));
    barrier_expect(b.bar(BAR_ATT), ATT_EXPECT);
    barrier_expect(b.bar(BAR_HID), hidden_bytes(b));
    barrier_expect(b.bar(BAR_V), V_EXPECT);
  }
  __syncthreads();
  cluster_exchange();
  if (b.warp() < W) {  // 4 x 112 + 32 registers on each quarter of the multiprocessor are what 5 x 96 were at launch
    asm volatile("setmaxnreg.inc.sync.aligned.u32 112;");
    consume(b);
  } else {
    asm volatile("setmaxnreg.dec.sync.aligned.u32 32;");
    if (b.warp() == W) {
      if (b.lane() == 0) {
        Producer producer(b);
        producer.run();
      }
    } else if (b.warp() == W + 1) {
      watch(b);
    } else if (b.warp() == W + 2) {
      make_inverse_rms(b);
    } else if (SPREAD) {
      fetch_stream(b);
    }
  }
  __syncwarp();
  cluster_exchange();  // nobody leaves while a peer may still write to it
}
