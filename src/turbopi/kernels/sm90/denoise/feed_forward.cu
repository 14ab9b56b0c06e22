// gate|up and GeGLU: what both forms do with a tile's sums.

// x (1 + tanh u) / 2 = x / (1 + exp(-2 u)). E4M3 rounds far more coarsely than an approximate tanh, which takes one
// turn of the special function unit instead of two.
__device__ __forceinline__ float gelu(float x) {
  if constexpr (FP8 && MANY) {
    float tanh_u;
    asm("tanh.approx.f32 %0, %1;" : "=f"(tanh_u) : "f"(x * (0.7978845608f + 0.0356774081f * x * x)));
    return 0.5f * x * tanh_u + 0.5f * x;
  }
  return __fdividef(x, 1.0f + exp2_approx(-2.302208198f * (x + 0.044715f * x * x * x)));  // 2 sqrt(2 / pi) log2 e
}

constexpr int GROUPS_GU = plan_groups(GTL);
// A lane's first row of a tile of gate|up, which has 8 units' gate rows, then their up rows.
__device__ __forceinline__ int gate_up_row(const Cta& b, int tile) {
  return (QTL + KVL + min(tile, GTL - 1)) * 16 + b.g();
}
struct GateUpScales {  // of FP8: of a lane's two rows
  float2 of[GROUPS_GU];
  __device__ __forceinline__ GateUpScales(const Cta& b, const Own<GTL>& own, const float* row_scales) {
#pragma unroll
    for (int i = 0; i < GROUPS_GU; ++i)
      if (FP8) {
        const int row = gate_up_row(b, own.tile[i]);
        of[i] = make_float2(__ldg(row_scales + row), __ldg(row_scales + row + 8));
      }
  }
};
// Where the hidden units of token `token` of 8 tokens n begin, of gate|up tile `tile`, at any rank.
__device__ __forceinline__ u32 units_place(const Cta& b, int tile, int n, int token) {
  const int at = b.g0() + tile;
  return b.base + M_HID + ((at >> 1) * NT + n) * OPERAND + (at & 1) * (FP8 ? 8 : 128) + token * 16;
}
// Two units of token 2 t + g % 2, of a lane's sums for two tokens.
__device__ __forceinline__ u32 two_units(const Cta& b, float4 c, float2 r, Factors of_rows) {
  const float4 shift = of_item(of_rows);
  const float h0 = gelu(c.x * r.x + shift.x) * (c.z * r.x + shift.z),
              h1 = gelu(c.y * r.y + shift.y) * (c.w * r.y + shift.w);
  const float got = exchange(b.g() & 1 ? h0 : h1, 4);
  return b.g() & 1 ? pack_operand(got, h1) : pack_operand(h0, got);
}
// Of four lanes' two units all 8, which each of them gets. E4M3: the first two words.
__device__ __forceinline__ uint4 eight_units(const Cta& b, u32 two) {
  const u32 next = exchange(two, 8);
  const u32 lo = b.g() & 2 ? next : two, hi = b.g() & 2 ? two : next;
  if constexpr (FP8) {
    const u32 four = lo | hi << 16, far = exchange(four, 16);
    return b.g() & 4 ? make_uint4(far, four, 0, 0) : make_uint4(four, far, 0, 0);
  }
  const u32 far_lo = exchange(lo, 16), far_hi = exchange(hi, 16);
  return b.g() & 4 ? make_uint4(far_lo, far_hi, lo, hi) : make_uint4(lo, hi, far_lo, far_hi);
}
// Four lanes have the same units: they share the ranks to which those go.
constexpr int QUARTER = most(S, 4);
static_assert(S % 4 == 0, "four lanes share the ranks");
__device__ __forceinline__ int receiver(const Cta& b, int d) { return (b.g() >> 1) * QUARTER + d; }
__device__ __forceinline__ void send_units(const u32 (&data)[QUARTER], uint4 units, const u32 (&bars)[QUARTER]) {
#pragma unroll
  for (int d = 0; d < QUARTER; ++d)
    if (FP8)
      send(data[d], units.x, units.y, bars[d]);
    else
      send(data[d], units, bars[d]);
}
// In small models: a rank without hidden units has nothing to send.
__device__ __forceinline__ void send_no_units(const Cta& b) {
  inverse_rms(b, 0, 1), consumers_sync();  // no warp may be left behind by a whole use of a barrier
  if (b.thread < S) send(at_rank(b.base + M_TOKEN, b.thread), 0, at_rank(b.bar(BAR_HID), b.thread));
}
