// The whole denoising loop of Pi0.5's action expert, all layers and steps, in one cooperative kernel.
//
// G CTAs stay resident, one per SM. Each owns a fixed set of weight rows ("tiles" of 8) of every matrix. A producer warp
// streams those rows through a ring of shared memory without ever waiting for activations; eight consumer warps split a
// product's reduction axis between them and multiply on tensor cores (tokens are the m16 operand, weight rows the n8).
//
// CTAs exchange activations through global buffers that carry their own flags: every 32-bit word is 0xffffffff until
// it is written (no bfloat16 pair and no float that arithmetic produces has that pattern), and a reader polls the very
// words it needs. So an exchange costs one store and one load, and there is no grid barrier. A buffer has several
// instances used in turn; its writer wipes an instance in `wipe`, once a layer, when every CTA is known to be past
// it, and the fence there orders the wipe before anything that is published later.
//
// Layouts, all set by denoise.py:
//   weights  a tile is [reduction / 32][8 rows][32] bfloat16, so a lane reads 16 bytes: its row's 8 values of the block.
//            q and k tiles hold rows i..i+3 and i+HD/2.. in turn (RoPE's pairs), gate|up tiles 4 gate and 4 up rows in turn.
//   norms    W (x r s + b) = r (W (x s)) + W b: the owner of a column of x publishes x s, and the sum of x² over its
//            columns; r and the table W b come in where the product is finished.

typedef unsigned int u32;
typedef unsigned long long u64;

constexpr int D = TP_D, F = TP_F, L = TP_L, NH = TP_NH, HD = TP_HD, G = TP_G, T = TP_T, A = TP_A, KEYS = TP_KEYS;
constexpr int W = TP_W, CONSUMERS = W * 32, CHUNKS = 16;
constexpr int M = (T + 15) / 16;
constexpr int KBD = D / 32, KBO = NH * HD / 32, KBF = F / 32;
constexpr int QT = (NH + 2) * HD / 8, DT = D / 8, GT = F / 4;
constexpr int QTL = (QT + G - 1) / G, DTL = (DT + G - 1) / G, GTL = (GT + G - 1) / G;
constexpr int QW = (NH + 2) * HD, OW = NH * HD;
constexpr size_t TILE_D = size_t(KBD) * 256, TILE_O = size_t(KBO) * 256, TILE_F = size_t(KBF) * 256;  // elements
constexpr size_t OFF_O = QT * TILE_D, OFF_G = OFF_O + DT * TILE_O, OFF_F = OFF_G + GT * TILE_D;
constexpr size_t LAYER = OFF_F + DT * TILE_F;
constexpr u32 EMPTY = 0xffffffffu;
#define NEG_INF __int_as_float(0xff800000)

// Batches of ring slots that are multiplied side by side, to have independent accumulators.
constexpr int SB = M == 1 ? 4 : M == 2 ? 2 : 1;
// Tiles whose partial sums are added up at once. The area of qkv and gate|up is another than that of out and down, so
// that no phase writes where the last one may still be read.
constexpr int RED_TILES = M == 1 ? 4 : M == 2 ? 2 : 1, RED_TILES_G = M == 1 ? 8 : M == 2 ? 4 : 2;
constexpr int RED_A = W * RED_TILES_G * M * 512, RED_B = W * (RED_TILES < DTL ? RED_TILES : DTL) * M * 512;  // bytes

constexpr int KC = (KEYS + 15) / 16 * 16;
constexpr int QS = HD + 8, SS = KC + 4, PS = KC + 8;  // row strides of q, logits, probabilities in shared memory
__host__ __device__ constexpr int up128(int x) { return (x + 127) / 128 * 128; }
__host__ __device__ constexpr int imax(int a, int b) { return a > b ? a : b; }
constexpr int ATT_S = up128(imax(16 * M * QS * 2, 16 * M * PS * 2));
constexpr int ATT = ATT_S + 16 * M * SS * 4;
constexpr int PARAM_FLOATS = 4 * DTL * 8 + QTL * 8 + GTL * 8;

constexpr int S_RED = 0;
constexpr int S_PARAM = S_RED + up128(imax(RED_A + RED_B, ATT));
constexpr int S_XT = S_PARAM + up128(2 * PARAM_FLOATS * 4);
constexpr int S_XRES = S_XT + up128(T * A * 4);
constexpr int S_ROPE = S_XRES + DTL * M * 512;
constexpr int S_SSQ = S_ROPE + up128(QTL * 4 * T * 8);
constexpr int S_WIN = S_SSQ + up128(16 * M * 4);
constexpr int S_BAR = S_WIN + up128(DTL * 8 * (A + 1) * 4);
constexpr int S_RING = S_BAR + 1024;
constexpr int SLOT = 16384;
constexpr int STAGES = (TP_SMEM - S_RING) / SLOT < 16 ? (TP_SMEM - S_RING) / SLOT : 16;
static_assert(STAGES >= SB && STAGES >= 2, "too little shared memory");
static_assert(D % 32 == 0 && F % 32 == 0 && HD % 16 == 0 && HD <= 256 && OW % 32 == 0 && A % 4 == 0, "sizes");
static_assert(G <= DT && G <= QT && G <= GT && G <= NH * CHUNKS, "every CTA takes part in every phase");

// Exchange buffers, in 32-bit words from the start of the scratch memory.
constexpr int DEEP = 4;
constexpr size_t N_X = size_t(T) * D / 2, N_QKV = size_t(T) * QW / 2, N_A = size_t(T) * OW / 2, N_H = size_t(T) * F / 2;
constexpr size_t N_P = size_t(NH) * CHUNKS * T * HD, N_ML = size_t(NH) * CHUNKS * T * 2, N_V = size_t(T) * A;
constexpr size_t B_X1 = 0, B_QKV = B_X1 + DEEP * N_X, B_A = B_QKV + DEEP * N_QKV, B_X2 = B_A + DEEP * N_A;
constexpr size_t B_H = B_X2 + DEEP * N_X, B_V = B_H + DEEP * N_H, B_P = B_V + 2 * N_V, B_ML = B_P + 2 * N_P;
constexpr size_t N_S = size_t(T) * DT, B_S1 = B_ML + 2 * N_ML, B_S2 = B_S1 + DEEP * N_S;
constexpr size_t SCRATCH = B_S2 + DEEP * N_S;
static_assert(SCRATCH == TP_SCRATCH, "denoise.py and denoise.cu disagree on the scratch memory");

struct Args {
  const void* weights;        // bf16 [L][LAYER]
  const float* table;         // [N][2L+1][3][D]: scale, shift, gate
  const float* shifted;       // [N][L][(QT + GT) * 8]: W shift, rows in tile order
  const float* out_w;         // [A][D]
  const float* out_shift;     // [N][A]: action_out_proj of the final norm's shift, and its bias
  const float* in_w;          // [D][A]
  const float* in_b;          // [D]
  const float* inv_freq;      // [HD/2]
  const void* cache_k;        // bf16 [L][rows][HD]
  const void* cache_v;
  const long long* length;    // valid rows of the cache
  const float* noise;         // [T][A]
  float* x_t;                 // [N+1][T][A]
  float* v_t;                 // [N][T][A]
  u32* scratch;
  long long layer_stride;     // of the cache, in elements
  int steps;
  float dt;
  float eps;
  u32 zero;  // 0, which the compiler doesn't know
};

// ---- primitives

__device__ __forceinline__ u32 smem_addr(const void* p) { return u32(__cvta_generic_to_shared(p)); }
__device__ __forceinline__ void consumers_sync() {
  __syncwarp();  // lanes leave `poll` one by one, and this barrier counts warps
  asm volatile("bar.sync 1, %0;" ::"n"(CONSUMERS) : "memory");
}

