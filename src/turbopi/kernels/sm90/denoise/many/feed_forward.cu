// Many tokens: gate|up and GeGLU. Awaits the stream. Hidden units land over it when all ranks have multiplied it.
__device__ __forceinline__ void gate_up(Cta& b, const Shifts& shifts, const float* row_scales, Sent&) {
  const int gn = b.gn(), token = 2 * b.t() + (b.g() & 1);
  Own<GTL> own(b, gn);
  GateUpShifts shift(b, shifts, own);
  const GateUpScales scale(b, own, row_scales);
  u32 place[GROUPS_GU][OWN<GTL>];
#pragma unroll
  for (int i = 0; i < GROUPS_GU; ++i)
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k) {
      place[i][k] = units_place(b, own.tile[i], own.n[i][k], token);
      if (COPY_HIDDEN) place[i][k] += X_OWN_HIDDEN - (b.g0() >> 1) * NT * OPERAND;
    }
  Ahead<group_tiles(GTL), 0> ahead(b);
  receive_stream(b, 1);
  MARK(MARK_STREAM_FOR_FEED_FORWARD)
  float sums[GROUPS_GU][NT * 4];
  multiply<GTL, D16>(b, M_X, D16, gn, sums, ahead);  // what the copy engine wrote needs no `show_to_products`
  MARK(MARK_GATE_UP_MULTIPLIED)
  shift.behind_product(b, shifts, own);
  consumers_sync(), give_room(b);
  own.add_up(b, M_X + X_FF_SUMS, gn, sums);
  u32 window[QUARTER], hidden_bars[QUARTER];  // this CTA's shared memory as the receivers'
  if constexpr (!COPY_HIDDEN) {
#pragma unroll
    for (int d = 0; d < QUARTER; ++d)
      window[d] = at_rank(b.base, receiver(b, d)), hidden_bars[d] = at_rank(b.bar(BAR_HID), receiver(b, d));
  }
  inverse_rms(b, 0, 1);
#pragma unroll
  for (int i = 0; i < GROUPS_GU; ++i)
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k)
      if (own.mine[i][k]) {
        const int n = own.n[i][k];
        const float4 c = FP8 ? scaled(own.sums[i][k], scale.of[i]) : own.sums[i][k];
        const u32 two = two_units(b, c, known_rms(b, n * 8 + 2 * b.t()), shift(i, k));
        KEEP(keep_gate_up(b, own.tile[i], n, c, known_rms(b, n * 8 + 2 * b.t()), shift(i, k));)
        if constexpr (COPY_HIDDEN) {  // of a token that doesn't exist any
          byte* const p = b.smem + (place[i][k] - b.base) + (b.g() >> 1) * (FP8 ? 2 : 4);
          if (FP8)
            *(unsigned short*)p = (unsigned short)two;
          else
            *(u32*)p = two;
        } else {
          const uint4 units = eight_units(b, two);
          if (i + k == 0) await_room(b);
          if (n * 8 + token < T) {
            u32 data[QUARTER];
#pragma unroll
            for (int d = 0; d < QUARTER; ++d) data[d] = window[d] + (place[i][k] - b.base);
            send_units(data, units, hidden_bars);
          }
        }
      }
  if constexpr (COPY_HIDDEN) {
    show_to_products();  // to the copy engine, that is
    if (const int block = own.tile[0] >> 1; block < GTL / 2) {
      __syncwarp();
      asm volatile("bar.sync %0, 128;" ::"r"(HIDDEN_BLOCK_MADE + block) : "memory");  // attention's barriers are free
      await_room(b);
      if ((own.tile[0] & 1) == 0 && Share(b, group_parts(GTL)).part == 0 && b.lane() == 0) {  // of the four warps one
        constexpr u32 BYTES = NT * OPERAND;
        const u32 mine = (b.g0() >> 1) * BYTES + block * BYTES;
        byte* const there = (byte*)(b.a.scratch + B_HIDDEN) + b.cluster() * (HC * BYTES) + mine;
        copy_to_all(b, M_X + X_OWN_HIDDEN + block * BYTES, there, M_HID + mine, BYTES, BAR_HID);
      }
      __syncwarp();
    }
  }
  await_room(b), ++b.room;
  if (IDLE) send_no_units(b);
}
