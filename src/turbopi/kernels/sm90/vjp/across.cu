// x [T, inner] times a matrix [inner, columns] whose rows are read as they lie in memory, inner axis first: the way back
// through a product of few tokens.
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
constexpr int MODE = TP_MODE, M_TILES = TP_M_TILES, COLUMNS = TP_COLUMNS, DEPTH = TP_DEPTH;
constexpr int WARPS = 16, THREADS = WARPS * 32;
constexpr int PARTS_OF_DEPTH = WARPS / M_TILES, SLICE = DEPTH / PARTS_OF_DEPTH;  // a warp has 16 tokens
constexpr int CHUNKS = SLICE / 32;  // a lane has 16 bytes of a token's 32 columns
constexpr int AT_ONCE = CHUNKS < 4 ? CHUNKS : 4;
constexpr int N_TILES = COLUMNS / 8, ROW_CHUNKS = COLUMNS / 8;  // 16 bytes of a row
constexpr int PITCH = COLUMNS + 8;                              // of sums, float32
constexpr int PAIRS = COLUMNS / 2, ITEMS = 16 * M_TILES * PAIRS, TURNS = (ITEMS + THREADS - 1) / THREADS;
static_assert(M_TILES == 1 || M_TILES == 2 || M_TILES == 4, "warps share out the tokens");
static_assert(SLICE % 32 == 0 && CHUNKS % AT_ONCE == 0, "a warp's part of the inner axis");
static_assert(COLUMNS == 16 || COLUMNS == 32 || COLUMNS == 64, "see `place`");
static_assert(TP_SHARED_BYTES >= DEPTH * COLUMNS * 2 && TP_SHARED_BYTES >= WARPS * 16 * PITCH * 4, "room");

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
__device__ __forceinline__ void await_copies() { asm volatile("cp.async.wait_all;" ::: "memory"); }
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

// 32 rows of the block's weights, from `row` on, times what lanes have of them: `low` of tokens g, `high` of g + 8. A lane's
// 8 columns are 4 of either step's 16: so rows come in the same order.
__device__ __forceinline__ void multiply(float (&sums)[N_TILES][4], u32 smem, int row, int lane, uint4 low, uint4 high) {
#pragma unroll
  for (int step = 0; step < 2; ++step) {
    const int r = lane % 8, at = row + r / 2 * 8 + step * 4 + lane / 8 % 2 * 2 + r % 2;
    const u32 a0 = step ? low.z : low.x, a1 = step ? high.z : high.x;
    const u32 a2 = step ? low.w : low.y, a3 = step ? high.w : high.y;
#pragma unroll
    for (int tile = 0; tile < N_TILES; tile += 2) {
      u32 b[4];
      load_transposed(b, smem + place(at, tile + lane / 16));
      mma(sums[tile], a0, a1, a2, a3, b[0], b[1]);
      mma(sums[tile + 1], a0, a1, a2, a3, b[2], b[3]);
    }
  }
}

extern "C" __global__ void __launch_bounds__(THREADS, M_TILES == 1 ? 2 : 1)
    turbopi_across(const byte* x, const byte* weights, const byte* product, byte* out, int tokens, int inner, int columns) {
  extern __shared__ __align__(128) byte shared[];
  const u32 smem = shared_address(shared);
  const int thread = threadIdx.x, warp = thread / 32, lane = thread % 32, g = lane / 4, t = lane % 4;
  const int groups = columns / COLUMNS, column = blockIdx.x % groups * COLUMNS, part = blockIdx.x / groups;
  const byte* const from = weights + ((long long)part * DEPTH * columns + column) * 2;
#pragma unroll 8
  for (int i = thread; i < DEPTH * ROW_CHUNKS; i += THREADS) {
    const int row = i / ROW_CHUNKS, chunk = i % ROW_CHUNKS;
    copy_ahead(smem + place(row, chunk), from + ((long long)row * columns + chunk * 8) * 2);
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

  const int first = warp / M_TILES * SLICE, token = warp % M_TILES * 16 + g;
  const byte* const mine = x + ((long long)token * inner + part * DEPTH + first + t * 8) * 2;
  auto load = [&](int chunk, bool high) {
    uint4 v = make_uint4(0, 0, 0, 0);
    if (token + (high ? 8 : 0) < tokens) v = *(const uint4*)(mine + (high ? 16ll * inner : 0) + chunk * 64);
    return v;
  };
  uint4 low[AT_ONCE], high[AT_ONCE];
#pragma unroll
  for (int i = 0; i < AT_ONCE; ++i) low[i] = load(i, false), high[i] = load(i, true);
  await_copies();
  __syncthreads();
  float sums[N_TILES][4];
#pragma unroll
  for (int i = 0; i < N_TILES; ++i) sums[i][0] = sums[i][1] = sums[i][2] = sums[i][3] = 0;
#pragma unroll
  for (int chunk = 0; chunk < CHUNKS; ++chunk) {
    multiply(sums, smem, first + chunk * 32, lane, low[chunk % AT_ONCE], high[chunk % AT_ONCE]);
    if (chunk + AT_ONCE < CHUNKS)
      low[chunk % AT_ONCE] = load(chunk + AT_ONCE, false), high[chunk % AT_ONCE] = load(chunk + AT_ONCE, true);
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
#pragma unroll
  for (int i = 0; i < TURNS; ++i) {
    const int item = thread + i * THREADS, of = item / PAIRS, pair = item % PAIRS * 2;
    if (of >= tokens) continue;
    float2 sum = make_float2(0, 0);
#pragma unroll
    for (int k = 0; k < PARTS_OF_DEPTH; ++k) {
      const float2 v = *(const float2*)(room + ((k * M_TILES + of / 16) * 16 + of % 16) * PITCH + pair);
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