__device__ __forceinline__ void mbar_init(u32 bar, u32 count) {
  asm volatile("mbarrier.init.shared::cta.b64 [%0], %1;" ::"r"(bar), "r"(count) : "memory");
}
__device__ __forceinline__ void mbar_arrive(u32 bar) {
  asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0];" ::"r"(bar) : "memory");
}
__device__ __forceinline__ void mbar_expect(u32 bar, u32 bytes) {
  asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(bar), "r"(bytes) : "memory");
}
__device__ __forceinline__ void mbar_wait(u32 bar, u32 parity) {
#pragma unroll 1
  for (u32 tries = 0; tries < (1u << 24); ++tries) {
    u32 done;
    asm volatile(
        "{ .reg .pred p; mbarrier.try_wait.parity.shared::cta.b64 p, [%1], %2; selp.u32 %0, 1, 0, p; }"
        : "=r"(done)
        : "r"(bar), "r"(parity)
        : "memory");
    if (done) return;
  }
  __trap();
}
__device__ __forceinline__ void bulk_load(u32 to, const void* from, u32 bytes, u32 bar, u64 policy) {
  asm volatile(
      "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes.L2::cache_hint [%0], [%1], %2, [%3], %4;" ::"r"(to),
      "l"(from), "r"(bytes), "r"(bar), "l"(policy)
      : "memory");
}

__device__ __forceinline__ uint4 peek(const uint4* p) {
  u64 a, b;
  asm volatile("ld.relaxed.gpu.global.v2.b64 {%0,%1}, [%2];" : "=l"(a), "=l"(b) : "l"(p) : "memory");
  return make_uint4(u32(a), u32(a >> 32), u32(b), u32(b >> 32));
}
__device__ __forceinline__ uint2 peek(const uint2* p) {
  u64 a;
  asm volatile("ld.relaxed.gpu.global.b64 %0, [%1];" : "=l"(a) : "l"(p) : "memory");
  return make_uint2(u32(a), u32(a >> 32));
}
__device__ __forceinline__ void publish(u32* p, u32 v) {
  asm volatile("st.relaxed.gpu.global.u32 [%0], %1;" ::"l"(p), "r"(v) : "memory");
}
__device__ __forceinline__ void publish(uint2* p, u32 a, u32 b) {
  asm volatile("st.relaxed.gpu.global.b64 [%0], %1;" ::"l"(p), "l"(u64(b) << 32 | a) : "memory");
}
__device__ __forceinline__ void publish(uint4* p, u32 a, u32 b, u32 c, u32 d) {
  asm volatile("st.relaxed.gpu.global.v2.b64 [%0], {%1,%2};" ::"l"(p), "l"(u64(b) << 32 | a), "l"(u64(d) << 32 | c) : "memory");
}

// What is published as 8 bytes arrives as 8 bytes, so one of its words tells. EACH: it was published word by word,
// as poll's items from EACH_FROM on.
template <bool EACH>
__device__ __forceinline__ bool missing(uint4 v) { return v.x == EMPTY || v.z == EMPTY || (EACH && (v.y == EMPTY || v.w == EMPTY)); }
template <bool EACH>
__device__ __forceinline__ bool missing(uint2 v) { return v.x == EMPTY || (EACH && v.y == EMPTY); }
__device__ __forceinline__ void mark_empty(uint4& v) { v.x = EMPTY; }
__device__ __forceinline__ void mark_empty(uint2& v) { v.x = EMPTY; }

__device__ __forceinline__ void wait_for(const uint4* p) {
#pragma unroll 1
  for (u32 tries = 0; missing<false>(peek(p)); ++tries)
    if (tries > (1u << 23)) __trap();
}

// Fill v[i] from p[i] where take[i], asking again for what isn't there yet.
template <int EACH_FROM = 1000, int N, class V>
__device__ __forceinline__ void poll(V (&v)[N], const V* (&p)[N], const bool (&take)[N]) {
#pragma unroll
  for (int i = 0; i < N; ++i)
    if (take[i]) mark_empty(v[i]);
#pragma unroll 1
  for (u32 tries = 0;; ++tries) {
    bool again = false;
#pragma unroll
    for (int i = 0; i < N; ++i)
      if (take[i] && (i < EACH_FROM ? missing<false>(v[i]) : missing<true>(v[i]))) {
        v[i] = peek(p[i]);
        again = true;
      }
    if (!again) return;
    if (tries > (1u << 23)) __trap();
  }
}

__device__ __forceinline__ u32 pack(float lo, float hi) {
  u32 v;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(v) : "f"(hi), "f"(lo));
  return v;
}
__device__ __forceinline__ float low(u32 v) { return __uint_as_float(v << 16); }
__device__ __forceinline__ float high(u32 v) { return __uint_as_float(v & 0xffff0000u); }

