// x [T, inner] times a matrix [inner, columns] whose rows are read as they lie in memory, inner axis first: the way back
// through a product of up to 16 tokens.
//
// A block takes COLUMNS columns and DEPTH of the inner axis, and asks for all of them, into shared memory, before it
// waits for the kernel in front: memory is read while that one works. Behind the wait a warp multiplies its part of the
// inner axis, and the warps' sums meet in shared memory, over the weights.
//
// An item is two neighbouring columns of a token. What becomes of its sums: TP_MODE.
//   PLAIN   bfloat16[T][columns]
//   PARTS   float32[inner / DEPTH][T][columns]
//   GEGLU   back through GeGLU of `product` [T][2 columns], which was kept: bfloat16[T][2 columns]

typedef unsigned char byte;

enum Mode { PLAIN, PARTS, GEGLU };
constexpr int MODE = TP_MODE, COLUMNS = TP_COLUMNS, DEPTH = TP_DEPTH;
constexpr int WARPS = 16, THREADS = WARPS * 32;
constexpr int SLICE = DEPTH / WARPS;
constexpr int CHUNKS = SLICE / 32;  // a lane has 16 bytes of a token's 32 columns
constexpr int AT_ONCE = CHUNKS < 4 ? CHUNKS : 4;  // more of them spill
constexpr int CHUNK_BYTES = 32 * COLUMNS * 2;  // of weights
constexpr int N_TILES = COLUMNS / 8, ROW_CHUNKS = COLUMNS / 8;  // 16 bytes of a row
constexpr int ROWS = THREADS / ROW_CHUNKS;                      // of weights, that all threads copy at once
constexpr int PITCH = COLUMNS + 8;                              // of sums, float32
constexpr int PAIRS = COLUMNS / 2, ITEMS = 16 * PAIRS, TURNS = (ITEMS + THREADS - 1) / THREADS;
static_assert(SLICE % 32 == 0 && CHUNKS % AT_ONCE == 0 && DEPTH % ROWS == 0 && ROWS % 32 == 0, "a warp's part of the inner axis");
static_assert(COLUMNS == 16 || COLUMNS == 32 || COLUMNS == 64, "see `place`");
constexpr int BARRIER = TP_SHARED_BYTES - 16;
static_assert(BARRIER >= DEPTH * COLUMNS * 2 && BARRIER >= WARPS * 16 * PITCH * 4, "room");

// Where 16 bytes of a row lie. What `ldmatrix` reads at once, of rows 8 i + {0, 1} (+ 2, 4, 6), is in different banks.
__device__ __forceinline__ int place(int row, int chunk) {
  const int eight = row / 8 % 4;
  if (COLUMNS == 64) return row * 128 + ((chunk ^ (row % 2 + 2 * eight)) * 16);
  if (COLUMNS == 32) return row * 64 + ((chunk ^ eight) * 16);
  return (row / 32 * 32 + row % 8 * 4 + eight) * 32 + ((chunk ^ (row % 2)) * 16);
}

__device__ __forceinline__ void copy_ahead(u32 to, const void* from) {
  asm volatile("cp.async.cg.shared.global.L2::128B [%0], [%1], 16;" ::"r"(to), "l"(from) : "memory");
}
// This thread's copies arrive at the barrier when they are here. Not `cp.async.wait_all`, which the compiler would put in
// front of loads.
__device__ __forceinline__ void arrive_with_copies(u32 bar) {
  asm volatile("cp.async.mbarrier.arrive.noinc.shared::cta.b64 [%0];" ::"r"(bar) : "memory");
}
__device__ __forceinline__ void load_transposed(u32 (&v)[4], u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v[0]), "=r"(v[1]), "=r"(v[2]), "=r"(v[3])
               : "r"(address)
               : "memory");
}
__device__ __forceinline__ void mma(float (&c)[4], u32 a0, u32 a1, u32 a2, u32 a3, u32 b0, u32 b1) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "r"(b0), "r"(b1));
}

