// The loop over steps and layers.
//
// Every barrier: tests/test_kernels_barriers.py reads these tables and the code, and fails where they differ.
//
// The grid's barrier (`Grid` in primitives.cu) is one counter: each of BLOCKS blocks arrives once behind a phase, and goes on
// when all have. What stands between `arrive` and `wait` depends on no other block. `product.run` and `attend` wait inside,
// when they have asked for weights, or keys.
//
// in a step, in this order: what the phase does, and what its wait protects
//
// embed: embed; arrive
//   guards   x_t, which the end of the step before waits for; the stream and its squares, which gate|up has read; hidden,
//            which down has read
// mix: product.run; arrive
//   guards   hidden. Where the time is mixed into the tokens
// qkv: attend_across; arrive; product.run; arrive
//   guards   stream and squares, of embed or down. Across at once, `attend_across` is this phase and the next one: it waits in
//            its product, and arrives for both
// attention: attend; arrive
//   guards   queries, keys, values. Of narrow heads `attend_by_warps`, which waits as `attend` does
// combine: wait; combine; arrive
//   guards   partial, tops. Where a row has several shares of the keys
// out: product.run; arrive
//   guards   attended; the stream, which q|k|v has read
// gate_up: product.run; arrive
//   guards   stream and squares, of out
// down: product.run; arrive
//   guards   hidden; the stream, which gate|up has read
// advance: wait; advance; arrive; wait
//   guards   x and squares, of the last layer's down; then x_t
//
// of a block's warps (__syncthreads): how often in which function
//
// Grid::arrive: 1
//   guards   all warps' stores, before thread 0 releases them
// Grid::wait: 1
//   guards   no warp reads before thread 0 has seen all arrivals
// Product::run: 2
//   guards   sums in S_WORK: read before the next pass writes; written before they are added up, and S_RMS with them
// attend: 5
//   guards   S_QUERIES; logits; S_WEIGHTS; S_OUT; all of them, before the next share
// attend_eight: 1
//   guards   parts of warps, and what they found: written before they are put together
// attend_by_warps: 1
//   guards   the same, before the next rows
// attend_across: 2
//   guards   S_HEAD_QUERIES, and the product's sums, whose room parts take; parts, as above

// action_in_proj of x_t, and the stream of the first norm: each block the columns that it keeps. Where the time is mixed
// into the tokens, the hidden units of that MLP: its first matrix is multiplied with action_in_proj already.
__device__ __forceinline__ void embed(const Args& args, const Stream& into, const float* x_t, const float* bias) {
  const Product<EmbedShape> mine(args.weights);
  const int tiles = mine.end - mine.first, lane = threadIdx.x % 32;
  for (int index = threadIdx.x; index - lane < tiles * T * 4; index += THREADS) {
    Item i{mine.first + index / (4 * T), index / 4 % T, index % 4, index < tiles * T * 4};
    float2 v = make_float2(0, 0), by = v;
    if (i.valid) {
      const int column = i.tile * 8 + i.pair * 2;
      v = two(bias + column), by = two(into.scale + column);
      constexpr int AT_ONCE = MODULATED || A % 16 ? 1 : 16;  // loads on their way
      for (int first = 0; first < A; first += AT_ONCE) {
        alignas(16) float x[AT_ONCE];
        float2 w[AT_ONCE];
#pragma unroll
        for (int a = 0; a < AT_ONCE; ++a) w[a] = two(args.in_w + (first + a) * D + column);
#pragma unroll
        for (int a = 0; a < AT_ONCE; ++a)
          if (AT_ONCE == 1)
            x[a] = __ldcg(x_t + i.token * A + first);
          else if (a % 4 == 0)
            *(float4*)(x + a) = __ldcg((const float4*)(x_t + i.token * A + first + a));
#pragma unroll
        for (int a = 0; a < AT_ONCE; ++a) v.x += x[a] * w[a].x, v.y += x[a] * w[a].y;
      }
    }
    if (MODULATED)
      into.keep(i, v, by);
    else if (i.valid)
      store_operand(args.hidden, i.token, i.tile * 8 + i.pair * 2, silu(v.x), silu(v.y));
  }
  // The last chunk's columns behind D hold what down has read. Their weights are zeros, but zero times NaN isn't
  constexpr int BEHIND = (CHUNK - D % CHUNK) % CHUNK / 2;
  if (!MODULATED && BEHIND)
    for (int at = blockIdx.x * THREADS + threadIdx.x; at < T * BEHIND; at += BLOCKS * THREADS)
      store_operand(args.hidden, at / larger(BEHIND, 1), D + at % larger(BEHIND, 1) * 2, 0, 0);
}

