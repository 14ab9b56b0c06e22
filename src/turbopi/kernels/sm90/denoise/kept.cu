// What the way back through a step needs, to global memory (launches of one step, so b.n is the layer): the residual
// stream in front of every norm, turned queries, gate|up's products, and the suffix's keys and values in the cache's rows.
// Nobody waits for these stores. All bfloat16.

#define KEEP(...) __VA_ARGS__

__device__ __forceinline__ unsigned short rounded(float v) { return (unsigned short)pack(v, 0); }

// The stream in front of norm `index`. If every cluster has all of it, they take turns.
__device__ __forceinline__ void keep_stream(const Cta& b, const float4 (&x)[ITEMS_X], u32 index) {
  if (!MANY && b.cluster() != int(index % NC)) return;
#pragma unroll
  for (int j = 0; j < ITEMS_X; ++j) {
    const Item item = stream_item(b, j);
    if (!item.real) continue;
    const int column = (b.x0() + item.tile) * 16 + 2 * b.g();
    unsigned short* const to = b.a.kept_x + (size_t(index) * T + item.token) * D + column;
    *(u32*)to = pack(x[j].x, x[j].z);
    if (item.token + 1 < T) *(u32*)(to + D) = pack(x[j].y, x[j].w);
  }
}

// Two numbers of token `token`, `apart` columns from each other, then two of the next one, in rows of HD.
__device__ __forceinline__ void keep_rows(unsigned short* to, int next, int apart, int token, float4 v) {
  if (token < T) to[0] = rounded(v.x), to[apart] = rounded(v.y);
  if (token + 1 < T) to[next] = rounded(v.z), to[next + apart] = rounded(v.w);
}
__device__ __forceinline__ void keep_queries(const Cta& b, int token, int column, float4 v) {
  keep_rows(b.a.kept_q + ((size_t(b.n) * T + token) * NH + b.cluster()) * HD + column, NH * HD, HD / 2, token, v);
}
// Of the suffix's keys, or its values.
__device__ __forceinline__ void keep_keys(const Cta& b, unsigned char* own, int token, int column, int apart, float4 v) {
  keep_rows((unsigned short*)(own + b.n * b.a.layer_stride) + token * HD + column, HD, apart, token, v);
}

// A lane's unit of gate|up tile `tile`: gate and up of its two tokens of 8 tokens n, from the product's sums.
__device__ __forceinline__ void keep_gate_up(const Cta& b, int tile, int n, float4 c, float2 r, Factors of_rows) {
  const float4 shift = of_item(of_rows);
  const int token = n * 8 + 2 * b.t(), unit = share(F16, NC, b.cluster()) * 16 + (b.g0() + tile) * 8 + b.g();
  keep_rows(b.a.kept_gate_up + (size_t(b.n) * T + token) * (2 * F) + unit, 2 * F, F, token,
            make_float4(c.x * r.x + shift.x, c.z * r.x + shift.z, c.y * r.y + shift.y, c.w * r.y + shift.w));
}
