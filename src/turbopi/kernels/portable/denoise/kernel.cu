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
//   guards   x_t, which the end of the step before waits for; the stream and its squares, which gate|up has read
// qkv: product.run; arrive
//   guards   stream and squares, of embed or down
// attention: attend; arrive
//   guards   queries, keys, values
// combine: wait; combine; arrive
//   guards   partial, tops
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

// action_in_proj of x_t, and the stream of the first norm: each block the columns that it keeps.
__device__ __forceinline__ void embed(const Args& args, const Stream& into, const float* x_t) {
  const Product<DownShape> mine(args.weights);
  const int tiles = mine.end - mine.first, lane = threadIdx.x % 32;
  for (int index = threadIdx.x; index - lane < tiles * T * 4; index += THREADS) {
    Item i{mine.first + index / (4 * T), index / 4 % T, index % 4, index < tiles * T * 4};
    float2 v = make_float2(0, 0), by = v;
    if (i.valid) {
      const int column = i.tile * 8 + i.pair * 2;
      v = two(args.in_b + column), by = two(into.scale + column);
      for (int a = 0; a < A; ++a) {
        const float x = __ldcg(x_t + i.token * A + a);
        const float2 w = two(args.in_w + a * D + column);
        v.x += x * w.x, v.y += x * w.y;
      }
    }
    into.keep(i, v, by);
  }
}

// Final norm, action_out_proj and the Euler step: a warp takes one number of a token.
__device__ __forceinline__ void advance(const Args& args, const float* scale, int step) {
  const int thread = thread_of_phase(), lane = thread % 32;
  for (int task = thread / 32 * BLOCKS + blockIdx.x; task < T * A; task += WARPS * BLOCKS) {
    const int token = task / A, a = task % A;
    float sum = 0, squares = 0;
#pragma unroll 8
    for (int column = lane * 2; column < D; column += 64) {
      const float2 x = __ldcg((const float2*)(args.x + token * D + column));
      const float2 w = two(args.out_w + a * D + column), s = two(scale + column);
      squares += x.x * x.x + x.y * x.y, sum += x.x * s.x * w.x + x.y * s.y * w.y;
    }
#pragma unroll
    for (int by = 16; by; by /= 2)
      sum += __shfl_xor_sync(~0u, sum, by), squares += __shfl_xor_sync(~0u, squares, by);
    if (lane == 0) {
      const float v = sum * rsqrtf(squares / D + args.eps) + __ldg(args.out_shift + step * A + a);
      args.v_t[step * T * A + task] = v;
      // rounded after each operation, as PyTorch does
      args.x_t[(step + 1) * T * A + task] = __fadd_rn(__ldcg(args.x_t + step * T * A + task), __fmul_rn(args.dt, v));
    }
  }
}

// The prefix's keys and values of a layer, to L2.
__device__ __forceinline__ void cache_ahead(const Args& args, int layer, int length) {
  if (!TP_AHEAD) return;
  const long long bytes = (long long)length * HD * 2;
  for (long long at = (blockIdx.x * THREADS + threadIdx.x) * 128ll; at < 2 * bytes; at += BLOCKS * THREADS * 128ll)
    to_l2((at < bytes ? args.cache_k + at : args.cache_v + (at - bytes)) + layer * args.layer_stride);
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
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, 1) turbopi_portable_denoise(const Args args) {
  extern __shared__ __align__(16) float smem[];
  Grid grid(args);
  const int length = *args.length;
  auto nothing = [] {};
  auto inverse_rms = [&] { make_inverse_rms(args, smem); };
  for (int step = 0; step < args.steps; ++step) {
    const float* const table = args.table + (long long)step * (2 * L + 1) * 3 * D;
    Stream stream{table, args.x, args.squares, args.stream};
    embed(args, stream, args.x_t + step * T * A);
    ahead<OutShape>(args.weights + OUT_AT);
    grid.arrive();
#pragma unroll 1
    for (int layer = 0; layer < L; ++layer) {
      const byte* const weights = args.weights + layer * LAYER_BYTES;
      const byte* const next = layer + 1 < L ? weights + LAYER_BYTES : args.weights;
      const float* const norms = table + layer * 6 * D;  // scale, shift, gate before attention; before the feed-forward
      const float* const shifted = args.shifted + ((long long)step * L + layer) * (QKV_ROWS + 2 * F);
      const float* const scales = args.row_scales + (SCALED ? layer * (QKV_ROWS + 2 * F) : 0);
      {
        Product<QkvShape> product(weights + QKV_AT);
        product.ask();
        FinishQkv finish{{shifted, scales, smem + S_RMS}, (const float2*)args.rope, (unsigned short*)args.queries,
                         (unsigned short*)args.keys, (unsigned short*)args.values};
        product.run(grid, smem, args.stream, finish, inverse_rms);
      }
      grid.arrive();
      ahead<GateUpShape>(weights + GATE_UP_AT);
      attend(grid, args, smem, layer, length);
      grid.arrive();
      grid.wait();
      combine(args, FP8 ? __ldg(args.attended_times + layer) : 1.0f);
      grid.arrive();
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
        product.run(grid, smem, args.stream, finish, inverse_rms);
      }
      grid.arrive();
      {
        Product<DownShape> product(weights + DOWN_AT);
        product.ask();
        ahead<OutShape>(next + OUT_AT);
        stream.scale = norms + 6 * D;
        FinishResidual finish{stream, norms + 5 * D};
        product.run(grid, smem, args.hidden, finish, nothing);
      }
      grid.arrive();
    }
    grid.wait();
    advance(args, table + 2 * L * 3 * D, step);
    grid.arrive();
    grid.wait();
  }
}