__device__ __forceinline__ void mma(float (&c)[4], u32 a0, u32 a1, u32 a2, u32 a3, u32 b0, u32 b1) {
  asm(
      "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "r"(b0), "r"(b1));
}
// One block of 32 along the reduction: a lane's 16 bytes are the values 8t..8t+7 of its row, in both operands alike.
// `interleave` brings two tokens' (g, g + 8) bytes into the order of the two instructions' operands.
__device__ __forceinline__ void interleave(uint4& a, uint4& b) {
  const uint4 lo = a, hi = b;
  a = make_uint4(lo.x, hi.x, lo.y, hi.y);
  b = make_uint4(lo.z, hi.z, lo.w, hi.w);
}
__device__ __forceinline__ void mma32(float (&c)[4], const uint4& a0, const uint4& a1, const uint4& b) {
  mma(c, a0.x, a0.y, a0.z, a0.w, b.x, b.y);
  mma(c, a1.x, a1.y, a1.z, a1.w, b.z, b.w);
}

__device__ __forceinline__ constexpr int first_tile(int tiles, int cta) { return int((long long)tiles * cta / G); }

// ---- a CTA's view

struct Block {
  const Args& a;
  unsigned char* smem;
  int cta, warp, lane, g, t;
  u32 slot = 0, phase = 0;  // of the ring, for consumers

  __device__ Block(const Args& args, unsigned char* s)
      : a(args), smem(s), cta(blockIdx.x), warp(threadIdx.x >> 5), lane(threadIdx.x & 31), g(lane >> 2), t(lane & 3) {}

  __device__ u32 full(u32 s) const { return smem_addr(smem + S_BAR) + s * 16; }
  __device__ u32 empty(u32 s) const { return full(s) + 8; }
  __device__ u32 param_full(int i) const { return smem_addr(smem + S_BAR) + STAGES * 16 + i * 16; }
  __device__ u32 param_empty(int i) const { return param_full(i) + 8; }
  __device__ u32 wipe_start() const { return param_full(2); }
  __device__ u32 wipe_end() const { return param_full(2) + 8; }
  __device__ float* param(int n) const { return (float*)(smem + S_PARAM) + (n & 1) * PARAM_FLOATS; }
  __device__ float* xt() const { return (float*)(smem + S_XT); }
  __device__ float4* xres(int tile, int mt) const { return (float4*)(smem + S_XRES) + (tile * M + mt) * 32 + lane; }
  __device__ float* inv_rms() const { return (float*)(smem + S_SSQ); }  // [T]
  __device__ u32* sq1(int i) const { return a.scratch + B_S1 + (i % DEEP) * N_S; }
  __device__ u32* sq2(int n) const { return a.scratch + B_S2 + (n % DEEP) * N_S; }
  __device__ u32* x1(int i) const { return a.scratch + B_X1 + (i % DEEP) * N_X; }
  __device__ u32* qkv(int n) const { return a.scratch + B_QKV + (n % DEEP) * N_QKV; }
  __device__ u32* att(int n) const { return a.scratch + B_A + (n % DEEP) * N_A; }
  __device__ u32* x2(int n) const { return a.scratch + B_X2 + (n % DEEP) * N_X; }
  __device__ u32* hid(int n) const { return a.scratch + B_H + (n % DEEP) * N_H; }
  __device__ u32* vel(int step) const { return a.scratch + B_V + (step & 1) * N_V; }
  __device__ u32* part(int n, int unit) const { return a.scratch + B_P + (n & 1) * N_P + size_t(unit) * T * HD; }
  __device__ u32* ml(int n, int unit) const { return a.scratch + B_ML + (n & 1) * N_ML + size_t(unit) * T * 2; }
};

// Offsets inside one layer's parameters in shared memory.
constexpr int PAR_S1 = 0, PAR_S2 = DTL * 8, PAR_G1 = 2 * DTL * 8, PAR_G2 = PAR_G1 + DTL * 8, PAR_Q = PAR_G2 + DTL * 8, PAR_H = PAR_Q + QTL * 8;

#ifdef TP_TRACE
#define MARK(i)                                                  \
  if (threadIdx.x == TP_TRACE) {                                 \
    u32* m_ = (u32*)(b.smem + S_BAR + 512);                      \
    const u32 now_ = u32(clock64());                             \
    m_[1 + i] += now_ - m_[0];                                   \
    m_[0] = now_;                                                \
  }
#else
#define MARK(i)
#endif

// ---- producer

__device__ void produce_matrix(Block& b, const unsigned char* base, int tiles, int kb, u64 policy, u32& slot, u32& phase) {
  const int first = first_tile(tiles, b.cta), last = first_tile(tiles, b.cta + 1);
  for (int tile = first; tile < last; ++tile)
    for (int k = 0; k < kb; k += 32) {
      const u32 bytes = (kb - k < 32 ? kb - k : 32) * 512;
      mbar_wait(b.empty(slot), phase ^ 1);
      mbar_expect(b.full(slot), bytes);
      bulk_load(smem_addr(b.smem + S_RING + slot * SLOT), base + (size_t(tile) * kb + k) * 512, bytes, b.full(slot), policy);
      if (++slot == STAGES) slot = 0, phase ^= 1;
    }
}

__device__ void produce(Block& b) {
  u64 policy, keep;
  asm volatile("createpolicy.fractional.L2::evict_first.b64 %0, 1.0;" : "=l"(policy));
  asm volatile("createpolicy.fractional.L2::evict_last.b64 %0, 1.0;" : "=l"(keep));
  const int q0 = first_tile(QT, b.cta), q1 = first_tile(QT, b.cta + 1), d0 = first_tile(DT, b.cta), d1 = first_tile(DT, b.cta + 1);
  const int h0 = first_tile(GT, b.cta), h1 = first_tile(GT, b.cta + 1);
  u32 slot = 0, phase = 0;
  for (int step = 0, n = 0; step < b.a.steps; ++step)
    for (int l = 0; l < L; ++l, ++n) {
      const float* table = b.a.table + (size_t(step) * (2 * L + 1) + 2 * l) * 3 * D;
      const float* shifted = b.a.shifted + (size_t(step) * L + l) * (QT + GT) * 8;
      const u32 bar = b.param_full(n & 1);
      const u32 to = smem_addr(b.param(n));
      mbar_wait(b.param_empty(n & 1), ((n >> 1) & 1) ^ 1);
      mbar_expect(bar, (4 * (d1 - d0) + (q1 - q0) + (h1 - h0)) * 32);
      bulk_load(to + PAR_S1 * 4, table + 6 * D + d0 * 8, (d1 - d0) * 32, bar, keep);  // of the norm behind this layer
      bulk_load(to + PAR_S2 * 4, table + 3 * D + d0 * 8, (d1 - d0) * 32, bar, keep);
      bulk_load(to + PAR_G1 * 4, table + 2 * D + d0 * 8, (d1 - d0) * 32, bar, keep);
      bulk_load(to + PAR_G2 * 4, table + 5 * D + d0 * 8, (d1 - d0) * 32, bar, keep);
      bulk_load(to + PAR_Q * 4, shifted + q0 * 8, (q1 - q0) * 32, bar, keep);
      bulk_load(to + PAR_H * 4, shifted + (QT + h0) * 8, (h1 - h0) * 32, bar, keep);
      const unsigned char* w = (const unsigned char*)b.a.weights + size_t(l) * LAYER * 2;
      produce_matrix(b, w, QT, KBD, policy, slot, phase);
      produce_matrix(b, w + OFF_O * 2, DT, KBO, policy, slot, phase);
      produce_matrix(b, w + OFF_G * 2, GT, KBD, policy, slot, phase);
      produce_matrix(b, w + OFF_F * 2, DT, KBF, policy, slot, phase);
    }
}

// ---- matrix products

// Read this warp's share of activations [T][KB * 32] for PARTS slots' worth of the reduction, from slot `part0` on.
// `squares`, if there is a norm, float32[T][DT]: the sums of squares that the writers of x found in their columns; their
// total goes to shared memory as 1 / rms.
template <int KB, int PARTS, int J, bool NORM>
__device__ __forceinline__ void load_tokens(const Block& b, const u32* src, const u32* squares, int part0, uint4 (&x)[M * PARTS * J * 2]) {
  // Wait with one token's row only: every CTA writes all tokens of its columns at once, and asking for everything
  // again and again would fill the memory system.
  constexpr int PIECES = PARTS * J * 4;
#pragma unroll
  for (int i = 0; i < (PIECES + 31) / 32; ++i) {
    const int at = i * 32 + b.lane, kb = (part0 + at / 4 / J) * 32 + at / 4 % J * W + b.warp;
    if (at < PIECES && (KB % 32 == 0 || kb < KB)) wait_for((const uint4*)src + (size_t(T - 1) * KB + kb) * 4 + at % 4);
  }
  __syncwarp();
  constexpr int NX = M * PARTS * J * 2, ROWS = NORM ? (T + W - 1) / W : 0, COLS = (DT / 4 + 31) / 32, N = NX + ROWS * COLS;
  uint4 v[N];
  const uint4* p[N];
  bool take[N];
#pragma unroll
  for (int i = 0; i < N; ++i) v[i] = make_uint4(0, 0, 0, 0);
#pragma unroll
  for (int i = 0; i < NX; ++i) {
    const int row = i & 1, j = (i >> 1) % J, part = (i >> 1) / J % PARTS, mt = (i >> 1) / (J * PARTS);
    const int token = mt * 16 + row * 8 + b.g, kb = (part0 + part) * 32 + j * W + b.warp;
    take[i] = token < T && (KB % 32 == 0 || kb < KB);
    p[i] = (const uint4*)src + (size_t(token) * KB + kb) * 4 + b.t;
  }
#pragma unroll
  for (int i = 0; i < ROWS * COLS; ++i) {
    const int token = i / COLS * W + b.warp, col = i % COLS * 32 + b.lane;
    take[NX + i] = token < T && col < DT / 4;
    p[NX + i] = (const uint4*)squares + size_t(token) * (DT / 4) + col;
  }
  poll<NX>(v, p, take);
  __syncwarp();
#pragma unroll
  for (int i = 0; i < NX; ++i) x[i] = v[i];
#pragma unroll
  for (int i = 0; i < NX; i += 2) interleave(x[i], x[i + 1]);
#pragma unroll
  for (int row = 0; row < ROWS; ++row) {
    float sum = 0;
#pragma unroll
    for (int i = 0; i < COLS; ++i) {
      const uint4& q = v[NX + row * COLS + i];
      sum += (__uint_as_float(q.x) + __uint_as_float(q.y)) + (__uint_as_float(q.z) + __uint_as_float(q.w));
    }
#pragma unroll
    for (int o = 16; o; o >>= 1) sum += __shfl_xor_sync(~0u, sum, o);
    if (b.lane == 0 && row * W + b.warp < T) b.inv_rms()[row * W + b.warp] = rsqrtf(sum * (1.0f / D) + b.a.eps);
  }
}

// This CTA's tiles of one product: tokens [T][KB * 32] times its weight rows. `finish(tile, mt, c)` gets a lane's four
// sums: tokens g and g + 8 (c.x c.y and c.z c.w), rows 2t and 2t + 1.
template <int TILES, int KB, int MK, int GROUP, int AREA, bool NORM, class Received, class Finish>
__device__ __forceinline__ void product(Block& b, const u32* src, const u32* squares, int tiles, Received received, Finish finish) {
  constexpr int ALL = (KB + 31) / 32, J = KB < 32 ? (KB + W - 1) / W : 32 / W;
  constexpr int PARTS = ALL < SB ? ALL : SB;          // slots along the reduction that are loaded together
  constexpr int ROUNDS = (ALL + PARTS - 1) / PARTS;
  constexpr int SIDE = ALL == 1 ? SB : 1;             // tiles multiplied side by side
  constexpr int ACC = SIDE * PARTS;
  constexpr bool EXACT = TILES % (G * SIDE) == 0 && GROUP % SIDE == 0 && (TILES / G) % GROUP == 0;
  uint4 x[M * PARTS * J * 2];
  auto load = [&](int round) {
    load_tokens<KB, PARTS, J, NORM>(b, src, squares, round * PARTS, x);
    MARK(MK)
    MARK(MK + 1)
  };
  if (ROUNDS == 1) load(0), received();
  float4* red = (float4*)(b.smem + S_RED + AREA);
#pragma unroll 1
  for (int first = 0; first < tiles; first += GROUP) {
    const int count = min(GROUP, tiles - first);
    if (first > 0) consumers_sync();
#pragma unroll 1
    for (int inner = 0; inner < count; inner += SIDE) {
      const int side = min(SIDE, count - inner);
      float c[ACC][M][4];
#pragma unroll
      for (int i = 0; i < ACC; ++i)
#pragma unroll
        for (int mt = 0; mt < M; ++mt)
#pragma unroll
          for (int k = 0; k < 4; ++k) c[i][mt][k] = 0;
      for (int round = 0; round < ROUNDS; ++round) {
        if (ROUNDS > 1) load(round);
        u32 slots[ACC];
#pragma unroll
        for (int i = 0; i < ACC; ++i) {
          slots[i] = b.slot;
          const bool used = SIDE > 1 ? EXACT || i < side : ALL % PARTS == 0 || round * PARTS + i < ALL;
          if (used) {
            mbar_wait(b.full(b.slot), b.phase);
            if (++b.slot == STAGES) b.slot = 0, b.phase ^= 1;
          }
        }
        MARK(MK + 2)
        u32 seen = 0;
#pragma unroll
        for (int j = 0; j < J; ++j)
#pragma unroll
          for (int i = 0; i < ACC; ++i) {
            const int part = SIDE > 1 ? 0 : i, kb = j * W + b.warp;
            const bool used = SIDE > 1 ? EXACT || i < side : ALL % PARTS == 0 || round * PARTS + i < ALL;
            const int here = KB < 32 ? KB : ALL * 32 == KB ? 32 : min(32, KB - (round * PARTS + part) * 32);
            if (used && (KB % 32 == 0 || kb < here)) {
              const uint4 w = *(const uint4*)(b.smem + S_RING + slots[i] * SLOT + kb * 512 + b.lane * 16);
              seen ^= w.x;
#pragma unroll
              for (int mt = 0; mt < M; ++mt) {
                const int at = ((mt * PARTS + part) * J + j) * 2;
                mma32(c[i][mt], x[at], x[at + 1], w);
              }
            }
          }
        __syncwarp();
        // A slot may be given back only when the loads above have arrived, not when they are on their way: the copy engine
        // isn't ordered behind them (seen as wrong sums when other loads hold them up). Hence an address that needs them.
        if (b.lane == 0) {
#pragma unroll
          for (int i = 0; i < ACC; ++i)
            if (SIDE > 1 ? EXACT || i < side : ALL % PARTS == 0 || round * PARTS + i < ALL) mbar_arrive(b.empty(slots[i]) + (seen & b.a.zero));
        }
      }
      if (SIDE == 1)
#pragma unroll
        for (int i = 1; i < ACC; ++i)
#pragma unroll
          for (int mt = 0; mt < M; ++mt)
#pragma unroll
            for (int k = 0; k < 4; ++k) c[0][mt][k] += c[i][mt][k];
#pragma unroll
      for (int i = 0; i < SIDE; ++i)
        if (EXACT || i < side)
#pragma unroll
          for (int mt = 0; mt < M; ++mt)
            red[(((inner + i) * M + mt) * W + b.warp) * 32 + b.lane] = make_float4(c[i][mt][0], c[i][mt][1], c[i][mt][2], c[i][mt][3]);
    }
    MARK(MK + 3)
    if (ROUNDS > 1 && first == 0) received();
    consumers_sync();
    MARK(MK + 4)
#pragma unroll 1
    for (int item = b.warp; item < count * M; item += W) {
      float4 sum = red[item * W * 32 + b.lane];
#pragma unroll
      for (int w = 1; w < W; ++w) {
        const float4 v = red[(item * W + w) * 32 + b.lane];
        sum.x += v.x, sum.y += v.y, sum.z += v.z, sum.w += v.w;
      }
      finish(first + item / M, item % M, sum);
    }
    MARK(MK + 5)
  }
}

// Lanes 2i and 2i + 1 hold neighbouring columns of tokens g (a) and g + 8 (c). Afterwards the even lane has both
// columns of token g, the odd lane both of token g + 8, as one word.
__device__ __forceinline__ u32 pair_columns(int t, float a, float c) {
  const float got = __shfl_xor_sync(~0u, t & 1 ? a : c, 1);
  return t & 1 ? pack(got, c) : pack(a, got);
}

// A lane's two columns of tokens g and g + 8. Lanes 2i and 2i + 1 put theirs together and store four columns each.
__device__ __forceinline__ void publish_columns(const Block& b, u32* out, int width, int mt, int col, float4 v) {
  const u32 first = pack(v.x, v.y), second = pack(v.z, v.w), got = __shfl_xor_sync(~0u, b.t & 1 ? first : second, 1);
  const int token = mt * 16 + b.g + (b.t & 1) * 8;
  if (token < T) publish((uint2*)(out + (size_t(token) * width + col + (b.t & 2) * 2) / 2), b.t & 1 ? got : first, b.t & 1 ? second : got);
}

__device__ __forceinline__ float gelu(float x) {
  return 0.5f * x * (1.0f + tanhf(0.7978845608028654f * (x + 0.044715f * x * x * x)));
}

__device__ void qkv_phase(Block& b, int n, int xi) {
  const int first = first_tile(QT, b.cta), last = first_tile(QT, b.cta + 1);
  const float* par = b.param(n);
  u32* out = b.qkv(n);
  product<QT, KBD, 0, RED_TILES, 0, true>(b, b.x1(xi), b.sq1(xi), last - first, [] {}, [&](int tl, int mt, float4 c) {
    const int tile = first + tl, low_token = mt * 16 + b.g, token = low_token + (b.t & 1) * 8;
    const float2 r = make_float2(b.inv_rms()[mt * 16 + b.g], b.inv_rms()[mt * 16 + 8 + b.g]), sh = *(const float2*)(par + PAR_Q + tl * 8 + 2 * b.t);
    const float a0 = c.x * r.x + sh.x, a1 = c.y * r.x + sh.y, c0 = c.z * r.y + sh.x, c1 = c.w * r.y + sh.y;
    if (tile < (NH + 1) * HD / 8) {  // a query or key head: rows i and i + HD/2
      const float2* rope = (const float2*)(b.smem + S_ROPE) + (tl * 4 + b.t) * T;
      const float2 u = low_token < T ? rope[low_token] : make_float2(1, 0);
      const float2 v = low_token + 8 < T ? rope[low_token + 8] : make_float2(1, 0);
      const u32 lo = pair_columns(b.t, a0 * u.x - a1 * u.y, c0 * v.x - c1 * v.y);
      const u32 hi = pair_columns(b.t, a1 * u.x + a0 * u.y, c1 * v.x + c0 * v.y);
      const u32 got = __shfl_xor_sync(~0u, b.t & 2 ? lo : hi, 2);  // lanes 0, 1 store the first half, 2, 3 the second
      const int head = tile / (HD / 8), col = head * HD + tile % (HD / 8) * 4 + (b.t & 2) * (HD / 4);
      if (token < T) publish((uint2*)(out + (token * QW + col) / 2), b.t & 2 ? got : lo, b.t & 2 ? hi : got);
    } else {
      publish_columns(b, out, QW, mt, tile * 8, make_float4(a0, a1, c0, c1));
    }
  });
}

// Publish a tile of the residual stream: times the next norm's scale, and the sums of its squares.
__device__ __forceinline__ void publish_stream(const Block& b, u32* out, u32* squares, int mt, int tile, float4 v, float2 s) {
  float q0 = v.x * v.x + v.y * v.y, q1 = v.z * v.z + v.w * v.w;
  publish_columns(b, out, D, mt, tile * 8, make_float4(v.x * s.x, v.y * s.y, v.z * s.x, v.w * s.y));
#pragma unroll
  for (int o = 1; o < 4; o *= 2) {
    q0 += __shfl_xor_sync(~0u, q0, o);
    q1 += __shfl_xor_sync(~0u, q1, o);
  }
  const int token = mt * 16 + b.g + b.t * 8;
  if (b.t < 2 && token < T) publish(squares + size_t(token) * DT + tile, __float_as_uint(b.t ? q1 : q0));
}

// A product that goes back into the residual stream, which its owner keeps in float32.
template <int KB, int MK>
__device__ __forceinline__ void residual_phase(Block& b, const u32* src, const float* gate, const float* scale, u32* out, u32* squares, int wiped) {
  const int first = first_tile(DT, b.cta), last = first_tile(DT, b.cta + 1);
  product<DT, KB, MK, (RED_TILES < DTL ? RED_TILES : DTL), RED_A, false>(b, src, nullptr, last - first, [&] { if (wiped >= 0) mbar_wait(b.wipe_end(), wiped & 1); }, [&](int tl, int mt, float4 c) {
    const float2 s = *(const float2*)(gate + tl * 8 + 2 * b.t);
    float4* x = b.xres(tl, mt);
    float4 v = *x;
    v.x += s.x * c.x, v.y += s.y * c.y, v.z += s.x * c.z, v.w += s.y * c.w;
    *x = v;
    publish_stream(b, out, squares, mt, first + tl, v, *(const float2*)(scale + tl * 8 + 2 * b.t));
  });
}

__device__ void gate_up_phase(Block& b, int n) {
  const int first = first_tile(GT, b.cta), last = first_tile(GT, b.cta + 1);
  const float* par = b.param(n);
  u32* out = b.hid(n);
  product<GT, KBD, 18, RED_TILES_G, 0, true>(b, b.x2(n), b.sq2(n), last - first, [&] { __syncwarp(); if (b.lane == 0) mbar_arrive(b.wipe_start()); }, [&](int tl, int mt, float4 c) {
    const float2 r = make_float2(b.inv_rms()[mt * 16 + b.g], b.inv_rms()[mt * 16 + 8 + b.g]), sh = *(const float2*)(par + PAR_H + tl * 8 + 2 * b.t);
    const float h0 = gelu(c.x * r.x + sh.x) * (c.y * r.x + sh.y), h1 = gelu(c.z * r.y + sh.x) * (c.w * r.y + sh.y);
    const u32 word = pair_columns(b.t, h0, h1), other = __shfl_xor_sync(~0u, word, 2);
    const int token = mt * 16 + b.g + (b.t & 1) * 8;
    if (b.t < 2 && token < T) publish((uint2*)(out + (token * F + (first + tl) * 4) / 2), word, other);
  });
}

// ---- attention: a unit is one head and one of 16 chunks of the keys

constexpr int KBH = (HD + 31) / 32;
constexpr int QUADS = HD / 4, QPC = (QUADS + CHUNKS - 1) / CHUNKS;  // groups of 4 output columns, those of one unit

struct Span {
  int prefix, first, count;  // keys of this chunk: [first, first + count); those from `prefix` on are the suffix's own
};

__device__ __forceinline__ Span span(int prefix, int chunk) {
  const int keys = prefix + T, each = ((keys + CHUNKS - 1) / CHUNKS + 7) / 8 * 8, first = chunk * each;
  return {prefix, first, max(0, min(each, keys - first))};
}

// Keys of one n8 tile: lane's row g, its 8 columns of every block of 32. `own`: read the suffix's rows, else the prefix's.
__device__ __forceinline__ void load_keys(const Block& b, const Span& s, int tile, const unsigned char* cache, const u32* qkv, bool own, uint4 (&v)[KBH]) {
  const int local = tile * 8 + b.g, key = s.first + local;
  if (local >= s.count || (key >= s.prefix) != own) return;
  if (!own) {
    const uint4* p = (const uint4*)(cache + size_t(key) * HD * 2);
#pragma unroll
    for (int kb = 0; kb < KBH; ++kb)
      if (kb * 32 + b.t * 8 < HD) v[kb] = __ldg(p + kb * 4 + b.t);
  } else {
    const uint4* p[KBH];
    bool take[KBH];
#pragma unroll
    for (int kb = 0; kb < KBH; ++kb) {
      take[kb] = kb * 32 + b.t * 8 < HD;
      p[kb] = (const uint4*)(qkv + (size_t(key - s.prefix) * QW + NH * HD) / 2) + kb * 4 + b.t;
    }
    poll(v, p, take);
  }
}

// Values of 16 keys and this warp's 32 columns: keys 2t, 2t + 1, 2t + 8, 2t + 9, columns 4g..4g+3.
__device__ __forceinline__ void load_values(const Block& b, const Span& s, int step, const unsigned char* cache, const u32* qkv, bool own, uint2 (&v)[4]) {
  const int col = b.warp * 32 + b.g * 4;
  const uint2* p[4];
  bool take[4];
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    const int local = step * 16 + 2 * b.t + (i & 1) + (i >> 1) * 8, key = s.first + local;
    take[i] = local < s.count && (key >= s.prefix) == own && col < HD;
    if (!own && take[i]) v[i] = __ldg((const uint2*)(cache + (size_t(key) * HD + col) * 2));
    p[i] = (const uint2*)(qkv + (size_t(key - s.prefix) * QW + (NH + 1) * HD + col) / 2);
  }
  if (own) poll(v, p, take);
}