// Final norm, action_out_proj and the Euler step: a warp takes one number of a token.
__device__ __forceinline__ void advance(const Args& args, const float* scale, int step) {
  const int thread = thread_of_phase(), lane = thread % 32;
  for (int task = thread / 32 * BLOCKS + blockIdx.x; task < T * A; task += WARPS * BLOCKS) {
    const int token = task / A, a = task % A;
    float sum = 0, squares = 0;
    if (MODULATED) {
#pragma unroll 8
      for (int column = lane * 2; column < D; column += 64) {
        const float2 x = __ldcg((const float2*)(args.x + token * D + column));
        const float2 w = two(args.out_w + a * D + column), s = two(scale + column);
        squares += x.x * x.x + x.y * x.y, sum += x.x * s.x * w.x + x.y * s.y * w.y;
      }
    } else {
      constexpr int ROUNDS = (D + 63) / 64, AT_ONCE = divisor(ROUNDS, 8);
#pragma unroll 1
      for (int first = 0; first < ROUNDS; first += AT_ONCE) {
        float2 x[AT_ONCE], w[AT_ONCE], s[AT_ONCE];
#pragma unroll
        for (int i = 0; i < AT_ONCE; ++i) {
          const int column = (first + i) * 64 + lane * 2;
          x[i] = w[i] = s[i] = make_float2(0, 0);
          if (column < D) {
            x[i] = __ldcg((const float2*)(args.x + token * D + column));
            w[i] = two(args.out_w + a * D + column), s[i] = two(scale + column);
          }
        }
#pragma unroll
        for (int i = 0; i < AT_ONCE; ++i)
          squares += x[i].x * x[i].x + x[i].y * x[i].y, sum += x[i].x * s[i].x * w[i].x + x[i].y * s[i].y * w[i].y;
      }
    }
#pragma unroll
    for (int by = 16; by; by /= 2)
      sum += __shfl_xor_sync(~0u, sum, by), squares += __shfl_xor_sync(~0u, squares, by);
    if (lane == 0) {
      const float v = sum * rsqrtf(squares / D + args.eps) + __ldg(args.out_shift + (MODULATED ? step * A : 0) + a);
      args.v_t[step * T * A + task] = v;
      // rounded after each operation, as PyTorch does
      args.x_t[(step + 1) * T * A + task] = __fadd_rn(__ldcg(args.x_t + step * T * A + task), __fmul_rn(args.dt, v));
    }
  }
}

// The prefix's keys and values of a layer, to L2.
__device__ __forceinline__ void cache_ahead(const Args& args, int layer, int length) {
  if (!TP_AHEAD) return;
  const long long bytes = KV_HEADS > 1 ? KV_HEADS * HEAD_STRIDE : (long long)length * HD * 2;
  for (long long at = (blockIdx.x * THREADS + threadIdx.x) * 128ll; at < 2 * bytes; at += BLOCKS * THREADS * 128ll)
    to_l2((at < bytes ? args.cache_k + at : args.cache_v + (at - bytes)) + layer * args.layer_stride);
}

// What is small and read once a step, by all blocks, to L2: layers' weights have driven it out.
__device__ __forceinline__ void ends_ahead(const float* from, int count) {
  if (MODULATED || !TP_AHEAD) return;
  for (int at = (blockIdx.x * THREADS + threadIdx.x) * 32; at < count; at += BLOCKS * THREADS * 32) to_l2(from + at);
}

// By how much attention's outputs are multiplied.
__device__ __forceinline__ float attended_times_of(const Args& args, int layer) {
  return FP8 ? __ldg(args.attended_times + layer) : 1.0f;
}

