// Attention of all query rows over the prefix's and the suffix's keys: a block takes 16 rows and one share of the keys.

// What a warp reads first of its share: asked for before the barrier, as far as it is the prefix's. The rest, of the
// suffix, comes behind it.
struct First {
  uint4 keys[LOGIT_STEPS], values[4];
};
__device__ __forceinline__ int key_of(int thread, int tile) { return tile * 8 + thread % 32 / 4; }
__device__ __forceinline__ int value_of(int thread, int step, int i) { return step * 16 + thread % 4 * 2 + i % 2 + i / 2 * 8; }
__device__ __forceinline__ int value_column(int thread) { return thread / 32 % DIM_GROUPS * 64 + thread % 32 / 4 * 8; }

template <bool PREFIX>
__device__ __forceinline__ void ask_first(int thread, First& first, const Keys& keys, const Keys& values, int begin, int count) {
  const int group = thread / 32 / DIM_GROUPS;
  const int key = key_of(thread, thread / 32);
  if (PREFIX || (begin + key >= keys.length && key < count))
#pragma unroll
    for (int i = 0; i < LOGIT_STEPS; ++i)
      first.keys[i] = keys.load(begin + key, i * 32 + thread % 4 * 8, key < count && (!PREFIX || begin + key < keys.length));
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const int at = value_of(thread, group, i);
    if (PREFIX || (begin + at >= keys.length && at < count))
      first.values[i] = values.load(begin + at, value_column(thread), at < count && (!PREFIX || begin + at < keys.length));
  }
}

// The queries of a row tile, to shared memory.
__device__ __forceinline__ void take_queries(int thread, const Args& args, float* smem, int row_tile) {
  const int first = row_tile % HEAD_ROW_TILES * 16, of_head = row_tile / HEAD_ROW_TILES * ROWS;
  for (int i = thread; i < 16 * HD / 8; i += THREADS) {
    const int row = i / (HD / 8), at = i % (HD / 8);
    uint4 v = make_uint4(0, 0, 0, 0);
    if (first + row < ROWS) v = load_shared_by_grid(args.queries + ((of_head + first + row) * HD + at * 8) * 2);
    *(uint4*)(smem + S_QUERIES + row * QUERIES_ROW + at * 4) = v;
  }
}

__device__ __forceinline__ void logits(int thread, const Args& args, float* smem, const First& first, const Keys& keys, int begin,
                                       int count) {
  const int warp = thread / 32, lane = thread % 32, g = lane / 4, t = lane % 4;
  const float* const queries = smem + S_QUERIES + g * QUERIES_ROW + t * 4;
  auto multiply = [&](int tile, const uint4(&k)[LOGIT_STEPS]) {
    float c[4] = {};
#pragma unroll
    for (int i = 0; i < LOGIT_STEPS; ++i) {
      uint4 low = make_uint4(0, 0, 0, 0), high = low;
      if (i * 32 + t * 8 < HD) {
        low = *(const uint4*)(queries + i * 16), high = *(const uint4*)(queries + i * 16 + 8 * QUERIES_ROW);
      }
      mma(c, low.x, high.x, low.y, high.y, k[i].x, k[i].y);
      mma(c, low.z, high.z, low.w, high.w, k[i].z, k[i].w);
    }
    const float by = LOG2_E * args.logit_scale;
    float* const to = smem + S_WORK + g * LOGITS_ROW + tile * 8 + t * 2;
    *(float2*)to = make_float2(c[0] * by, c[1] * by);
    *(float2*)(to + 8 * LOGITS_ROW) = make_float2(c[2] * by, c[3] * by);
  };
  if (warp * 8 < count) multiply(warp, first.keys);
#pragma unroll 1
  for (int tile = warp + WARPS; tile * 8 < count; tile += WARPS) {
    uint4 k[LOGIT_STEPS];
#pragma unroll
    for (int i = 0; i < LOGIT_STEPS; ++i)
      k[i] = keys.load(begin + key_of(thread, tile), i * 32 + t * 8, key_of(thread, tile) < count);
    multiply(tile, k);
  }
}

