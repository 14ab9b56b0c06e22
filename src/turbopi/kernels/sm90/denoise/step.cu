// Between steps: what both forms need.

// Four action numbers of two tokens (y) times the weights of two columns.
__device__ __forceinline__ void add_actions(float4& c, float4 w0, float4 w1, float4 y0, float4 y1) {
  c.x += w0.x * y0.x + w0.y * y0.y + w0.z * y0.z + w0.w * y0.w,
      c.y += w0.x * y1.x + w0.y * y1.y + w0.z * y1.z + w0.w * y1.w;
  c.z += w1.x * y0.x + w1.y * y0.y + w1.z * y0.z + w1.w * y0.w,
      c.w += w1.x * y1.x + w1.y * y1.y + w1.z * y1.z + w1.w * y1.w;
}

// What the caller gets to see of a step.
__device__ __forceinline__ void put_out(const Cta& b, int step, int at, float v, float next) {
  b.a.v_t[size_t(step) * T * A + at] = v;
  b.a.x_t[size_t(step + 1) * T * A + at] = next;
}