__device__ void attend(Block& b, int n, int l, int prefix, int unit) {
  const int head = unit / CHUNKS;
  const Span s = span(prefix, unit % CHUNKS);
  const unsigned char* cache_k = (const unsigned char*)b.a.cache_k + size_t(l) * b.a.layer_stride * 2;
  const unsigned char* cache_v = (const unsigned char*)b.a.cache_v + size_t(l) * b.a.layer_stride * 2;
  const u32* qkv = b.qkv(n);
  unsigned char* area = b.smem + S_RED;
  float* logits = (float*)(area + ATT_S);
  constexpr int AHEAD = 4;  // steps of 16 keys whose values are asked for before the queries are there
  uint4 k[KBH];
  uint2 v[AHEAD][4];
#pragma unroll
  for (int i = 0; i < KBH; ++i) k[i] = make_uint4(0, 0, 0, 0);
#pragma unroll
  for (int i = 0; i < AHEAD; ++i)
#pragma unroll
    for (int j = 0; j < 4; ++j) v[i][j] = make_uint2(0, 0);
  load_keys(b, s, b.warp, cache_k, qkv, false, k);
#pragma unroll
  for (int i = 0; i < AHEAD; ++i) load_values(b, s, i, cache_v, qkv, false, v[i]);

  MARK(6)
  consumers_sync();  // the area was the last product's, or the last unit's
  {                  // queries to shared memory
    constexpr int N = (T * (HD / 8) + CONSUMERS - 1) / CONSUMERS;
    uint4 q[N];
    const uint4* p[N];
    bool take[N];
#pragma unroll
    for (int i = 0; i < N; ++i) {
      const int at = i * CONSUMERS + threadIdx.x, token = at / (HD / 8), piece = at % (HD / 8);
      take[i] = token < T;
      p[i] = (const uint4*)(qkv + (size_t(token) * QW + head * HD) / 2) + piece;
    }
    poll(q, p, take);
#pragma unroll
    for (int i = 0; i < N; ++i) {
      const int at = i * CONSUMERS + threadIdx.x, token = at / (HD / 8), piece = at % (HD / 8);
      if (take[i]) *(uint4*)(area + token * QS * 2 + piece * 16) = q[i];
    }
  }
  MARK(7)
  consumers_sync();
  for (int tile = b.warp; tile * 8 < s.count; tile += W) {
    if (tile != b.warp) {
#pragma unroll
      for (int i = 0; i < KBH; ++i) k[i] = make_uint4(0, 0, 0, 0);
      load_keys(b, s, tile, cache_k, qkv, false, k);
    }
    if (s.first + s.count > s.prefix) load_keys(b, s, tile, cache_k, qkv, true, k);
    __syncwarp();
#pragma unroll
    for (int mt = 0; mt < M; ++mt) {
      float c[2][4] = {};
#pragma unroll
      for (int kb = 0; kb < KBH; ++kb) {
        uint4 lo = make_uint4(0, 0, 0, 0), hi = lo;
        const int token = mt * 16 + b.g, col = kb * 32 + b.t * 8;
        if (col < HD && token < T) lo = *(const uint4*)(area + token * QS * 2 + col * 2);
        if (col < HD && token + 8 < T) hi = *(const uint4*)(area + (token + 8) * QS * 2 + col * 2);
        interleave(lo, hi);
        mma32(c[kb & 1], lo, hi, k[kb]);
      }
      float* row = logits + (mt * 16 + b.g) * SS + tile * 8 + 2 * b.t;
      *(float2*)row = make_float2(c[0][0] + c[1][0], c[0][1] + c[1][1]);
      *(float2*)(row + 8 * SS) = make_float2(c[0][2] + c[1][2], c[0][3] + c[1][3]);
    }
  }
  consumers_sync();
  MARK(8)
  const int padded = (s.count + 15) / 16 * 16;
  const float factor = rsqrtf(float(HD)) * 1.4426950408889634f;
  const int half = b.lane & 15;
#pragma unroll 1
  for (int row0 = b.warp * 2; row0 < T; row0 += W * 2) {  // half a warp takes a row
    const int row = row0 + (b.lane >> 4);
    const float* x = logits + row * SS;
    float top = NEG_INF, sum = 0;
#pragma unroll 1
    for (int i = half; i < s.count; i += 16) top = fmaxf(top, x[i]);
#pragma unroll
    for (int o = 8; o; o >>= 1) top = fmaxf(top, __shfl_xor_sync(~0u, top, o));
#pragma unroll 1
    for (int i = half * 2; i < padded; i += 32) {
      const float e0 = i < s.count ? exp2f((x[i] - top) * factor) : 0, e1 = i + 1 < s.count ? exp2f((x[i + 1] - top) * factor) : 0;
      sum += e0 + e1;
      *(u32*)(area + row * PS * 2 + i * 2) = pack(e0, e1);
    }
#pragma unroll
    for (int o = 8; o; o >>= 1) sum += __shfl_xor_sync(~0u, sum, o);
    if (half == 0 && row < T) publish((uint2*)(b.ml(n, unit) + row * 2), __float_as_uint(top * factor), __float_as_uint(sum));
  }
  consumers_sync();
  MARK(9)
  if (b.warp * 32 < HD) {
    float c[M][4][4];
#pragma unroll
    for (int mt = 0; mt < M; ++mt)
#pragma unroll
      for (int j = 0; j < 4; ++j)
#pragma unroll
        for (int i = 0; i < 4; ++i) c[mt][j][i] = 0;
    for (int base = 0; base * 16 < s.count; base += AHEAD) {
#pragma unroll
      for (int i = 0; i < AHEAD; ++i) {
        if (base > 0) {
#pragma unroll
          for (int j = 0; j < 4; ++j) v[i][j] = make_uint2(0, 0);
          load_values(b, s, base + i, cache_v, qkv, false, v[i]);
        }
        if (s.first + s.count > s.prefix) load_values(b, s, base + i, cache_v, qkv, true, v[i]);
      }
      __syncwarp();
#pragma unroll
      for (int i = 0; i < AHEAD; ++i) {
        if ((base + i) * 16 < s.count) {
          u32 lo[4], hi[4];  // of the four columns: keys 2t, 2t + 1 and keys 2t + 8, 2t + 9
          lo[0] = __byte_perm(v[i][0].x, v[i][1].x, 0x5410), lo[1] = __byte_perm(v[i][0].x, v[i][1].x, 0x7632);
          lo[2] = __byte_perm(v[i][0].y, v[i][1].y, 0x5410), lo[3] = __byte_perm(v[i][0].y, v[i][1].y, 0x7632);
          hi[0] = __byte_perm(v[i][2].x, v[i][3].x, 0x5410), hi[1] = __byte_perm(v[i][2].x, v[i][3].x, 0x7632);
          hi[2] = __byte_perm(v[i][2].y, v[i][3].y, 0x5410), hi[3] = __byte_perm(v[i][2].y, v[i][3].y, 0x7632);
#pragma unroll
          for (int mt = 0; mt < M; ++mt) {
            const unsigned char* p = area + (mt * 16 + b.g) * PS * 2 + ((base + i) * 16 + 2 * b.t) * 2;
            const u32 a0 = *(const u32*)p, a1 = *(const u32*)(p + 8 * PS * 2);
            const u32 a2 = *(const u32*)(p + 16), a3 = *(const u32*)(p + 8 * PS * 2 + 16);
#pragma unroll
            for (int j = 0; j < 4; ++j) mma(c[mt][j], a0, a1, a2, a3, lo[j], hi[j]);
          }
        }
      }
    }
    const int col = b.warp * 32 + b.t * 8;  // n8 tile j holds columns 4n + j
#pragma unroll
    for (int mt = 0; mt < M; ++mt)
#pragma unroll
      for (int row = 0; row < 2; ++row) {
        const int token = mt * 16 + row * 8 + b.g;
        if (token < T && col < HD) {
          uint4* p = (uint4*)(b.part(n, unit) + token * HD + col);
#pragma unroll
          for (int i = 0; i < 2; ++i)
            publish(p + i, __float_as_uint(c[mt][0][row * 2 + i]), __float_as_uint(c[mt][1][row * 2 + i]),
                    __float_as_uint(c[mt][2][row * 2 + i]), __float_as_uint(c[mt][3][row * 2 + i]));
        }
      }
  }
}

