// Attention of narrow heads, where a block has all keys of its rows: 8 rows of queries. A warp takes 16 keys (or several
// times so many) from their logits to their weighted values in registers; only then do warps meet, and what they found is
// combined as shares of the keys are.

constexpr float LOG2_E = 1.4426950408889634f;
constexpr int LOGIT_STEPS = (HD + 31) / 32;  // 32 columns each

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

constexpr int EIGHTS = (ROWS + 7) / 8;  // of a head's rows
constexpr int WARP_STEPS = (SPLIT_KEYS / 16 + WARPS - 1) / WARPS;
constexpr int PART_ROW = 80;  // words: 64 columns; two rows in different banks
constexpr int S_PART_TOPS = S_WORK + WARPS * 8 * PART_ROW;  // [warp][8 rows] largest logit, sum of weights
static_assert(!BY_WARPS || (HD <= 64 && !COMBINES && (WARPS & (WARPS - 1)) == 0 && WARPS <= 32), "heads or shares");
static_assert(!BY_WARPS || (S_PART_TOPS + WARPS * 16) * 4 <= TP_SHARED_BYTES, "too little shared memory");

template <int STEPS>
struct OfWarp {  // of a lane: keys g and g + 8 of 16; of values keys 2 t, + 1, + 8, + 9
  uint4 keys[STEPS][2][LOGIT_STEPS], values[STEPS][4];
};

// Those of the prefix (the others are zeros), before the barrier; then those of the suffix.
template <bool PREFIX, int STEPS>
__device__ __forceinline__ void ask_of_warp(int thread, OfWarp<STEPS>& of, const Keys& keys, const Keys& values, int count) {
  const int g = thread % 32 / 4, t = thread % 4;
#pragma unroll
  for (int n = 0; n < STEPS; ++n) {
    const int first = (thread / 32 + n * WARPS) * 16;
    if (!PREFIX && (first + 16 <= keys.length || first >= count)) continue;
    const byte* const from_keys = PREFIX ? keys.prefix : keys.suffix - keys.length * HD * 2;
    const byte* const from_values = PREFIX ? values.prefix : values.suffix - keys.length * HD * 2;
    auto there = [&](int key) { return PREFIX ? key < min(keys.length, count) : key >= keys.length && key < count; };
#pragma unroll
    for (int half = 0; half < 2; ++half)
#pragma unroll
      for (int i = 0; i < LOGIT_STEPS; ++i) {
        const int key = first + half * 8 + g, column = i * 32 + t * 8;
        if (PREFIX) of.keys[n][half][i] = make_uint4(0, 0, 0, 0);
        if (there(key) && column < HD) of.keys[n][half][i] = load_shared_by_grid(from_keys + (key * HD + column) * 2);
      }
#pragma unroll
    for (int i = 0; i < 4; ++i) {
      const int key = first + t * 2 + i % 2 + i / 2 * 8;
      if (PREFIX) of.values[n][i] = make_uint4(0, 0, 0, 0);
      if (there(key) && g * 8 < HD) of.values[n][i] = load_shared_by_grid(from_values + (key * HD + g * 8) * 2);
    }
  }
}

// A warp's keys, for 8 rows: weighted values, largest logits and sums to shared memory.
template <int STEPS>
__device__ __forceinline__ void weigh_of_warp(int thread, float by, float* smem, const OfWarp<STEPS>& of,
                                              const uint4 (&queries)[LOGIT_STEPS], int seen) {
  const int warp = thread / 32, g = thread % 32 / 4, t = thread % 4;
  float c[STEPS][2][4] = {}, top = -infinity(), sum = 0;
#pragma unroll
  for (int n = 0; n < STEPS; ++n)
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      float(&here)[4] = c[n][half];
#pragma unroll
      for (int i = 0; i < LOGIT_STEPS; ++i) {
        const uint4 k = of.keys[n][half][i];
        mma(here, queries[i].x, 0, queries[i].y, 0, k.x, k.y);
        mma(here, queries[i].z, 0, queries[i].w, 0, k.z, k.w);
      }
#pragma unroll
      for (int i = 0; i < 2; ++i) {
        const int key = (warp + n * WARPS) * 16 + half * 8 + t * 2 + i;
        here[i] = key < seen ? here[i] * by : -infinity();
        top = fmaxf(top, here[i]);
      }
    }
  top = fmaxf(top, __shfl_xor_sync(~0u, top, 1));
  top = fmaxf(top, __shfl_xor_sync(~0u, top, 2));
  const float from = top == -infinity() ? 0 : top;  // of no key that is seen all weights are 0
  float out[8][4] = {};
