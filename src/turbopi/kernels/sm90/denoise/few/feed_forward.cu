// Few tokens: gate|up and GeGLU. Awaits the stream. The next slice of the stream arrives in region X only when a peer has
// all of this rank's hidden units.
__device__ __forceinline__ void gate_up(Cta& b, const Shifts& shifts, const float* row_scales, Sent& sent) {
  const int gn = b.gn(), token = 2 * b.t() + (b.g() & 1);
  Own<GTL> own(b, gn);
  GateUpShifts shift(b, shifts, own);
  const GateUpScales scale(b, own, row_scales);
  u32 place[GROUPS_GU][OWN<GTL>];
#pragma unroll
  for (int i = 0; i < GROUPS_GU; ++i)
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k) place[i][k] = settled(units_place(b, own.tile[i], own.n[i][k], token));
  Ahead<group_tiles(GTL), GATE_UP_AHEAD> ahead(b);
  receive_stream(b, 1);
  MARK(MARK_STREAM_FOR_FEED_FORWARD)
  float sums[GROUPS_GU][NT * 4];
  show_to_products();
  multiply<GTL, D16>(b, M_X, D16, gn, sums, ahead);
  MARK(MARK_GATE_UP_MULTIPLIED)
  shift.behind_product(b, shifts, own);
  own.add_up(b, M_X, gn, sums);
#pragma unroll
  for (int i = 0; i < GROUPS_GU; ++i)
#pragma unroll
    for (int k = 0; k < OWN<GTL>; ++k)
      if (own.mine[i][k]) {
        const int n = own.n[i][k];
        const float4 c = FP8 ? scaled(own.sums[i][k], scale.of[i]) : own.sums[i][k];
        const uint4 units = eight_units(b, two_units(b, c, inverse_rms(b, n * 8 + 2 * b.t(), 1), shift(i, k)));
        if (n * 8 + token < T) {
          u32 data[QUARTER], bars[QUARTER];
#pragma unroll
          for (int d = 0; d < QUARTER; ++d)
            data[d] = at_rank(place[i][k], receiver(b, d)), bars[d] = at_rank(b.bar(BAR_HID), receiver(b, d));
          send_units(data, units, bars);
          static_assert(QUARTER == 2, "what `sent` has room for");
          sent = {units, make_uint4(data[0], data[1], bars[0], bars[1])};
        }
        KEEP(keep_gate_up(b, own.tile[i], n, c, known_rms(b, n * 8 + 2 * b.t()), shift(i, k));)
      }
  if (IDLE) send_no_units(b);
}