// Put a head's chunks together, for this unit's share of its columns. Half a warp takes one token's four columns.
__device__ void combine(Block& b, int n, int unit) {
  const int head = unit / CHUNKS, quad0 = unit % CHUNKS * QPC, quads = max(0, min(QPC, QUADS - quad0)), chunk = b.lane & 15;
  if (quads > 0) wait_for((const uint4*)(b.part(n, head * CHUNKS + chunk) + (T - 1) * HD) + quad0);
  __syncwarp();
  constexpr int ITEMS = (T * QPC + 2 * W - 1) / (2 * W), GROUP = ITEMS < 4 ? ITEMS : 4;
  for (int base = 0; base < ITEMS; base += GROUP) {
    uint4 v[GROUP];
    uint2 ml[GROUP];
    const uint4* pv[GROUP];
    const uint2* pm[GROUP];
    bool take[GROUP];
#pragma unroll
    for (int i = 0; i < GROUP; ++i) {
      const int item = (base + i) * 2 * W + b.warp * 2 + (b.lane >> 4), token = item / QPC, quad = item % QPC;
      take[i] = token < T && quad < quads;
      pv[i] = (const uint4*)(b.part(n, head * CHUNKS + chunk) + token * HD) + quad0 + quad;
      pm[i] = (const uint2*)b.ml(n, head * CHUNKS + chunk) + token;
      v[i] = make_uint4(0, 0, 0, 0), ml[i] = make_uint2(0, 0);
    }
    poll(ml, pm, take);
    poll(v, pv, take);
    __syncwarp();
#pragma unroll
    for (int i = 0; i < GROUP; ++i) {
      const int item = (base + i) * 2 * W + b.warp * 2 + (b.lane >> 4), token = item / QPC, quad = item % QPC;
      const float m = __uint_as_float(ml[i].x);
      float top = m;
#pragma unroll
      for (int o = 8; o; o >>= 1) top = fmaxf(top, __shfl_xor_sync(~0u, top, o));
      const float w = m == NEG_INF ? 0 : exp2f(m - top);
      float s[5] = {__uint_as_float(ml[i].y) * w, __uint_as_float(v[i].x) * w, __uint_as_float(v[i].y) * w,
                    __uint_as_float(v[i].z) * w, __uint_as_float(v[i].w) * w};
#pragma unroll
      for (int o = 8; o; o >>= 1)
#pragma unroll
        for (int j = 0; j < 5; ++j) s[j] += __shfl_xor_sync(~0u, s[j], o);
      const float inv = 1.0f / s[0];
      if (take[i] && chunk == 0)
        publish((uint2*)(b.att(n) + (token * OW + head * HD + (quad0 + quad) * 4) / 2), pack(s[1] * inv, s[2] * inv), pack(s[3] * inv, s[4] * inv));
    }
  }
}