// Where a lane's row of the first weights lies that either step of a chunk takes, by `load_transposed`. A lane's 8 columns of
// the activations are 4 of either step's 16: so rows come in the same order.
struct Places {
  u32 step[2];
  __device__ __forceinline__ Places(u32 smem, int first, int lane) {
    const int r = lane % 8, row = first + r / 2 * 8 + lane / 8 % 2 * 2 + r % 2;
    step[0] = smem + place(row, lane / 16), step[1] = smem + place(row + 4, lane / 16);
  }
};
// A chunk of the weights, 32 rows, times what lanes have of them: `low` of tokens g, `high` of g + 8.
__device__ __forceinline__ void multiply(float (&sums)[N_TILES][4], const Places& places, int chunk, uint4 low, uint4 high) {
#pragma unroll
  for (int step = 0; step < 2; ++step) {
    const u32 a0 = step ? low.z : low.x, a1 = step ? high.z : high.x;
    const u32 a2 = step ? low.w : low.y, a3 = step ? high.w : high.y;
#pragma unroll
    for (int tile = 0; tile < N_TILES; tile += 2) {
      u32 b[4];
      load_transposed(b, (places.step[step] ^ tile * 16) + chunk * CHUNK_BYTES);  // see `place`: `tile` is even
      mma(sums[tile], a0, a1, a2, a3, b[0], b[1]);
      mma(sums[tile + 1], a0, a1, a2, a3, b[2], b[3]);
    }
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, 2)
    turbopi_across(const byte* x, const byte* weights, const byte* product, byte* out, int tokens, int inner, int columns) {
  extern __shared__ __align__(128) byte shared[];
  const u32 smem = shared_address(shared);
  const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32, g = lane / 4, t = lane % 4;
  const int groups = columns / COLUMNS, column = blockIdx.x % groups * COLUMNS, part = blockIdx.x / groups;
  if (thread == 0) barrier_init(smem + BARRIER, THREADS);
  __syncthreads();
  {
    const int row = thread / ROW_CHUNKS, chunk = thread % ROW_CHUNKS;
    const byte* from = weights + (((long long)part * DEPTH + row) * columns + column + chunk * 8) * 2;
    const u32 to = smem + place(row, chunk);
#pragma unroll 4
    for (int i = 0; i < DEPTH / ROWS; ++i, from += (long long)ROWS * columns * 2) copy_ahead(to + i * (ROWS * COLUMNS * 2), from);
    arrive_with_copies(smem + BARRIER);
  }
  u32 gates[TURNS], ups[TURNS];  // kept by a kernel long ago
#pragma unroll
  for (int i = 0; i < TURNS; ++i) {
    const int item = thread + i * THREADS, token = item / PAIRS, at = token * 2 * columns + column + item % PAIRS * 2;
    gates[i] = ups[i] = 0;
    if (MODE == GEGLU && token < tokens)
      gates[i] = *(const u32*)(product + at * 2), ups[i] = *(const u32*)(product + (at + columns) * 2);
  }
  asm volatile("griddepcontrol.wait;" ::: "memory");
  asm volatile("griddepcontrol.launch_dependents;" ::: "memory");

  const int first = warp * SLICE;
  const byte* mine = x + ((long long)min(g, tokens - 1) * inner + part * DEPTH + first + t * 8) * 2;
  const int to_high = g + 8 < tokens ? inner * 16 : 0;  // a missing token reads another's row; its sums are never stored
  uint4 low[AT_ONCE], high[AT_ONCE];
#pragma unroll
  for (int i = 0; i < AT_ONCE; ++i)
    low[i] = *(const uint4*)(mine + i * 64), high[i] = *(const uint4*)(mine + to_high + i * 64);
  float sums[N_TILES][4];
#pragma unroll
  for (int i = 0; i < N_TILES; ++i) sums[i][0] = sums[i][1] = sums[i][2] = sums[i][3] = 0;
  const Places places(smem, first, lane);
  barrier_wait(smem + BARRIER, 0);  // all weights are here
#pragma unroll 1
  for (int chunk = 0; chunk < CHUNKS; chunk += AT_ONCE) {
    mine += AT_ONCE * 64;
#pragma unroll
    for (int i = 0; i < AT_ONCE; ++i) {
      multiply(sums, places, chunk + i, low[i], high[i]);
      if (chunk + AT_ONCE < CHUNKS)
        low[i] = *(const uint4*)(mine + i * 64), high[i] = *(const uint4*)(mine + to_high + i * 64);
    }
  }
  __syncthreads();  // the weights have been read
  float* const room = (float*)shared;
#pragma unroll
  for (int tile = 0; tile < N_TILES; ++tile) {
    float* const to = room + (warp * 16 + g) * PITCH + tile * 8 + t * 2;
    *(float2*)to = make_float2(sums[tile][0], sums[tile][1]);
    *(float2*)(to + 8 * PITCH) = make_float2(sums[tile][2], sums[tile][3]);
  }
  __syncthreads();
#pragma unroll(MODE == GEGLU ? TURNS : 1)
  for (int i = 0; i < TURNS; ++i) {
    const int item = thread + i * THREADS, of = item / PAIRS, pair = item % PAIRS * 2;
    if (of >= tokens) continue;
    float2 sum = make_float2(0, 0);
#pragma unroll
    for (int k = 0; k < WARPS; ++k) {
      const float2 v = *(const float2*)(room + (k * 16 + of) * PITCH + pair);
      sum.x += v.x, sum.y += v.y;
    }
    if (MODE == PARTS) {
      *(float2*)(out + (((long long)part * tokens + of) * columns + column + pair) * 4) = sum;
    } else if (MODE == PLAIN) {
      *(u32*)(out + ((long long)of * columns + column + pair) * 2) = pack(sum.x, sum.y);
    } else {
      // tanh(u) = 2 sigmoid(2 u) - 1, u = sqrt(2 / pi) (gate + 0.044715 gate^3); half is (1 + tanh u) / 2
      float to_gate[2], to_up[2];
#pragma unroll
      for (int j = 0; j < 2; ++j) {
        const float gate = j ? bf16_high(gates[i]) : bf16_low(gates[i]), up = j ? bf16_high(ups[i]) : bf16_low(ups[i]);
        const float d = j ? sum.y : sum.x, square = gate * gate;
        const float half = 1 / (1 + exp2f(gate * (-2.302208198f - 0.1029432397f * square)));
        const float slope = half + gate * 2 * half * (1 - half) * 0.7978845608f * (1 + 0.134145f * square);
        to_gate[j] = d * up * slope, to_up[j] = d * gate * half;
      }
      byte* const to = out + ((long long)of * 2 * columns + column + pair) * 2;
      *(u32*)to = pack(to_gate[0], to_gate[1]), *(u32*)(to + columns * 2) = pack(to_up[0], to_up[1]);
    }
  }
}