// In front of the loop: RoPE's tables of the suffix's positions, x_0, and the barrier's counter.
extern "C" __global__ void __launch_bounds__(256) turbopi_portable_denoise_prepare(const Args args) {
  const int at = blockIdx.x * 256 + threadIdx.x;
  if (at == 0) *args.counter = 0;
  if (at < T * A) args.x_t[at] = args.noise[at];
  if (at < T * HD / 2) {
    float sine, cosine;
    sincosf(float(*args.length + at / (HD / 2)) * args.inv_freq[at % (HD / 2)], &sine, &cosine);
    args.rope[at * 2] = cosine, args.rope[at * 2 + 1] = sine;
    if (ACROSS) {  // across, tokens count from 0
      sincosf(float(at / (HD / 2)) * args.inv_freq[at % (HD / 2)], &sine, &cosine);
      args.rope[T * HD + at * 2] = cosine, args.rope[T * HD + at * 2 + 1] = sine;
    }
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) turbopi_portable_denoise(const Args args) {
  extern __shared__ __align__(16) float smem[];
  Grid grid(args);
  const int length = *args.length;
  Nothing nothing;
  for (int step = 0; step < args.steps; ++step) {
    const float* const table = args.table + (MODULATED ? (long long)step * (2 * L + 1) * 3 * D : 0);
    Stream stream{table, args.x, args.squares, args.stream};
    embed(args, stream, args.x_t + step * T * A, args.in_b + (MODULATED ? 0 : step * D));
    ahead<OutShape>(args.weights + OUT_AT);
    grid.arrive();
    if (!MODULATED) {
      Product<MixShape> product(args.mix);
      product.ask();
      FinishMixed finish{stream, args.mix_b};
      product.run(grid, smem, args.hidden, finish, nothing);
      grid.arrive();
    }
#pragma unroll 1
    for (int layer = 0; layer < L; ++layer) {
      const byte* const weights = args.weights + layer * LAYER_BYTES;
      const byte* const next = layer + 1 < L ? weights + LAYER_BYTES : args.weights;
      const float* const norms = table + layer * 6 * D;  // scale, shift, gate before attention; before the feed-forward
      const float* const shifted = args.shifted + ((MODULATED ? (long long)step * L : 0) + layer) * (QKV_ROWS + 2 * F);
      const float* const scales = args.row_scales + (SCALED ? layer * (QKV_ROWS + 2 * F) : 0);
      const Normed normed{shifted, scales, smem + S_RMS};
      if (ACROSS_AT_ONCE && !is_self(layer)) {
        attend_across(grid, args, smem, layer, length, weights + QKV_AT, normed, attended_times_of(args, layer));
        grid.arrive(2);
        ahead<GateUpShape>(weights + GATE_UP_AT);
      } else {
        {
          Product<QkvShape> product(weights + QKV_AT, is_self(layer) ? QkvShape::TILES : HEADS * HD / 8);
          product.ask();
          FinishQkv finish{{normed, (const float2*)args.rope + (is_self(layer) ? 0 : T * HD / 2)},
                           (unsigned short*)args.queries,
                           (unsigned short*)args.keys,
                           (unsigned short*)args.values};
          finish.normed.ahead(product.first, product.end);
          InverseRms<QkvShape> inverse_rms{args, smem};
          product.run(grid, smem, args.stream, finish, inverse_rms);
        }
        grid.arrive();
        ahead<GateUpShape>(weights + GATE_UP_AT);
        const float attended_times = attended_times_of(args, layer);
        if (BY_WARPS)
          attend_by_warps(grid, args, smem, layer, length, attended_times);
        else
          attend(grid, args, smem, layer, length, attended_times);
        grid.arrive();
        if (COMBINES) {
          grid.wait();
          combine(args, attended_times);
          grid.arrive();
        }
      }
      {
        Product<OutShape> product(weights + OUT_AT);
        product.ask();
        ahead<DownShape>(weights + DOWN_AT);
        stream.scale = norms + 3 * D;
        FinishResidual finish{stream, norms + 2 * D};
        product.run(grid, smem, args.attended, finish, nothing);
      }
      grid.arrive();
      {
        Product<GateUpShape> product(weights + GATE_UP_AT);
        product.ask();
        ahead<QkvShape>(next + QKV_AT);
        cache_ahead(args, layer + 1 < L ? layer + 1 : 0, length);
        FinishGateUp finish{{shifted + QKV_ROWS, scales + (SCALED ? QKV_ROWS : 0), smem + S_RMS}, args.hidden};
        finish.normed.ahead(product.first, product.end);
        InverseRms<GateUpShape> inverse_rms{args, smem};
        product.run(grid, smem, args.stream, finish, inverse_rms);
      }
      grid.arrive();
      {
        Product<DownShape> product(weights + DOWN_AT);
        product.ask();
        ahead<OutShape>(next + OUT_AT);
        if (layer + 1 == L) ends_ahead(args.out_w, A * D), ends_ahead(args.in_w, A * D);
        stream.scale = norms + 6 * D;
        FinishResidual finish{stream, norms + 5 * D};
        product.run(grid, smem, args.hidden, finish, nothing);
      }
      grid.arrive();
    }
    grid.wait();
    advance(args, table + 2 * L * 3 * D, step);
    grid.arrive();
    if (!MODULATED) ahead<MixShape>(args.mix);
    grid.wait();
  }
}
