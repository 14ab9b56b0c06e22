// Part 13 of 13: the loop, the kernel.

__device__ __forceinline__ u32 hidden_bytes(const Block& b) {
  if (COPY_HIDDEN) return HC * NT * OPERAND;
  return b.hn() * 16 * T * (OPERAND / 128) + (IDLE ? S * 4 : 0);
}

__device__ __forceinline__ void consume(Block& b) {
  const Args& a = b.a;
  const int prefix = int(*a.length);
  Actions actions(b);  // of many tokens
  if (!SPREAD)
    for (int i = b.thread; i < T * A; i += CONSUMERS) {
      ((float*)(b.smem + M_XT))[i] = a.noise[i];
      if (b.cta == 0) a.x_t[i] = a.noise[i];
    }
  float2 rope[ITEMS_Q][2];
  make_rope(b, prefix, rope);
  float4 x[ITEMS_X];
  const u32 expect_hidden = hidden_bytes(b);
#ifdef TP_TRACED_WARP
  if (threadIdx.x < 32) ((u32*)(b.smem + M_BAR + 256))[threadIdx.x] = threadIdx.x ? 0 : u32(clock64());
  consumers_sync();
#endif
  if constexpr (!SPREAD) {
    const Embedding first(b, a.table);
    consumers_sync();
    first.multiply(b, x), first.send(b, x);
  }
#pragma unroll 1
  for (int step = 0; step < a.steps; ++step) {
    const float* const table = a.table + size_t(step) * (2 * L + 1) * 3 * D;
    if constexpr (SPREAD) embed_own(b, actions, x, table);
    MARK(MARK_EMBEDDED)
#pragma unroll 1
    for (; b.n < u32(step + 1) * L; ++b.n) {
      const bool last = b.n + 1 == u32(step + 1) * L;
#pragma unroll 1
      for (int half = 0; half < 2; ++half) {  // attention, feed-forward
        b.forget();
        const u32 bit = flag(b.n);
        auto of_tiles = [&](const float* all, u32 layer) {  // a CTA's rows of all tiles
          return all + (settled(layer) * (NC * S) + b.cta) * (TILES * 16);
        };
        float2 gates[ITEMS_X], scales[ITEMS_X];
        Sent sent = {};
        auto load_norm = [&] {
          const float* const table = a.table + (2 * settled(b.n) + step) * (3 * D);
          load_columns(b, gates, table + (half ? 5 : 2) * D);
          load_columns(b, scales, table + (half ? 6 : 3) * D);  // of the next norm, the final one behind the last layer
        };
        if (half) {
          gate_up(b, of_tiles(a.shifted, b.n), of_tiles(a.row_scales, b.n - step * L), sent);
          MARK(MARK_HIDDEN_SENT)
          load_norm();
        } else {
          float* const kv = (float*)(a.scratch + B_KV + (b.n & 1) * N_KV);
          project(b, of_tiles(a.shifted, b.n), of_tiles(a.row_scales, b.n - step * L), kv, bit, rope);
          MARK(MARK_QKV_SENT)
          attend(b, kv, bit, prefix);
        }
        uint4* const buffer = a.scratch + (half ? B_X1 : B_X2) + (settled(b.n) & 1) * N_STREAM;
        auto await = [&] {
          if (half) {
            receive(b, BAR_HID, b.n, expect_hidden, WAIT_HID);
            MARK(MARK_HIDDEN_HERE)
          } else {
            receive(b, BAR_ATT, b.n, ATT_EXPECT, WAIT_ATT);
            MARK(MARK_ATTENTION_HERE)
          }
        };
        auto then = [&] {
          if (!half) load_norm();
        };
        constexpr int HIDDEN = F16 % NC == 0 ? HC : 1;
        if constexpr (SPREAD) {
          if (half)
            residual_product<HIDDEN>(b, M_HID, b.hn(), M_X + X_FF_SUMS, buffer, bit, await, then, sent);
          else
            residual_product<QT>(b, M_ATT, QT, M_X, buffer, bit, await, then, sent);
        } else {  // one piece of code for both
          constexpr int EVEN = HIDDEN % 16 == 0 && QT % 16 == 0 ? 16 : HIDDEN % 8 == 0 && QT % 8 == 0 ? 8 : 1;
          residual_product<EVEN>(b, half ? M_HID : M_ATT, half ? b.hn() : QT, M_H, buffer, bit, await, then, sent);
        }
        if constexpr (SPREAD)  // behind the last layer `embed_own` says it
          if (!half || !last) done_with_x(b);
        MARK(half ? MARK_DOWN_PUBLISHED : MARK_OUT_PUBLISHED)
        note(b, half ? WAIT_X1 : WAIT_X2);
        gather(b, x, buffer, bit, gates, scales, !half || !last, half, half && last);
        MARK(half ? MARK_SLICE_AFTER_FEED_FORWARD : MARK_SLICE_AFTER_ATTENTION)
      }
    }
    if constexpr (SPREAD)
      advance_own(b, actions, x, table + 2 * L * 3 * D, step);
    else
      advance(b, x, step + 1 < a.steps ? table + (2 * L + 1) * 3 * D : table, step);
  }
  note(b, FINISHED);
#ifdef TP_TRACED_WARP
  consumers_sync();
  if (threadIdx.x < 32) a.trace[blockIdx.x * 64 + threadIdx.x] = ((u32*)(b.smem + M_BAR + 256))[threadIdx.x];
#endif
}

