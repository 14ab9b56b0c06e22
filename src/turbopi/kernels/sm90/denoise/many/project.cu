// Many tokens: queries, keys and values of the suffix.

// By one warp: this rank's queries, staged [half][tile][NT][8 tokens][8] at M_ATT, to all ranks when there is room.
__device__ __forceinline__ void copy_queries(const Cta& b) {
  constexpr u32 BYTES = QTL * NT * 128, HALF = QT * NT * 128;  // of half the columns: this rank's, all
  const u32 place = b.q0() * NT * 128;
  byte* const there = (byte*)(b.a.scratch + B_QUERIES) + size_t(b.cluster()) * 2 * HALF + place;
  if (b.lane() == 0) {
    show_to_products();
    bulk_store(there, b.base + M_ATT, BYTES), bulk_store(there + HALF, b.base + M_ATT + BYTES, BYTES);
    await_stored();
  }
  __syncwarp();
  await_room(b);
  if (b.lane() == 0) {
    load_for_all(b.base + M_Q + place, there, BYTES, b.bar(BAR_Q));
    load_for_all(b.base + M_Q + place + HALF, there + HALF, BYTES, b.bar(BAR_Q));
  }
  __syncwarp();
}

// Awaits the stream. q to all ranks, k and v to all clusters as float32 with their flags. The partial sums lie over the
// stream.
__device__ __forceinline__ void project(Cta& b, const Shifts& shifts, const float* row_scales, float* kv, u32 bit,
                                        const float4 (&rope)[ITEMS_Q]) {
  const int tiles = b.qn() + b.kvn();
  Factors shift[ITEMS_Q];
  float2 scale[ITEMS_Q];
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j) {
    const QkvItem item(b, j);
    const int row = item.row(b);
    shift[j] = shifts(b, row, item.mine ? item.n : 0);
    if (FP8) scale[j] = make_float2(__ldg(row_scales + row), __ldg(row_scales + row + 8));
  }
  Ahead<group_tiles(QKV), 0> ahead(b);
  receive_stream(b, 0);
  MARK(MARK_STREAM_FOR_ATTENTION)
  float sums[plan_groups(QKV)][NT * 4];
  multiply<QKV, D16>(b, M_X, D16, tiles, sums, ahead);
  MARK(MARK_QKV_MULTIPLIED)
  consumers_sync(), give_room(b);
  store_partials<QKV>(b, b.smem + M_X, tiles, sums);
  consumers_sync();
  if (b.thread < NT * 8) ((int*)(b.smem + M_PART))[b.thread] = ordered(LOWEST);  // for `weigh_prefix`
  // Free until all have what attention sends: [item][half][8 tokens][8], or see `copy_queries`.
  byte* const staged = b.smem + M_ATT;
#pragma unroll
  for (int j = 0; j < ITEMS_Q; ++j)
    if (const QkvItem item(b, j); item.mine) {
      float4 c = total<QKV>(b, b.smem + M_X, item.at, item.n);
      if (FP8) c = scaled(c, scale[j]);
      byte* const query = staged + (COPY_QUERIES ? (item.at * NT + item.n) * 128 : item.i * 256);
      finish_item<COPY_QUERIES ? QTL * NT * 64 : 64>(b, item, c, shift[j], rope[j], query, kv, bit);
    }
  consumers_sync();  // all sums have been read
  if constexpr (COPY_QUERIES) {
    if (b.warp() == COPY_WARP) copy_queries(b);
  } else {
    await_room(b);
    send_queries(b, staged);
  }
  ++b.room;
}
constexpr u32 Q_EXPECT = HD * (COPY_QUERIES ? NT * 8 : T) * 2 + (IDLE_Q ? S * 4 : 0);
