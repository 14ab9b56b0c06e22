// Attention of all query rows over the prefix's and the suffix's keys: a block takes 16 rows and one share of the keys.

constexpr float LOGIT_SCALE_LOG2 = 1.4426950408889634f;

struct Keys {
  const byte *prefix, *suffix;  // [rows][HD]
  int length;
  __device__ __forceinline__ uint4 load(int key, int column, bool there) const {
    uint4 v = make_uint4(0, 0, 0, 0);
    if (there && column < HD) {
      const byte* const row = key < length ? prefix + (long long)key * HD * 2 : suffix + (key - length) * HD * 2;
      v = load_shared_by_grid(row + column * 2);
    }
    return v;
  }
};

__device__ __forceinline__ void logits(const Args& args, float* smem, const Keys& keys, int row_tile, int begin, int count) {
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, g = lane / 4, t = lane % 4;
  constexpr int STEPS = (HD + 31) / 32;
  for (int tile = warp; tile * 8 < count; tile += WARPS) {
    float c[4] = {};
    uint4 k[STEPS], low[STEPS], high[STEPS];
#pragma unroll
    for (int i = 0; i < STEPS; ++i) {
      k[i] = keys.load(begin + tile * 8 + g, i * 32 + t * 8, tile * 8 + g < count);
      low[i] = high[i] = make_uint4(0, 0, 0, 0);
      const int row = row_tile * 16 + g;
      if (i * 32 + t * 8 < HD) {
        if (row < ROWS) low[i] = load_shared_by_grid(args.queries + (row * HD + i * 32 + t * 8) * 2);
        if (row + 8 < ROWS) high[i] = load_shared_by_grid(args.queries + ((row + 8) * HD + i * 32 + t * 8) * 2);
      }
    }
#pragma unroll
    for (int i = 0; i < STEPS; ++i) {
      mma(c, low[i].x, high[i].x, low[i].y, high[i].y, k[i].x, k[i].y);
      mma(c, low[i].z, high[i].z, low[i].w, high[i].w, k[i].z, k[i].w);
    }
    const float by = LOGIT_SCALE_LOG2 * args.logit_scale;
    float* const to = smem + S_WORK + g * LOGITS_ROW + tile * 8 + t * 2;
    *(float2*)to = make_float2(c[0] * by, c[1] * by);
    *(float2*)(to + 8 * LOGITS_ROW) = make_float2(c[2] * by, c[3] * by);
  }
}

// Weights 2^(logit - largest), rounded to bfloat16; largest and sum of a row go to the combination.
__device__ __forceinline__ void softmax(const Args& args, float* smem, int share, int count) {
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32;
  for (int row = warp; row < 16; row += WARPS) {
    const float* const from = smem + S_WORK + row * LOGITS_ROW;
    unsigned short* const to = (unsigned short*)(smem + S_WEIGHTS + row * WEIGHTS_ROW);
    float top = -infinity(), sum = 0;
    for (int key = lane; key < count; key += 32) top = fmaxf(top, from[key]);
#pragma unroll
    for (int by = 16; by; by /= 2) top = fmaxf(top, __shfl_xor_sync(~0u, top, by));
    for (int key = lane; key < (count + 15) / 16 * 16; key += 32) {
      const u32 weight = key < count ? pack(exp2f(from[key] - top), 0) : 0;
      to[key] = weight, sum += low_of(weight);
    }
#pragma unroll
    for (int by = 16; by; by /= 2) sum += __shfl_xor_sync(~0u, sum, by);
    if (lane == 0) *(float2*)(args.tops + (share * 16 + row) * 2) = make_float2(top, sum);
  }
}

// A warp weighs 64 columns of its key group's values. Column n of mma's tile j is column 8 n + j: a lane's 16 bytes.
__device__ __forceinline__ void weigh(float* smem, const Keys& values, int begin, int count) {
  const int warp = threadIdx.x / 32, lane = threadIdx.x % 32, g = lane / 4, t = lane % 4;
  const int dims = warp % DIM_GROUPS * 64, group = warp / DIM_GROUPS;
  if (group >= KEY_GROUPS) return;
  float c[8][4] = {};
#pragma unroll 2
  for (int step = group; step * 16 < count; step += KEY_GROUPS) {
    union Row {
      uint4 all;
      u32 of[4];
    } rows[4];
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const int key = step * 16 + t * 2 + i % 2 + i / 2 * 8;
      rows[i].all = values.load(begin + key, dims + g * 8, key < count);
    }
    const u32* const weights = (const u32*)(smem + S_WEIGHTS) + g * WEIGHTS_ROW + step * 8 + t;
    const u32 a0 = weights[0], a1 = weights[8 * WEIGHTS_ROW], a2 = weights[4], a3 = weights[8 * WEIGHTS_ROW + 4];
#pragma unroll
    for (int j = 0; j < 8; ++j) {
      const u32 half = j % 2 ? 0x7632 : 0x5410;
      mma(c[j], a0, a1, a2, a3, __byte_perm(rows[0].of[j / 2], rows[1].of[j / 2], half),
          __byte_perm(rows[2].of[j / 2], rows[3].of[j / 2], half));
    }
  }
  float* const to = smem + S_OUT + (group * 16 + g) * OUT_ROW;