// Weights 2^(logit - largest), rounded to bfloat16; largest and sum of a row go to the combination, of one share alone the
// sum to S_RMS. own: how many of the share's keys are before the suffix's first.
__device__ __forceinline__ void softmax(int thread, const Args& args, float* smem, int share, int count, int own) {
  const int warp = thread / 32, lane = thread % 32;
  for (int row = warp; row < 16; row += WARPS) {
    const float* const from = smem + S_WORK + row * LOGITS_ROW;
    unsigned short* const to = (unsigned short*)(smem + S_WEIGHTS + row * WEIGHTS_ROW);
    float top = -infinity(), sum = 0;
    const int token = (share / SPLITS % HEAD_ROW_TILES * 16 + row) / GROUP;
    const int seen = CAUSAL ? max(min(count, own + token + 1), 0) : count;
    for (int key = lane; key < seen; key += 32) top = fmaxf(top, from[key]);
#pragma unroll
    for (int by = 16; by; by /= 2) top = fmaxf(top, __shfl_xor_sync(~0u, top, by));
    for (int key = lane; key < (count + 15) / 16 * 16; key += 32) {
      const u32 weight = key < seen ? pack(exp2f(from[key] - top), 0) : 0;
      to[key] = weight, sum += low_of(weight);
    }
#pragma unroll
    for (int by = 16; by; by /= 2) sum += __shfl_xor_sync(~0u, sum, by);
    if (lane > 0) continue;
    if (COMBINES)
      *(float2*)(args.tops + (share * 16 + row) * 2) = make_float2(top, sum);
    else
      smem[S_RMS + row] = sum;
  }
}

