// The stream's norms, and the products that go back into it.

// A spare warp makes 1 / rms of all tokens.
__device__ __forceinline__ void make_inverse_rms(const Cta& b) {
  const int uses = b.a.steps * L * 2;
#pragma unroll 1
  for (int use = 0; use < uses; ++use) {
    await_squares(b, use);
    constexpr int LANES = imax(32 / (NT * 8), 1), TOKENS = 32 / LANES;  // lanes of a token, tokens at once
#pragma unroll 1
    for (int token = b.lane() % TOKENS; token < NT * 8; token += 32) {
      float sum = 0;
#pragma unroll 8
      for (int s = b.lane() / TOKENS; s < SQ; s += LANES)
        sum += *(const float*)(b.smem + M_SSQ + (s * NT * 8 + token) * 4);
#pragma unroll
      for (int o = TOKENS; o < 32; o *= 2) sum += exchange(sum, o);
      *(float*)(b.smem + M_RMS + token * 4) = rms_from(b, sum);
    }
    __syncwarp();
    if (b.lane() == 0) barrier_arrive(b.bar(BAR_RMS));
  }
}

// A product back into the stream: this cluster's partial sums of the slice, for the CTAs of equal rank. Its partial
// sums lie over its own operand, region H, unless they have a place of their own. Nothing for region H can arrive
// before it is read: a peer sends queries or hidden units only when it has this rank's whole slice of the stream, which
// follows what is published here. `sent` is kept until weights have been read; `await` until the operand is here;
// `then`, behind the product, what else there is.
template <int EVEN, typename Await, typename Then>
__device__ __forceinline__ void residual_product(Cta& b, int x, int blocks, int region, uint4* buffer, u32 bit,
                                                 Await await, Then then, const Sent& sent) {
  Ahead<group_tiles(DX), RESIDUAL_AHEAD> ahead(b);
  Own<DX> own(b, b.xn());
  uint2* place[plan_groups(DX)][OWN<DX>];  // in the buffer
#pragma unroll
  for (int i = 0; i < plan_groups(DX); ++i)
#pragma unroll
    for (int k = 0; k < OWN<DX>; ++k) place[i][k] = sums_place(b, buffer, own.tile[i], own.n[i][k]);
  sent.until_here();
  await();
  show_to_products();
  float sums[plan_groups(DX)][NT * 4];
  multiply<DX, EVEN>(b, x, blocks, b.xn(), sums, ahead);
  then();
  own.add_up(b, region, b.xn(), sums);
#pragma unroll
  for (int i = 0; i < plan_groups(DX); ++i)
#pragma unroll
    for (int k = 0; k < OWN<DX>; ++k) {
      const int n = own.n[i][k];
      if (own.mine[i][k] && n * 8 + 2 * b.t() < T) {
        const float4 c = own.sums[i][k];
        publish(place[i][k], pack_half(c.x * PARTIAL_SCALE, c.y * PARTIAL_SCALE),
                pack_half(c.z * PARTIAL_SCALE, c.w * PARTIAL_SCALE), bit);
      }
    }
}
