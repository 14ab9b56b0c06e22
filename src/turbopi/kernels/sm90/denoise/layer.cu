// Half a layer, attention (half 0) or feed-forward (half 1): where its weights' tables and sums lie.

// A lane's columns of the norms' tables, from one place in their rows. Asked for well before `gather`: its polls would
// queue up behind them.
__device__ __forceinline__ void load_columns(const Cta& b, Factors (&v)[ITEMS_X], const float* row) {
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    v[j] = factors(row, (b.x0() + item.tile) * 16 + 2 * b.g(), rows_of(b, item.token));
  }
}
// The gates of this half, and the scales of the next norm: the final one behind the last layer.
__device__ __forceinline__ void load_norm(const Cta& b, int step, int half, Factors (&gates)[ITEMS_X], Factors (&scales)[ITEMS_X]) {
  const float* const table = layer_table(b, step);
  load_columns(b, gates, table + (half ? 5 : 2) * D);
  load_columns(b, scales, table + (half ? 6 : 3) * D);
}
__device__ __forceinline__ uint4* sums_buffer(const Cta& b, int half) {
  return b.a.scratch + (half ? B_X1 : B_X2) + (settled(b.n) & 1) * N_STREAM;
}
__device__ __forceinline__ float* suffix_buffer(const Cta& b) { return (float*)(b.a.scratch + B_KV + (b.n & 1) * N_KV); }
// Until what goes back into the stream is here: attention or hidden units.
__device__ __forceinline__ void await_operand(const Cta& b, int half, u32 expect_hidden) {
  if (half) {
    receive(b, BAR_HID, b.n, expect_hidden, WAIT_HID);
    MARK(MARK_HIDDEN_HERE)
  } else {
    receive(b, BAR_ATT, b.n, ATT_EXPECT, WAIT_ATT);
    MARK(MARK_ATTENTION_HERE)
  }
}
constexpr int HIDDEN = F16 % NC == 0 ? HC : 1;  // blocks of the hidden units are a multiple of it

__device__ __forceinline__ void begin_trace(const Cta& b) {
#ifdef TP_TRACED_WARP
  if (threadIdx.x < 32) ((u32*)(b.smem + M_BAR + 256))[threadIdx.x] = threadIdx.x ? 0 : u32(clock64());
  consumers_sync();
#endif
}
__device__ __forceinline__ void end_trace(const Cta& b) {
#ifdef TP_TRACED_WARP
  consumers_sync();
  if (threadIdx.x < 32) b.a.trace[blockIdx.x * 64 + threadIdx.x] = ((u32*)(b.smem + M_BAR + 256))[threadIdx.x];
#endif
}
