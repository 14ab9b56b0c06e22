// What becomes of a product's sums.

__device__ __forceinline__ float2 two(const float* from) { return __ldg((const float2*)from); }

// 1 / rms of all tokens, from the sums of squares of all tiles. A warp has every WARPS-th token, all on their way at once.
__device__ __forceinline__ void make_inverse_rms(const Args& args, float* smem) {
  const int thread = thread_of_phase(), warp = thread / 32, lane = thread % 32;
  constexpr int OWN = (T + WARPS - 1) / WARPS;
  float sums[OWN] = {}, mine = 0;
#pragma unroll
  for (int i = 0; i < OWN; ++i) {
    const int token = i * WARPS + warp;
    if (i * WARPS + WARPS <= T || token < T)
#pragma unroll
      for (int tile = 0; tile < D_TILES; tile += 32)
        if (tile + lane < D_TILES) sums[i] += __ldcg(args.squares + token * D_TILES + tile + lane);
  }
#pragma unroll
  for (int by = 16; by; by /= 2)
#pragma unroll
    for (int i = 0; i < OWN; ++i) sums[i] += __shfl_xor_sync(~0u, sums[i], by);
#pragma unroll
  for (int i = 0; i < OWN; ++i)
    if (lane == i) mine = sums[i];
  if (lane < OWN && lane * WARPS + warp < T) smem[S_RMS + lane * WARPS + warp] = rsqrtf(mine / D + args.eps);
}

// The same in front of a product. Of a narrow stream some threads have a token of the block's range: their loads go in front
// of the product's, and few sums cross lanes.
template <class S>
struct InverseRms {
  static constexpr bool NARROW = !MODULATED && D_TILES % 2 == 0;
  static constexpr int SHARING = power_of_two(THREADS / S::RANGE, 32);  // threads of a token
  static constexpr int LOADS = NARROW ? (D_TILES / 2 + SHARING - 1) / SHARING : 1;
  const Args& args;
  float* smem;
  float2 of[LOADS];
  __device__ __forceinline__ void ask(int thread, int from) {
    if (!NARROW) return;
    const int token = thread / SHARING, mine = thread % SHARING;
#pragma unroll
    for (int i = 0; i < LOADS; ++i) {
      of[i] = make_float2(0, 0);
      if (token < S::RANGE && from + token < T && (i * SHARING + mine) * 2 < D_TILES)
        of[i] = __ldcg((const float2*)(args.squares + (from + token) * D_TILES) + i * SHARING + mine);
    }
  }
  __device__ __forceinline__ void make(int thread, int from) {
    if (!NARROW) {
      make_inverse_rms(args, smem);
      return;
    }
    float sum = 0;
#pragma unroll
    for (int i = 0; i < LOADS; ++i) sum += of[i].x + of[i].y;
#pragma unroll
    for (int by = SHARING / 2; by; by /= 2) sum += __shfl_xor_sync(~0u, sum, by);
    const int token = from + thread / SHARING;
    if (thread / SHARING < S::RANGE && token < T && thread % SHARING == 0) smem[S_RMS + token] = rsqrtf(sum / D + args.eps);
  }
};
struct Nothing {
  __device__ __forceinline__ void ask(int, int) const {}
  __device__ __forceinline__ void make(int, int) const {}
};

// Sums of the stream behind a norm: times 1 / rms (of eight bits, and the channel's scale), plus the shift's product.
struct Normed {
  const float *shifted, *scales;  // of the product's first channel
  const float* inverse_rms;       // shared memory
  struct Factors {
    float2 shift, scale;
  };
  __device__ __forceinline__ Factors of(Item i) const {
    Factors f{make_float2(0, 0), make_float2(1, 1)};
    if (MODULATED && i.valid) f.shift = two(shifted + i.tile * 8 + i.pair * 2);
    if (SCALED && i.valid) f.scale = two(scales + i.tile * 8 + i.pair * 2);
    return f;
  }
  // Those of the block's tiles, to L2
  __device__ __forceinline__ void ahead(int first, int end) const {
    const int tile = first + threadIdx.x;
    if (tile >= end) return;
    if (MODULATED) to_l2(shifted + tile * 8);
    if (SCALED) to_l2(scales + tile * 8);
  }
  __device__ __forceinline__ float2 apply(Item i, Factors f, float2 sum) const {
    const float by = inverse_rms[i.token];
    return make_float2(sum.x * (by * f.scale.x) + f.shift.x, sum.y * (by * f.scale.y) + f.shift.y);
  }
};