// ---- between steps

// x_t to the residual stream: action_in_proj, this CTA's columns.
__device__ void embed(Block& b, int step, int xi) {
  const float* scale = b.a.table + size_t(step) * (2 * L + 1) * 3 * D;
  const int first = first_tile(DT, b.cta), tiles = first_tile(DT, b.cta + 1) - first;
  const float* w = (const float*)(b.smem + S_WIN);
  const float* bias = w + DTL * 8 * A;
  for (int item = b.warp; item < tiles * M; item += W) {
    const int tile = item / M, mt = item % M, token = mt * 16 + b.g, row = tile * 8 + 2 * b.t;
    float4 c = make_float4(bias[row], bias[row + 1], bias[row], bias[row + 1]);
    const float* x0 = b.xt() + min(token, T - 1) * A;
    const float* x1 = b.xt() + min(token + 8, T - 1) * A;
#pragma unroll 8
    for (int k = 0; k < A; ++k) {
      c.x += w[row * A + k] * x0[k], c.y += w[(row + 1) * A + k] * x0[k];
      c.z += w[row * A + k] * x1[k], c.w += w[(row + 1) * A + k] * x1[k];
    }
    *b.xres(tile, mt) = c;
    publish_stream(b, b.x1(xi), b.sq1(xi), mt, first + tile, c, __ldg((const float2*)(scale + first * 8 + row)));
  }
}

