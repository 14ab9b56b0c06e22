// The residual stream: an item of it, as a warp and as products have it.

// An item is (tile, 8 tokens); lane (g, t) has columns 2g, 2g + 1 of tokens 2t, 2t + 1 of it, as x y (first column) and
// z w (second). A warp keeps its items in registers for good.

struct Item {
  int tile, n, token;  // token: the lane's first
  bool mine, real;     // of this warp; of tokens that exist, too
};

// Of an item's lane pair the four columns 2g.. of one token (even g: 2t, odd g: 2t + 1); in E4M3 the first word alone.
__device__ __forceinline__ uint2 columns_of(const Cta& b, float4 v) {
  const u32 w0 = pack_operand(v.x, v.z), w1 = pack_operand(v.y, v.w), got = exchange(b.g() & 1 ? w0 : w1, 4);
  const uint2 both = make_uint2(b.g() & 1 ? got : w0, b.g() & 1 ? w1 : got);
  return FP8 ? make_uint2(both.x | both.y << 16, 0) : both;
}

// An item's sums of squares, of the lane's two tokens.
__device__ __forceinline__ float2 squares_of(float4 x) {
  float q0 = x.x * x.x + x.z * x.z, q1 = x.y * x.y + x.w * x.w;
#pragma unroll
  for (int o = 4; o < 32; o *= 2) q0 += exchange(q0, o), q1 += exchange(q1, o);
  return make_float2(q0, q1);
}

// `columns_of` to all ranks, where `columns_place` says.
__device__ __forceinline__ u32 columns_place(const Cta& b, int region, int block, int n) {
  const int token = 2 * b.t() + (b.g() & 1);
  const int in_row = FP8 ? (b.g() >> 1) * 4 : (b.g() >> 2) * 128 + (b.g() >> 1 & 1) * 8;
  return b.base + region + (block * NT + n) * OPERAND + token * 16 + in_row;
}
__device__ __forceinline__ void send_columns(const Cta& b, const Everyone& data, const Everyone& bars, int n,
                                             float4 v, bool real) {
  const uint2 columns = columns_of(b, v);
  const int token = 2 * b.t() + (b.g() & 1);
  if (real && n * 8 + token < T) {
#pragma unroll
    for (int d = 0; d < S; ++d)
      if (FP8)
        send(data.at[d], columns.x, bars.at[d]);
      else
        send(data.at[d], columns.x, columns.y, bars.at[d]);
  }
}

// 1 / rms of tokens `token` and `token` + 1 (even), once the stream is here: a spare warp makes them.
__device__ __forceinline__ float2 known_rms(const Cta& b, int token) {
  return *(const float2*)(b.smem + M_RMS + token * 4);
}
__device__ __forceinline__ float2 inverse_rms(const Cta& b, int token, int half) {
  barrier_wait(b.bar(BAR_RMS), half);
  return known_rms(b, token);
}
__device__ __forceinline__ float rms_from(const Cta& b, float squares) {  // 1 / rms
  return rsqrtf(squares * (1.0f / D) + b.a.eps);
}

// What a product adds to an item of the stream: the sum over all clusters times the gate.
__device__ __forceinline__ void add_gated(float4& x, float4 sum, Factors gate, bool real) {
  const float4 of = of_item(gate);
  const float4 by =
      make_float4(of.x / PARTIAL_SCALE, of.y / PARTIAL_SCALE, of.z / PARTIAL_SCALE, of.w / PARTIAL_SCALE);
  if (real) x.x += by.x * sum.x, x.y += by.y * sum.y, x.z += by.z * sum.z, x.w += by.w * sum.w;
}