// Tensor cores that have rested for most of a microsecond slow the clock down when they begin again (measured: 1.73
// GHz, at 50 tokens 1.76, where it is 1.80 if they never rest so long). A spare warp multiplies zeros now and then.
__device__ __forceinline__ void stay_awake(float (&c)[4], u32 zero) {
  mma_half(c, make_uint4(zero, zero, zero, zero), make_uint2(zero, zero));
  __nanosleep(100);
}
__device__ __forceinline__ void pretend_to_need(const Block& b, const float (&c)[4]) {
  if (c[0] != 0) *(volatile u32*)(b.smem + M_TOKEN) = 0;  // never, but the compiler can't know
}
__device__ __forceinline__ void keep_awake(const Block& b) {
  float c[4] = {0, 0, 0, 0};
  const u32 zero = b.a.zero;
#pragma unroll 1
  while (*(volatile u32*)(b.smem + M_PROGRESS) >> 20 != FINISHED) {
#pragma unroll
    for (int i = 0; i < 8; ++i) stay_awake(c, zero);  // to look seldom: who looks takes time from others
  }
  pretend_to_need(b, c);
}
// Of many tokens this warp watches, too: half a microsecond.
__device__ __forceinline__ void rest(const Block& b) {
  if (!SPREAD) return __nanosleep(500);
  float c[4] = {0, 0, 0, 0};
  const u32 zero = b.a.zero;
#pragma unroll 1
  for (int i = 0; i < 5; ++i) stay_awake(c, zero);
  pretend_to_need(b, c);
}
// What the norms of layer n need, to L2: it is read once, by everybody at the same time, while memory is busy with
// weights.
__device__ __forceinline__ void prefetch(const Block& b, int n) {
  const int step = n / L, l = n % L;
  if (step >= b.a.steps) return;
  auto lines = [&](const float* from, int floats) {
#pragma unroll 1
    for (int i = b.lane() * 32; i < floats; i += 32 * 32) prefetch_line(from + i);
  };
  const float* table = b.a.table + (size_t(step) * (2 * L + 1) + 2 * l) * 3 * D + b.x0() * 16;
  lines(b.a.shifted + (size_t(n) * (NC * S) + b.cluster() * S + b.rank()) * TILES * 16, TILES * 16);
  lines(table + 2 * D, b.xn() * 16), lines(table + 3 * D, b.xn() * 16);
  lines(table + 5 * D, b.xn() * 16), lines(table + 6 * D, b.xn() * 16);
}
__device__ __forceinline__ long long nanoseconds() {
  long long v;
  asm volatile("mov.u64 %0, %%globaltimer;" : "=l"(v));
  return v;
}
__device__ __forceinline__ void watch(const Block& b) {
  u32 last = 0, layer = ~0u;
  const long long begun = clock64(), begun_at = nanoseconds();
  long long since = begun;
  prefetch(b, 0);
#pragma unroll 1
  for (u32 now = 0; now >> 20 != FINISHED; rest(b)) {
    now = *(volatile u32*)(b.smem + M_PROGRESS);
    if ((now & 0xfffff) != layer) layer = now & 0xfffff, prefetch(b, int(layer) + 1);
    if (now != last) {
      last = now, since = clock64();
    } else if (clock64() - since > 4000000000ll) {
      *(volatile u32*)(b.a.hang + blockIdx.x) = 1u << 31 | now;
      __threadfence_system();
      const long long end = clock64() + 1000000000ll;  // for the other CTAs to say where they are
#pragma unroll 1
      while (clock64() < end) __nanosleep(10000);
      __trap();
    }
  }
  if (blockIdx.x == 0 && b.lane() == 0)
    b.a.clock[0] = clock64() - begun, b.a.clock[1] = nanoseconds() - begun_at;
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) __cluster_dims__(S, 1, 1)
    turbopi_denoise(const __grid_constant__ Args args) {
  extern __shared__ __align__(128) byte smem[];
  Block b(args, smem);
  if (threadIdx.x == 0) {
    note(b, WAIT_NONE);
    for (u32 i = 0; i < STAGES; ++i) barrier_init(b.full(i), 1), barrier_init(b.empty(i), W);
    for (int i = BAR_X; i <= BAR_V; ++i)  // warps that store partial outputs here arrive, too
      barrier_init(b.bar(i), ASYNC && i == BAR_COMB ? 1 + b.qn() : 1);
    barrier_init(b.bar(BAR_GO), S), barrier_init(b.bar(BAR_RMS), 1);
    if constexpr (SPREAD) {
      barrier_init(b.bar(BAR_DONE), W), barrier_init(b.bar(BAR_FREE), S);
      barrier_init(b.bar(BAR_ROOM), S), barrier_init(b.bar(BAR_HERE), W), barrier_init(b.bar(BAR_SQUARES), 1);
    }
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    barrier_expect(b.bar(BAR_X), X_EXPECT);
    if (SPREAD) barrier_expect(b.bar(BAR_SQUARES), SQUARES_EXPECT);
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
    } else {
      keep_awake(b);
    }
  }
  __syncwarp();
  cluster_exchange();  // nobody leaves while a peer may still write to it
}