// Final norm, action_out_proj and the Euler step. A warp takes one number of v_t; every CTA then updates all of x_t.
__device__ void advance(Block& b, int step, int xi) {
  constexpr int PIECES = (D / 8 + 31) / 32, COLS = (DT / 4 + 31) / 32;
#pragma unroll 1
  for (int item = b.warp * G + b.cta; item < T * A; item += W * G) {
    const int token = item / A, out = item % A;
    float w[PIECES][8];
    uint4 x[PIECES + COLS];
    const uint4* p[PIECES + COLS];
    bool take[PIECES + COLS];
    const float shift = __ldg(b.a.out_shift + step * A + out);
#pragma unroll
    for (int i = 0; i < PIECES; ++i) {
      const int at = i * 32 + b.lane;
      take[i] = at < D / 8;
      p[i] = (const uint4*)(b.x1(xi) + size_t(token) * D / 2) + at;
      x[i] = make_uint4(0, 0, 0, 0);
#pragma unroll
      for (int k = 0; k < 8; ++k) w[i][k] = take[i] ? __ldg(b.a.out_w + size_t(out) * D + at * 8 + k) : 0;
    }
#pragma unroll
    for (int i = 0; i < COLS; ++i) {
      const int at = i * 32 + b.lane;
      take[PIECES + i] = at < DT / 4;
      p[PIECES + i] = (const uint4*)(b.sq1(xi) + size_t(token) * DT) + at;
      x[PIECES + i] = make_uint4(0, 0, 0, 0);
    }
    poll<PIECES>(x, p, take);
    __syncwarp();
    float sq = 0, dot = 0;
#pragma unroll
    for (int i = 0; i < PIECES; ++i) {
      const u32 words[4] = {x[i].x, x[i].y, x[i].z, x[i].w};
#pragma unroll
      for (int k = 0; k < 4; ++k) dot += low(words[k]) * w[i][2 * k] + high(words[k]) * w[i][2 * k + 1];
    }
#pragma unroll
    for (int i = PIECES; i < PIECES + COLS; ++i)
      sq += (__uint_as_float(x[i].x) + __uint_as_float(x[i].y)) + (__uint_as_float(x[i].z) + __uint_as_float(x[i].w));
#pragma unroll
    for (int o = 16; o; o >>= 1) {
      sq += __shfl_xor_sync(~0u, sq, o);
      dot += __shfl_xor_sync(~0u, dot, o);
    }
    if (b.lane == 0) publish(b.vel(step) + item, __float_as_uint(dot * rsqrtf(sq * (1.0f / D) + b.a.eps) + shift));
  }
  constexpr int N = (T * A / 4 + CONSUMERS - 1) / CONSUMERS;
  uint4 v[N];
  const uint4* p[N];
  bool take[N];
#pragma unroll
  for (int i = 0; i < N; ++i) {
    const int at = i * CONSUMERS + threadIdx.x;
    take[i] = at < T * A / 4;
    p[i] = (const uint4*)b.vel(step) + at;
  }
  poll<0>(v, p, take);
#pragma unroll
  for (int i = 0; i < N; ++i) {
    const int at = i * CONSUMERS + threadIdx.x;
    if (take[i]) {
      float4* slot = (float4*)b.xt() + at;
      float4 x = *slot;
      const float4 f = make_float4(__uint_as_float(v[i].x), __uint_as_float(v[i].y), __uint_as_float(v[i].z), __uint_as_float(v[i].w));
      x.x = __fadd_rn(x.x, __fmul_rn(b.a.dt, f.x)), x.y = __fadd_rn(x.y, __fmul_rn(b.a.dt, f.y));
      x.z = __fadd_rn(x.z, __fmul_rn(b.a.dt, f.z)), x.w = __fadd_rn(x.w, __fmul_rn(b.a.dt, f.w));
      *slot = x;
      if (b.cta == 0) {
        ((float4*)b.a.v_t)[size_t(step) * (T * A / 4) + at] = f;
        ((float4*)b.a.x_t)[size_t(step + 1) * (T * A / 4) + at] = x;
      }
    }
  }
  consumers_sync();
}

