// Few tokens: the loop.

__device__ __forceinline__ u32 hidden_bytes(const Cta& b) {
  return b.hn() * 16 * T * (OPERAND / 128) + (IDLE ? S * 4 : 0);
}

// The warps that multiply.
__device__ __forceinline__ void consume(Cta& b) {
  const Args& a = b.a;
  const int prefix = PREFIX_ROWS(a);
  for (int i = b.thread; i < T * A; i += CONSUMERS) {
    ((float*)(b.smem + M_XT))[i] = a.noise[i];
    if (b.cta == 0) a.x_t[i] = a.noise[i];
  }
  keep_rope(b, prefix);
  float4 x[ITEMS_X];
  const u32 expect_hidden = hidden_bytes(b);
  begin_trace(b);
  KeptRow(b, 0).keep(b);
  const Embedding first(b, a.table, 0);
  consumers_sync();
  first.multiply(b, x), first.send(b, x);
  KEEP(keep_stream(b, x, 0);)
#pragma unroll 1
  for (int step = 0; step < a.steps; ++step) {
    const float* const table = step_table(b, step);
    MARK(MARK_EMBEDDED)
#pragma unroll 1
    for (; b.n < u32(step + 1) * L; ++b.n) {
      const bool last = b.n + 1 == u32(step + 1) * L;
#pragma unroll 1
      for (int half = 0; half < 2; ++half) {  // attention, feed-forward
        b.forget();
        const u32 bit = flag(b.n), layer = b.n - step * L;
        Factors gates[ITEMS_X], scales[ITEMS_X];
        Sent sent = {};
        if (half) {
          gate_up(b, Shifts(b, step), of_tiles(b, a.row_scales, layer), sent);
          MARK(MARK_HIDDEN_SENT)
          load_norm(b, step, half, gates, scales);
        } else {
          float* const kv = suffix_buffer(b);
          project(b, Shifts(b, step), of_tiles(b, a.row_scales, layer), kv, bit);
          MARK(MARK_QKV_SENT)
          attend(b, kv, bit, prefix);
        }
        uint4* const buffer = sums_buffer(b, half);
        auto await = [&] { await_operand(b, half, expect_hidden); };
        auto then = [&] {
          if (!half) load_norm(b, step, half, gates, scales);
        };
        // one piece of code for both
        constexpr int EVEN = HIDDEN % 16 == 0 && QT % 16 == 0 ? 16 : HIDDEN % 8 == 0 && QT % 8 == 0 ? 8 : 1;
        residual_product<EVEN>(b, half ? M_HID : M_ATT, half ? b.hn() : QT, M_H, buffer, bit, await, then, sent);
        MARK(half ? MARK_DOWN_PUBLISHED : MARK_OUT_PUBLISHED)
        note(b, half ? WAIT_X1 : WAIT_X2);
        gather(b, x, buffer, bit, gates, scales, !half || !last, half, half && last);
        KEEP(keep_stream(b, x, 2 * b.n + half + 1);)
        MARK(half ? MARK_SLICE_AFTER_FEED_FORWARD : MARK_SLICE_AFTER_ATTENTION)
      }
    }
    advance(b, x, step + 1 < a.steps ? next_table(table) : table, step);
  }
  note(b, FINISHED);
  end_trace(b);
}

// The last of the spare warps.
__device__ __forceinline__ void help(const Cta& b) {
  float c[4] = {0, 0, 0, 0};
  const u32 zero = b.a.zero;
#pragma unroll 1
  while (*(volatile u32*)(b.smem + M_PROGRESS) >> 20 != FINISHED) {
#pragma unroll
    for (int i = 0; i < 8; ++i) stay_awake(c, zero);  // to look seldom: who looks takes time from others
  }
  pretend_to_need(b, c);
}

__device__ __forceinline__ u32 arrivals(const Cta&, int) { return 1; }
__device__ __forceinline__ void init_own_barriers(const Cta&) {}
__device__ __forceinline__ void expect_own(const Cta&) {}