#pragma unroll
  for (int n = 0; n < STEPS; ++n) {
    u32 weights[2];
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      weights[half] = pack(exp2f(c[n][half][0] - from), exp2f(c[n][half][1] - from));
      sum += low_of(weights[half]) + high_of(weights[half]);
    }
    const uint4(&v)[4] = of.values[n];
#pragma unroll
    for (int j = 0; j < 8; ++j) {  // column n of mma's tile j is column 8 n + j
      const u32 half = j % 2 ? 0x7632 : 0x5410;
      auto word = [&](const uint4& row) { return j / 2 == 0 ? row.x : j / 2 == 1 ? row.y : j / 2 == 2 ? row.z : row.w; };
      mma(out[j], weights[0], 0, weights[1], 0, __byte_perm(word(v[0]), word(v[1]), half),
          __byte_perm(word(v[2]), word(v[3]), half));
    }
  }
  sum += __shfl_xor_sync(~0u, sum, 1);
  sum += __shfl_xor_sync(~0u, sum, 2);
  float* const to = smem + S_WORK + (warp * 8 + g) * PART_ROW + t * 4;
#pragma unroll
  for (int k = 0; k < 4; ++k) {  // columns (2 t + k / 2) * 8 + k % 2 * 4 and three more
    const int j = k % 2 * 4, i = k / 2;
    *(float4*)(to + k * 16) = make_float4(out[j][i], out[j + 1][i], out[j + 2][i], out[j + 3][i]);
  }
  if (t == 0) *(float2*)(smem + S_PART_TOPS + (warp * 8 + g) * 2) = make_float2(top, sum);
}

struct Row {
  int token, head;
  bool valid;
};

// All warps' parts of 8 rows, to `attended`. A warp has one row at a time. row_of: its number among the 8 -> Row
template <class RowOf>
__device__ __forceinline__ void combine_warps(int thread, const Args& args, const float* smem, float attended_times, RowOf row_of) {
  const int lane = thread % 32;
#pragma unroll
  for (int first = 0; first < 8 * 64; first += THREADS) {
    if (8 * 64 % THREADS && first + thread / 32 * 32 >= 8 * 64) break;
    const int at = first + thread, tile_row = at / 64, place = at % 64;
    float part[WARPS];
#pragma unroll
    for (int w = 0; w < WARPS; ++w) part[w] = smem[S_WORK + (w * 8 + tile_row) * PART_ROW + place];
    const float2 mine = *(const float2*)(smem + S_PART_TOPS + (lane % WARPS * 8 + tile_row) * 2);
    float top = mine.x;
#pragma unroll
    for (int by = WARPS / 2; by; by /= 2) top = fmaxf(top, __shfl_xor_sync(~0u, top, by));
    const float weight = mine.y == 0 ? 0 : exp2f(mine.x - top);
    float sum = mine.y * weight, out = 0;
#pragma unroll
    for (int by = WARPS / 2; by; by /= 2) sum += __shfl_xor_sync(~0u, sum, by);
#pragma unroll
    for (int w = 0; w < WARPS; ++w) out += part[w] * __shfl_sync(~0u, weight, w);
    out *= attended_times / sum;
    const float next = __shfl_xor_sync(~0u, out, 1);
    const Row row = row_of(tile_row);
    const int column = (place % 16 / 4 * 2 + place / 32) * 8 + place / 16 % 2 * 4 + place % 4;
    if (place % 2 == 0 && row.valid && column < HD) store_operand(args.attended, row.token, row.head * HD + column, out, next);
  }
}

// One block's rows, where what it needs of the prefix is asked for already.
__device__ __forceinline__ void attend_eight(const Args& args, float* smem, OfWarp<WARP_STEPS>& of, Keys keys, Keys values, int eight,
                                             int count, int length, float attended_times) {
  const int thread = thread_of_phase();
  const int row = eight % EIGHTS * 8 + thread % 32 / 4;
  uint4 queries[LOGIT_STEPS];
#pragma unroll
  for (int i = 0; i < LOGIT_STEPS; ++i) {
    const int column = i * 32 + thread % 4 * 8;
    queries[i] = make_uint4(0, 0, 0, 0);
    if (row < ROWS && column < HD)
      queries[i] = load_shared_by_grid(args.queries + ((eight / EIGHTS * ROWS + row) * HD + column) * 2);
  }
  ask_of_warp<false>(thread, of, keys, values, count);
  const int seen = CAUSAL ? min(count, length + row / GROUP + 1) : count;
  weigh_of_warp(thread, LOG2_E * args.logit_scale, smem, of, queries, seen);
  __syncthreads();
  combine_warps(thread, args, smem, attended_times, [&](int of_eight) {
    const int at = eight % EIGHTS * 8 + of_eight;
    return Row{at / GROUP, eight / EIGHTS * GROUP + at % GROUP, at < ROWS};
  });
}

