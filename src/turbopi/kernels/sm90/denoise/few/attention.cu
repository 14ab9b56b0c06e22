// Few tokens: attention's ends.

__device__ __forceinline__ void attend_keys(Cta& b, const float* kv, u32 bit, const Keys& keys) { attend_by_warps(b, kv, bit, keys); }
__device__ __forceinline__ u32 outputs_expect(const Cta& b) {
  return S * ((T + 1) / 2) * 8 + S * b.qn() * ((T + 1) / 2) * (OUTPUT / 4);
}

constexpr u32 ATT_EXPECT = HD * T * (OPERAND / 128) + (IDLE_Q ? S * 4 : 0);
// How 8 tokens of a tile of this rank's attention get to all ranks.
struct AttentionSender {
  Everyone places, bars;
  __device__ __forceinline__ AttentionSender(const Cta& b, int tile, int n)
      : places(columns_place(b, M_ATT, b.q0() + tile, n)), bars(b.bar(BAR_ATT)) {}
  __device__ __forceinline__ void send(const Cta& b, int, int n, float4 v) const { send_columns(b, places, bars, n, v, true); }
  static __device__ __forceinline__ void end(const Cta&) {}
};