// A warp weighs 64 columns of its key group's values. Column n of mma's tile j is column 8 n + j: a lane's 16 bytes.
__device__ __forceinline__ void weigh(int thread, float* smem, const First& first, const Keys& values, int begin, int count) {
  const int warp = thread / 32, lane = thread % 32, g = lane / 4, t = lane % 4;
  const int dims = warp % DIM_GROUPS * 64, group = warp / DIM_GROUPS;
  if (group >= KEY_GROUPS) return;
  float c[8][4] = {};
  union Row {
    uint4 all;
    u32 of[4];
  };
  auto multiply = [&](int step, const Row(&rows)[4]) {
    const u32* const weights = (const u32*)(smem + S_WEIGHTS) + g * WEIGHTS_ROW + step * 8 + t;
    const u32 a0 = weights[0], a1 = weights[8 * WEIGHTS_ROW], a2 = weights[4], a3 = weights[8 * WEIGHTS_ROW + 4];
#pragma unroll
    for (int j = 0; j < 8; ++j) {
      const u32 half = j % 2 ? 0x7632 : 0x5410;
      mma(c[j], a0, a1, a2, a3, __byte_perm(rows[0].of[j / 2], rows[1].of[j / 2], half),
          __byte_perm(rows[2].of[j / 2], rows[3].of[j / 2], half));
    }
  };
  Row rows[4];
  if (group * 16 < count) {
#pragma unroll
    for (int i = 0; i < 4; ++i) rows[i].all = first.values[i];
    multiply(group, rows);
  }
#pragma unroll(WARPS > 8 ? 1 : 3)
  for (int step = group + KEY_GROUPS; step * 16 < count; step += KEY_GROUPS) {
#pragma unroll
    for (int i = 0; i < 4; ++i) rows[i].all = values.load(begin + value_of(thread, step, i), value_column(thread), value_of(thread, step, i) < count);
    multiply(step, rows);
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

// attended_times: where a row has one share, it leaves as `combine` would have it leave.
__device__ __forceinline__ void attend(Grid& grid, const Args& args, float* smem, int layer, int length, float attended_times) {
  int thread = thread_of_phase();
  Keys keys{args.cache_k + layer * args.layer_stride, args.keys, length};
  Keys values{args.cache_v + layer * args.layer_stride, args.values, length};
  const int total = is_self(layer) ? length + T : length, share_keys = ((total + 7) / 8 + SPLITS - 1) / SPLITS * 8;
  auto take_head = [&](int share) {  // whose keys and values a share has
    if (KV_HEADS == 1) return;
    const int head = min(share / SPLITS / HEAD_ROW_TILES, KV_HEADS - 1);
    const long long at = layer * args.layer_stride + head * HEAD_STRIDE;
    keys.prefix = args.cache_k + at, values.prefix = args.cache_v + at;
    keys.suffix = args.keys + head * T * HD * 2, values.suffix = args.values + head * T * HD * 2;
  };
  First first;
  auto begin_of = [&](int share) { return share % SPLITS * share_keys; };
  auto count_of = [&](int share) {
    return share < ROW_TILES * SPLITS ? max(min(total - begin_of(share), share_keys), 0) : 0;
  };
  // Where a block has one share at most, nothing is kept for a next one. On 9.0 the loop is as it was timed.
#if __CUDA_ARCH__ == 900
  constexpr bool NEXT = true;
#else
  constexpr bool NEXT = ROW_TILES * SPLITS > BLOCKS;
#endif
  const int block = block_of_phase();
  int share = block;
  take_head(share);
  ask_first<true>(thread, first, keys, values, begin_of(share), count_of(share));
  grid.wait();
  for (; share < ROW_TILES * SPLITS; share += BLOCKS) {
    if (ROW_TILES * SPLITS > BLOCKS) thread = of_phase(thread);
    const int begin = begin_of(share), count = count_of(share);
    if (NEXT && share != block) {
      take_head(share);
      ask_first<true>(thread, first, keys, values, begin, count);
    }
    ask_first<false>(thread, first, keys, values, begin, count);
    take_queries(thread, args, smem, share / SPLITS);
    __syncthreads();
    logits(thread, args, smem, first, keys, begin, count);
    __syncthreads();
    softmax(thread, args, smem, share, count, length - begin);
    __syncthreads();
    weigh(thread, smem, first, values, begin, count);
    __syncthreads();
    for (int i = thread; i < 16 * HD / 4; i += THREADS) {
      float4 sum = make_float4(0, 0, 0, 0);
#pragma unroll
      for (int group = 0; group < KEY_GROUPS; ++group) {
        const float4 v = *(const float4*)(smem + S_OUT + (group * 16 + i / (HD / 4)) * OUT_ROW + i % (HD / 4) * 4);
        sum.x += v.x, sum.y += v.y, sum.z += v.z, sum.w += v.w;
      }
      if (COMBINES) {
        *(float4*)(args.partial + share * 16 * HD + i * 4) = sum;
        continue;
      }
      const int row = share % HEAD_ROW_TILES * 16 + i / (HD / 4), head = share / HEAD_ROW_TILES * GROUP + row % GROUP;
      if (row >= ROWS) continue;
      const float by = attended_times / smem[S_RMS + i / (HD / 4)];
      const int column = head * HD + i % (HD / 4) * 4;
      store_operand(args.attended, row / GROUP, column, sum.x * by, sum.y * by);
      store_operand(args.attended, row / GROUP, column + 2, sum.z * by, sum.w * by);
    }
    if (!NEXT) break;
    __syncthreads();  // before the next share takes the room
  }
}

// All shares of a row: a lane has two columns of it.
__device__ __forceinline__ void combine(const Args& args, float attended_times) {
  const int thread = thread_of_phase();
  constexpr int TOGETHER = SPLITS < 16 ? SPLITS : 16;
  for (int task = thread / 32 * BLOCKS + block_of_phase(); task * 64 < KV_HEADS * ROWS * HD; task += WARPS * BLOCKS) {
    const int at = task * 64 + thread % 32 * 2, all = at / HD, column = at % HD, of_head = all / ROWS, row = all % ROWS;
    if (at >= KV_HEADS * ROWS * HD) continue;
    float top = -infinity(), sum = 0;
    float2 out = make_float2(0, 0);
    for (int first = 0; first < SPLITS; first += TOGETHER) {
      float2 tops[TOGETHER], parts[TOGETHER];
#pragma unroll
      for (int i = 0; i < TOGETHER; ++i) {
        const int share = (of_head * HEAD_ROW_TILES + row / 16) * SPLITS + first + i;
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
    store_operand(args.attended, row / GROUP, (of_head * GROUP + row % GROUP) * HD + column, out.x * by, out.y * by);
  }
}