// q|k|v. A tile of queries or keys has RoPE's partners side by side: pair p of it are columns 4 t + p and HD / 2 more.
struct Turned {
  Normed normed;
  const float2* rope;  // [T][HD / 2] cosine, sine
  static constexpr int HEAD_TILES = HD / 8;
  struct Factors {
    Normed::Factors normed;
    float2 rope;
  };
  __device__ __forceinline__ Factors factors(Item i) const {
    Factors f{normed.of(i), make_float2(1, 0)};
    if (i.valid && i.tile < (HEADS + KV_HEADS) * HEAD_TILES)
      f.rope = __ldg(rope + i.token * (HD / 2) + i.tile % HEAD_TILES * 4 + i.pair);
    return f;
  }
  __device__ __forceinline__ static u32 turned(Factors f, float2 v) {
    return pack(v.x * f.rope.x - v.y * f.rope.y, v.y * f.rope.x + v.x * f.rope.y);
  }
};
struct FinishQkv : Turned {
  unsigned short *queries, *keys, *values;
  __device__ __forceinline__ void apply(Item i, Factors f, float2 sum) const {
    if (!i.valid) return;
    const float2 v = normed.apply(i, f.normed, sum);
    const int head = i.tile / HEAD_TILES;
    if (head >= HEADS + KV_HEADS) {
      const int row = (head - HEADS - KV_HEADS) * T + i.token;
      *(u32*)(values + row * HD + i.tile % HEAD_TILES * 8 + i.pair * 2) = pack(v.x, v.y);
      return;
    }
    const u32 both = turned(f, v);
    unsigned short* const to =
        (head < HEADS ? queries + (head / GROUP * ROWS + i.token * GROUP + head % GROUP) * HD : keys + ((head - HEADS) * T + i.token) * HD) +
        i.tile % HEAD_TILES * 4 + i.pair;
    to[0] = both, to[HD / 2] = both >> 16;
  }
};
// Queries of one head, to shared memory.
struct FinishQueries : Turned {
  unsigned short* queries;  // of the block's first token
  int from;
  __device__ __forceinline__ void apply(Item i, Factors f, float2 sum) const {
    if (!i.valid) return;
    const u32 both = turned(f, normed.apply(i, f.normed, sum));
    unsigned short* const to = queries + (i.token - from) * QUERIES_ROW * 2 + i.tile % HEAD_TILES * 4 + i.pair;
    to[0] = both, to[HD / 2] = both >> 16;
  }
};

__device__ __forceinline__ float silu(float v) { return __fdividef(v, 1 + exp2f(v * -1.4426950408889634f)); }

// gate|up: of a pair the first is a unit's gate, the second its up.
struct FinishGateUp {
  Normed normed;
  byte* hidden;
  using Factors = Normed::Factors;
  __device__ __forceinline__ Factors factors(Item i) const { return normed.of(i); }
  __device__ __forceinline__ void apply(Item i, Factors f, float2 sum) const {
    float unit = 0;
    if (i.valid) {
      const float2 v = normed.apply(i, f, sum);
#if TP_SILU
      unit = silu(v.x) * v.y;
#else
      const float inner = 0.7978845608028654f * (v.x + 0.044715f * v.x * v.x * v.x);
      unit = __fdividef(v.x, 1 + exp2f(inner * (-2 * 1.4426950408889634f))) * v.y;  // GELU by tanh, times up
#endif
    }
    const float next = __shfl_xor_sync(~0u, unit, 1);
    if (i.valid && i.pair % 2 == 0) store_operand(hidden, i.token, i.tile * 4 + i.pair, unit, next);
  }
};

// x's new columns: kept, and given to the next norm.
struct Stream {
  const float* scale;  // the next norm's, [D]
  float *x, *squares;  // [T][D], [T][D_TILES]
  byte* stream;
  __device__ __forceinline__ void keep(Item i, float2 v, float2 by) const {
    float sum = v.x * v.x + v.y * v.y;
    sum += __shfl_xor_sync(~0u, sum, 1);
    sum += __shfl_xor_sync(~0u, sum, 2);
    if (!i.valid) return;
    const int column = i.tile * 8 + i.pair * 2;
    *(float2*)(x + i.token * D + column) = v;
    store_operand(stream, i.token, column, v.x * by.x, v.y * by.y);
    if (i.pair == 0) squares[i.token * D_TILES + i.tile] = sum;
  }
};

// out and down: a gated residual. x is the block's own.
struct FinishResidual {
  Stream into;
  const float* gate;
  struct Factors {
    float2 gate, scale, x;
  };
  __device__ __forceinline__ Factors factors(Item i) const {
    Factors f{};
    if (i.valid) {
      const int column = i.tile * 8 + i.pair * 2;
      f.gate = two(gate + column), f.scale = two(into.scale + column);
      f.x = __ldcg((const float2*)(into.x + i.token * D + column));
    }
    return f;
  }
  __device__ __forceinline__ void apply(Item i, Factors f, float2 sum) const {
    into.keep(i, make_float2(f.x.x + sum.x * f.gate.x, f.x.y + sum.y * f.gate.y), f.scale);
  }
};

// The mixed tokens: the MLP's last product and its bias, the stream of the first norm.
struct FinishMixed {
  Stream into;
  const float* bias;
  struct Factors {
    float2 bias, scale;
  };
  __device__ __forceinline__ Factors factors(Item i) const {
    Factors f{};
    if (i.valid) f.bias = two(bias + i.tile * 8 + i.pair * 2), f.scale = two(into.scale + i.tile * 8 + i.pair * 2);
    return f;
  }
  __device__ __forceinline__ void apply(Item i, Factors f, float2 sum) const {
    into.keep(i, make_float2(f.bias.x + sum.x, f.bias.y + sum.y), f.scale);
  }
};
