// Many tokens: the loop.

__device__ __forceinline__ u32 hidden_bytes(const Cta& b) {
  if (COPY_HIDDEN) return HC * NT * OPERAND;
  return b.hn() * 16 * T * (OPERAND / 128) + (IDLE ? S * 4 : 0);
}

// The warps that multiply.
__device__ __forceinline__ void consume(Cta& b) {
  const Args& a = b.a;
  const int prefix = PREFIX_ROWS(a);
  Actions actions(b);
  float4 rope[ITEMS_Q], x[ITEMS_X];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) rope[j] = rope_of(b, prefix, QkvItem(b, j));
  const u32 expect_hidden = hidden_bytes(b);
  KeptRow(b, 0).keep(b);
  begin_trace(b);
#pragma unroll 1
  for (int step = 0; step < a.steps; ++step) {
    const float* const table = step_table(b, step);
    embed_own(b, actions, x, table);
    KEEP(keep_stream(b, x, 0);)
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
          project(b, Shifts(b, step), of_tiles(b, a.row_scales, layer), kv, bit, rope);
          MARK(MARK_QKV_SENT)
          attend(b, kv, bit, prefix);
        }
        uint4* const buffer = sums_buffer(b, half);
        auto await = [&] { await_operand(b, half, expect_hidden); };
        auto then = [&] {
          if (!half) load_norm(b, step, half, gates, scales);
        };
        if (half)
          residual_product<HIDDEN>(b, M_HID, b.hn(), M_X + X_FF_SUMS, buffer, bit, await, then, sent);
        else
          residual_product<QT>(b, M_ATT, QT, M_X, buffer, bit, await, then, sent);
        if (!half || !last) done_with_x(b);  // behind the last layer `embed_own` says it
        MARK(half ? MARK_DOWN_PUBLISHED : MARK_OUT_PUBLISHED)
        note(b, half ? WAIT_X1 : WAIT_X2);
        gather(b, x, buffer, bit, gates, scales, !half || !last, half);
        KEEP(keep_stream(b, x, 2 * b.n + half + 1);)
        MARK(half ? MARK_SLICE_AFTER_FEED_FORWARD : MARK_SLICE_AFTER_ATTENTION)
      }
    }
    advance_own(b, actions, x, table + 2 * L * 3 * D, step);
  }
  note(b, FINISHED);
  end_trace(b);
}

// The last of the spare warps.
__device__ __forceinline__ void help(const Cta& b) { fetch_stream(b); }

__device__ __forceinline__ u32 arrivals(const Cta& b, int bar) {  // warps that store partial outputs here arrive, too
  return ASYNC && bar == BAR_COMB ? 1 + b.qn() : 1;
}
__device__ __forceinline__ void init_own_barriers(const Cta& b) {
  barrier_init(b.bar(BAR_DONE), W), barrier_init(b.bar(BAR_FREE), S);
  barrier_init(b.bar(BAR_ROOM), S), barrier_init(b.bar(BAR_HERE), W), barrier_init(b.bar(BAR_SQUARES), 1);
}
__device__ __forceinline__ void expect_own(const Cta& b) { barrier_expect(b.bar(BAR_SQUARES), SQUARES_EXPECT); }