#pragma unroll
  for (int j = 0; j < 16; j += 4) {
    const int column = dims + (2 * t + j / 8) * 8 + j % 8, i = j / 8;
    if (column >= HD) continue;
    *(float4*)(to + column) = make_float4(c[j % 8][i], c[j % 8 + 1][i], c[j % 8 + 2][i], c[j % 8 + 3][i]);
    *(float4*)(to + 8 * OUT_ROW + column) =
        make_float4(c[j % 8][i + 2], c[j % 8 + 1][i + 2], c[j % 8 + 2][i + 2], c[j % 8 + 3][i + 2]);
  }
}

__device__ __forceinline__ void attend(const Args& args, float* smem, int layer, int length) {
  const Keys keys{args.cache_k + layer * args.layer_stride, args.keys, length};
  const Keys values{args.cache_v + layer * args.layer_stride, args.values, length};
  const int total = length + T, share_keys = ((total + 7) / 8 + SPLITS - 1) / SPLITS * 8;
  for (int share = blockIdx.x; share < ROW_TILES * SPLITS; share += BLOCKS) {
    const int begin = share % SPLITS * share_keys, count = max(min(total - begin, share_keys), 0);
    logits(args, smem, keys, share / SPLITS, begin, count);
    __syncthreads();
    softmax(args, smem, share, count);
    __syncthreads();
    weigh(smem, values, begin, count);
    __syncthreads();
    for (int i = threadIdx.x; i < 16 * HD / 4; i += THREADS) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll
      for (int group = 0; group < KEY_GROUPS; ++group) {
        const float4 v = *(const float4*)(smem + S_OUT + (group * 16 + i / (HD / 4)) * OUT_ROW + i % (HD / 4) * 4);
        sum.x += v.x, sum.y += v.y, sum.z += v.z, sum.w += v.w;
      }
      *(float4*)(args.partial + share * 16 * HD + i * 4) = sum;
    }
    __syncthreads();  // before the next share takes the room
  }
}

// All shares of a row: a lane has two columns of it.
__device__ __forceinline__ void combine(const Args& args, float attended_times) {
  constexpr int TOGETHER = SPLITS < 16 ? SPLITS : 16;
  for (int task = threadIdx.x / 32 * BLOCKS + blockIdx.x; task * 64 < ROWS * HD; task += WARPS * BLOCKS) {
    const int at = task * 64 + threadIdx.x % 32 * 2, row = at / HD, column = at % HD;
    if (at >= ROWS * HD) continue;
    float top = -infinity(), sum = 0;
    float2 out = make_float2(0, 0);
    for (int first = 0; first < SPLITS; first += TOGETHER) {
      float2 tops[TOGETHER], parts[TOGETHER];
#pragma unroll
      for (int i = 0; i < TOGETHER; ++i) {
        const int share = row / 16 * SPLITS + first + i;
        tops[i] = make_float2(-infinity(), 0), parts[i] = make_float2(0, 0);
        if (first + i < SPLITS) {
          tops[i] = __ldcg((const float2*)(args.tops + (share * 16 + row % 16) * 2));
          parts[i] = __ldcg((const float2*)(args.partial + (share * 16 + row % 16) * HD + column));
        }
      }
      float highest = top;
#pragma unroll
      for (int i = 0; i < TOGETHER; ++i) highest = fmaxf(highest, tops[i].x);
      const float old = top == highest ? 1 : exp2f(top - highest);
      top = highest, sum *= old, out = out * old;
#pragma unroll
      for (int i = 0; i < TOGETHER; ++i) {
        const float by = tops[i].y == 0 ? 0 : exp2f(tops[i].x - highest);  // an empty share has no largest logit
        sum += by * tops[i].y, out.x += by * parts[i].x, out.y += by * parts[i].y;
      }
    }
    const float by = attended_times / sum;
    store_operand(args.attended, row / HEADS, row % HEADS * HD + column, out.x * by, out.y * by);
  }
}
