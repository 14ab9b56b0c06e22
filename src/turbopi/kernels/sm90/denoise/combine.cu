// The end of attention: what the ranks' keys gave comes together.

// Ranks' outputs of this one's columns, by their largest logits, which come first; then attention to all ranks.
__device__ __forceinline__ void combine(Cta& b) {
  b.forget();
  static_assert(QTL * NT <= W, "a warp for 8 tokens of a tile");
  const int qn = b.qn(), tile = b.warp() % imax(qn, 1), n = b.warp() / imax(qn, 1), token = n * 8 + 2 * b.t();
  const bool mine = b.warp() < qn * NT;
  float2 w[S];
  const AttentionSender sender(b, tile, n);
  receive(b, BAR_TOPS, b.n, TOPS_EXPECT, WAIT_TOPS);
  float2 highest = make_float2(LOWEST, LOWEST);
#pragma unroll
  for (int s = 0; s < S; ++s) {
    w[s] = *(const float2*)(b.smem + M_X + X_TOPS + (s * NT * 8 + min(token, NT * 8 - 2)) * 4);
    highest.x = fmaxf(highest.x, w[s].x), highest.y = fmaxf(highest.y, w[s].y);
  }
#pragma unroll
  for (int s = 0; s < S; ++s)
    w[s] = make_float2(exp2_approx(w[s].x - highest.x), exp2_approx(w[s].y - highest.y));
  MARK(MARK_TOPS_HERE)
  receive(b, BAR_COMB, b.n, outputs_expect(b), WAIT_COMB);
  MARK(MARK_OUTPUTS_HERE)
  if (mine) {
    float4 o = make_float4(0, 0, 0, 0);
    float2 sum = make_float2(0, 0);
#pragma unroll
    for (int s = 0; s < S; ++s) {
      const byte* p = b.smem + M_X + X_COMB + ((s * QTL + tile) * NT + n) * OUTPUT + b.lane() * (OUTPUT / 32);
      float4 v;
      if constexpr (MANY) {
        const uint2 both = *(const uint2*)p;
        v = make_float4(bf16_low(both.x), bf16_high(both.x), bf16_low(both.y), bf16_high(both.y));
      } else {
        v = *(const float4*)p;
      }
      const float2 l = *(const float2*)(b.smem + M_X + X_SUMS + (s * NT * 8 + token) * 4);
      sum.x += w[s].x * l.x, sum.y += w[s].y * l.y;
      o.x += w[s].x * v.x, o.y += w[s].y * v.y, o.z += w[s].x * v.z, o.w += w[s].y * v.w;
    }
    const float x = __fdividef(1.0f, sum.x), y = __fdividef(1.0f, sum.y);
    const float4 v = make_float4(o.x * x, o.y * y, o.z * x, o.w * y);
    sender.send(b, tile, n, v);
  }
  AttentionSender::end(b);
  MARK(MARK_COMBINED)
  // A rank without queries has nothing to send now, but what has come may not land over the stream that comes next.
  if (IDLE_Q && b.thread < S) send(at_rank(b.base + M_TOKEN, b.thread), 0, at_rank(b.bar(BAR_ATT), b.thread));
}

// Attention of this cluster's head, sent to all ranks. Everything local lies in region X.
__device__ __forceinline__ void attend(Cta& b, const float* kv, u32 bit, int prefix) {
  b.forget();
  asm volatile("" : "+r"(prefix));
  const Keys keys(b, prefix);
  attend_keys(b, kv, bit, keys);
  MARK(MARK_OUTPUTS_SENT)
  combine(b);
}