__device__ __forceinline__ void attend_by_warps(Grid& grid, const Args& args, float* smem, int layer, int length, float attended_times) {
  const int thread = thread_of_phase(), block = block_of_phase(), total = is_self(layer) ? length + T : length;
  auto of_head = [&](int eight, const byte* cache, const byte* suffix) {
    const int head = KV_HEADS > 1 ? min(eight / EIGHTS, KV_HEADS - 1) : 0;
    return Keys{cache + layer * args.layer_stride + head * HEAD_STRIDE, suffix + head * T * HD * 2, length};
  };
  Keys keys = of_head(block, args.cache_k, args.keys), values = of_head(block, args.cache_v, args.values);
  OfWarp<WARP_STEPS> of;
  ask_of_warp<true>(thread, of, keys, values, block < KV_HEADS * EIGHTS ? total : 0);
  grid.wait();
  for (int eight = block; eight < KV_HEADS * EIGHTS; eight += BLOCKS) {
    if (KV_HEADS * EIGHTS > BLOCKS && eight != block) {
      __syncthreads();  // the parts before have been read
      keys = of_head(eight, args.cache_k, args.keys), values = of_head(eight, args.cache_v, args.values);
      ask_of_warp<true>(thread, of, keys, values, total);
    }
    attend_eight(args, smem, of, keys, values, eight, total, length, attended_times);
  }
}

// A layer across in one phase: a block makes a head's queries for up to 8 tokens, and attends with them. Of other blocks it
// needs what q|k|v needs, the stream and its squares: keys and values are the prefix's. A warp has 16 of them at most.
constexpr int S_HEAD_QUERIES = larger(S_PART_TOPS + WARPS * 16, S_WORK + QueriesShape::SUM_WORDS);  // [8][QUERIES_ROW]
static_assert(!ACROSS_AT_ONCE || (BY_WARPS && QueriesShape::PARTIES * QueriesShape::RANGES <= BLOCKS), "blocks");
static_assert(!ACROSS_AT_ONCE || (S_HEAD_QUERIES + 8 * QUERIES_ROW) * 4 <= TP_SHARED_BYTES, "too little shared memory");

__device__ __forceinline__ void attend_across(Grid& grid, const Args& args, float* smem, int layer, int length,
                                              const byte* weights, const Normed& normed, float attended_times) {
  Product<QueriesShape> product(weights);
  product.ask();
  const bool busy = product.first < product.end;
  const int head = min(product.first / FinishQueries::HEAD_TILES, HEADS - 1);
  const long long at = layer * args.layer_stride + head / GROUP * HEAD_STRIDE;
  const Keys keys{args.cache_k + at, nullptr, length}, values{args.cache_v + at, nullptr, length};
  OfWarp<1> of;
  ask_of_warp<true>(product.thread, of, keys, values, busy ? length : 0);
  unsigned short* const made = (unsigned short*)(smem + S_HEAD_QUERIES);
  FinishQueries finish{{normed, (const float2*)args.rope + T * HD / 2}, made, product.from()};
  InverseRms<QueriesShape> inverse_rms{args, smem};
  product.run(grid, smem, args.stream, finish, inverse_rms);
  if (!busy) return;
  __syncthreads();
  const int thread = thread_of_phase(), g = thread % 32 / 4, from = product.from(), tokens = min(T - from, QueriesShape::RANGE);
  uint4 queries[LOGIT_STEPS];
#pragma unroll
  for (int i = 0; i < LOGIT_STEPS; ++i) {
    queries[i] = make_uint4(0, 0, 0, 0);
    if (g < tokens && i * 32 + thread % 4 * 8 < HD)
      queries[i] = *(const uint4*)(smem + S_HEAD_QUERIES + g * QUERIES_ROW + i * 16 + thread % 4 * 4);
  }
  weigh_of_warp(thread, LOG2_E * args.logit_scale, smem, of, queries, length);
  __syncthreads();
  combine_warps(thread, args, smem, attended_times, [&](int row) { return Row{from + row, head, row < tokens}; });
}