// Wipe what this CTA wrote and everyone has read, in three warps that do nothing else. Called when all CTAs have sent their part of x2(n), so each is past
// attention of layer n, and past the feed-forward of layer n - 1.
__device__ void wipe(Block& b, int n, int step, int l, int xi) {
  constexpr int CLEANERS = 96;
  const int d0 = first_tile(DT, b.cta), dn = first_tile(DT, b.cta + 1) - d0, me = threadIdx.x - CONSUMERS - 32;
#pragma unroll 1
  for (int i = me; i < dn * T; i += CLEANERS) {
    const size_t at = (size_t(i / dn) * D + (d0 + i % dn) * 8) / 2;
    publish((uint4*)(b.x1(xi) + at), EMPTY, EMPTY, EMPTY, EMPTY);
    if (l == 0 && step > 0) publish((uint4*)(b.x1(xi - 1) + at), EMPTY, EMPTY, EMPTY, EMPTY);
    if (n > 0) publish((uint4*)(b.x2(n - 1) + at), EMPTY, EMPTY, EMPTY, EMPTY);
  }
#pragma unroll 1
  for (int i = me; i < dn * T; i += CLEANERS) {
    const size_t at = size_t(i / dn) * DT + d0 + i % dn;
    publish(b.sq1(xi) + at, EMPTY);
    if (l == 0 && step > 0) publish(b.sq1(xi - 1) + at, EMPTY);
    if (n > 0) publish(b.sq2(n - 1) + at, EMPTY);
  }
  const int q0 = first_tile(QT, b.cta), qn = first_tile(QT, b.cta + 1) - q0;
#pragma unroll 1
  for (int i = me; i < qn * T * 2; i += CLEANERS) {
    const int half = i & 1, tile = q0 + (i >> 1) % qn, token = (i >> 1) / qn, head = tile / (HD / 8);
    const int col = head <= NH ? head * HD + tile % (HD / 8) * 4 + half * (HD / 2) : tile * 8 + half * 4;
    publish((uint2*)(b.qkv(n) + (token * QW + col) / 2), EMPTY, EMPTY);
  }
  const int h0 = first_tile(GT, b.cta), hn = first_tile(GT, b.cta + 1) - h0;
  if (n > 0)
  #pragma unroll 1
  for (int i = me; i < hn * T; i += CLEANERS)
      publish((uint2*)(b.hid(n - 1) + (size_t(i / hn) * F + (h0 + i % hn) * 4) / 2), EMPTY, EMPTY);
  for (int unit = b.cta; unit < NH * CHUNKS; unit += G) {
    uint4* part = (uint4*)b.part(n, unit);
  #pragma unroll 1
  for (int i = me; i < T * HD / 4; i += CLEANERS) publish(part + i, EMPTY, EMPTY, EMPTY, EMPTY);
  #pragma unroll 1
  for (int i = me; i < T; i += CLEANERS) publish((uint2*)b.ml(n, unit) + i, EMPTY, EMPTY);
    const int head = unit / CHUNKS, quad0 = unit % CHUNKS * QPC, quads = max(0, min(QPC, QUADS - quad0));
  #pragma unroll 1
  for (int i = me; i < T * QPC; i += CLEANERS)
      if (i % QPC < quads) publish((uint2*)(b.att(n) + (i / QPC * OW + head * HD + (quad0 + i % QPC) * 4) / 2), EMPTY, EMPTY);
  }
  if (l == 0 && step > 0)
    for (int i = me; b.cta + i * G < T * A; i += CLEANERS) publish(b.vel(step - 1) + b.cta + i * G, EMPTY);
  __threadfence();
}

// The cleaners' loop: wait until the consumers have all of x2(n), wipe, and let them publish x1 again.
__device__ void clean(Block& b) {
  for (int step = 0, n = 0, xi = 0; step < b.a.steps; ++step, ++xi)
    for (int l = 0; l < L; ++l, ++n, ++xi) {
      mbar_wait(b.wipe_start(), n & 1);
      wipe(b, n, step, l, xi);
      __syncwarp();
      if (b.lane == 0) mbar_arrive(b.wipe_end());
    }
}

// ---- the loop

__device__ void consume(Block& b) {
  const Args& a = b.a;
  const int prefix = int(*a.length);
  for (int i = threadIdx.x; i < T * A; i += CONSUMERS) {
    const float x = a.noise[i];
    b.xt()[i] = x;
    if (b.cta == 0) a.x_t[i] = x;
  }
  const int q0 = first_tile(QT, b.cta), qn = first_tile(QT, b.cta + 1) - q0;
  for (int i = threadIdx.x; i < qn * 4 * T; i += CONSUMERS) {
    const int tile = q0 + i / (4 * T), row = tile % (HD / 8) * 4 + i / T % 4, token = i % T;
    float sine, cosine;
    sincosf(float(prefix + token) * a.inv_freq[row], &sine, &cosine);
    ((float2*)(b.smem + S_ROPE))[i] = make_float2(cosine, sine);
  }
  const int d0 = first_tile(DT, b.cta), dn = first_tile(DT, b.cta + 1) - d0;
  float* w = (float*)(b.smem + S_WIN);
  for (int i = threadIdx.x; i < dn * 8 * A; i += CONSUMERS) w[i] = a.in_w[d0 * 8 * A + i];
  for (int i = threadIdx.x; i < dn * 8; i += CONSUMERS) w[DTL * 8 * A + i] = a.in_b[d0 * 8 + i];
#ifdef TP_TRACE
  if (threadIdx.x < 64) ((u32*)(b.smem + S_BAR + 512))[threadIdx.x] = threadIdx.x ? 0 : u32(clock64());
#endif
  consumers_sync();
  int n = 0, xi = 0;
  for (int step = 0; step < a.steps; ++step) {
    embed(b, step, xi);
    for (int l = 0; l < L; ++l, ++n, ++xi) {
      mbar_wait(b.param_full(n & 1), (n >> 1) & 1);
      qkv_phase(b, n, xi);
      for (int unit = b.cta; unit < NH * CHUNKS; unit += G) attend(b, n, l, prefix, unit);
      for (int unit = b.cta; unit < NH * CHUNKS; unit += G) { MARK(10) combine(b, n, unit); }
      MARK(11)
      consumers_sync();  // attention's shared memory is the reduction's again
      residual_phase<KBO, 12>(b, b.att(n), b.param(n) + PAR_G1, b.param(n) + PAR_S2, b.x2(n), b.sq2(n), -1);
      gate_up_phase(b, n);
      MARK(24)
      residual_phase<KBF, 25>(b, b.hid(n), b.param(n) + PAR_G2, b.param(n) + PAR_S1, b.x1(xi + 1), b.sq1(xi + 1), n);
      __syncwarp();
      if (b.lane == 0) mbar_arrive(b.param_empty(n & 1));
    }
    advance(b, step, xi);
    ++xi;
    MARK(31)
  }
#ifdef TP_TRACE
  consumers_sync();
  if (threadIdx.x < 64) a.scratch[B_P + b.cta * 64 + threadIdx.x] = ((u32*)(b.smem + S_BAR + 512))[1 + threadIdx.x];
#endif
}

// Three warpgroups: registers are dealt out by warpgroup, and only the two of consumers need many.
constexpr int THREADS = CONSUMERS + 128;

extern "C" __global__ void __launch_bounds__(THREADS, 1) turbopi_denoise(const __grid_constant__ Args args) {
  extern __shared__ __align__(128) unsigned char smem[];
  Block b(args, smem);
  if (threadIdx.x == 0) {
    for (int i = 0; i < STAGES; ++i) mbar_init(b.full(i), 1), mbar_init(b.empty(i), W);
    for (int i = 0; i < 2; ++i) mbar_init(b.param_full(i), 1), mbar_init(b.param_empty(i), W);
    mbar_init(b.wipe_start(), W), mbar_init(b.wipe_end(), 3);
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
  }
  __syncthreads();
  if (b.warp < W) {
    asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(W == 8 ? 232 : 112));
    consume(b);
  } else {
    asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(W == 8 ? 40 : 24));
    if (b.warp > W)
      clean(b);
    else if (b.lane == 0)
      produce(b);
  }
}
