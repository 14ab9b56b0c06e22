// The whole denoising loop of Pi0.5's action expert, all layers and steps, in one kernel of resident clusters.
// Part 1 of 4, which denoise_cluster.py puts together: sizes, shared memory, primitives.
//
// NC clusters of S CTAs stay resident. Cluster c owns query head c (the first NH clusters do), 1/NC of the
// feed-forward's hidden units and, with the other attention clusters, 1/NH of the key and value columns. Rank r of each
// cluster owns the r-th slice of the residual stream's columns; all NC clusters keep the same stream, in float32
// registers.
//
// What a cluster's CTAs tell each other goes through distributed shared memory (st.async, counted in by an mbarrier of
// the receiver: no cluster barriers). What crosses clusters are sums over heads or over hidden units, two exchanges a
// layer between the CTAs of equal rank, and the suffix's keys and values. Those words go through L2 and carry their own
// flag: the lowest bit of a float32 tells its use of the buffer, so the reader asks for a word until that bit is right.
//
// Units: a "block" is 16 columns of a reduction axis, a "tile" 16 output rows, a "fragment" one tile x one block of a
// weight matrix in the order in which a warp's lanes feed it to the tensor cores (operand A; tokens are operand B).
// Activations lie in shared memory as [block][8 tokens][32 lanes][8 bytes], B's order. Inside a block the order of the
// 16 columns is free as long as both operands agree: "permuted" order gives lane t columns 4t..4t+3 (one 8-byte store),
// "standard" order 2t, 2t+1, 2t+8, 2t+9, as ldmatrix brings keys and values.

typedef unsigned int u32;
typedef unsigned long long u64;
typedef unsigned char byte;

constexpr int D = TP_D, F = TP_F, L = TP_L, NH = TP_NH, HD = TP_HD, T = TP_T, A = TP_A;
constexpr int S = TP_S, NC = TP_NC;                                   // CTAs of a cluster, clusters
constexpr int KEYS = TP_KEYS;                                         // prefix keys of one rank, at most
constexpr int W = 16, CONSUMERS = W * 32, THREADS = CONSUMERS + 128;  // registers are dealt out by warpgroup
constexpr int NT = (T + 7) / 8;
constexpr int D16 = D / 16, F16 = F / 16, QT = HD / 16, KVT = HD / 8;

// n things shared out between `parts`: which is the first of part i, and how many a part has at most.
__host__ __device__ constexpr int share(int n, int parts, int i) { return n * i / parts; }
__host__ __device__ constexpr int most(int n, int parts) { return (n + parts - 1) / parts; }
__host__ __device__ constexpr int imax(int a, int b) { return a > b ? a : b; }
__host__ __device__ constexpr int up128(int x) { return (x + 127) / 128 * 128; }

constexpr int DX = most(D16, S);           // blocks (and output tiles) of a slice of the stream
constexpr int HC = most(F16, NC);          // hidden blocks of a cluster
constexpr int GTL = most(2 * HC, S);       // gate|up tiles of a CTA: 8 hidden units each
constexpr int QTL = most(QT, S);           // query tiles of a CTA: 8 RoPE pairs each
constexpr int KVL = most(KVT, NH* S);      // key and value tiles of a CTA
constexpr int TILES = QTL + KVL + GTL;     // of a CTA with rows of their own in `shifted`
constexpr int ITEMS_X = most(DX * NT, W);  // (tile, 8 tokens) of the slice that one warp looks after
static_assert(D % 16 == 0 && F % 16 == 0 && HD % 16 == 0 && HD <= 256 && T <= 64 && NC >= NH && A <= CONSUMERS,
              "sizes");

// A product's tiles are multiplied in groups of 8, 4, 2 or 1. In each, the W warps form MG rows of tiles and KS parts
// of the reduction; WIDE groups of 8 let a warp take two tiles, for half the reads of the activations.
__host__ __device__ constexpr int group_tiles(int left) { return left >= 8 ? 8 : left >= 4 ? 4 : left >= 2 ? 2 : 1; }
template <int TILES_, bool WIDE>
struct Group {
  static constexpr int TPW = TILES_ == 8 && WIDE ? 2 : 1, MG = TILES_ / TPW, KS = W / MG, PARTIALS = TILES_ * KS;
};
__host__ __device__ constexpr int plan_tpw(int mt, bool wide) {  // tiles a warp takes in all groups
  int n = 0;
  for (; mt > 0; mt -= group_tiles(mt)) n += group_tiles(mt) == 8 && wide ? 2 : 1;
  return n;
}
__host__ __device__ constexpr int plan_partials(int mt, bool wide) { return plan_tpw(mt, wide) * W; }
constexpr int PARTIAL = NT * 512;  // bytes of one tile's partial sums

// ---- shared memory

constexpr int RS = HD * 2 + 16;  // bytes of a key's or value's row: no bank conflicts for ldmatrix
constexpr int FRAGMENT = 512, ROW = W * FRAGMENT, RPS = TP_RPS;  // a row: one fragment per warp; rows per slot
constexpr int SLOT_TILES = RPS, SLOT_KEYS = SLOT_TILES * 16;
constexpr int SLOT = up128(imax(RPS * ROW, SLOT_KEYS * RS));
constexpr int KT = most(KEYS, SLOT_KEYS) * SLOT_TILES;  // tiles of a rank's prefix keys
constexpr int SUFFIX = most(T, S);                      // suffix keys of a rank, at most 16
static_assert(SUFFIX <= 16, "more suffix keys than a tile");
// In small models a CTA may have no hidden units. It sends a word in their place, to keep the others from running
// ahead.
constexpr bool IDLE = 2 * (F16 / NC) < S;
constexpr int LS = (KT + 1) * 16 + 4;  // floats of a token's logits

// A message lands without asking, so its place must be free at every receiver before any sender can have it. What makes
// it so: a rank goes on only with what it got from all ranks of its cluster, and each sends its part of an exchange
// when it is done with all before it in the program (the squares of a slice, for one, follow a barrier of the CTA's
// warps).
//
// Region X holds the stream (operand of qkv and gate|up). When those have read it, their partial sums lie there, then
// attention's logits, probabilities, suffix keys and values, and the partial outputs that other ranks send.
//   sums of qkv over the stream: nothing is sent to X before a peer has this rank's queries, sent when they are read
//   attention's outputs over them: so they land later still; the next slice follows attention's maxima of all ranks
//   sums of gate|up over the stream: the next slice lands when a peer has this rank's hidden units, made of those sums
constexpr int X_BYTES = D16 * NT * 256;
constexpr int X_ML = 0, X_COMB = X_ML + up128(S * T * 8), X_LOGITS = X_COMB + S * QTL * PARTIAL;
constexpr int X_P = X_LOGITS + up128(T * LS * 4), X_SUFFIX = X_P + (KT + 1) * NT * 256;
constexpr int X_VPART = 0, X_XS = up128(S * T * A * 4);  // between steps
constexpr int X_SIZE =
    up128(imax(imax(X_BYTES, X_SUFFIX + 2 * SUFFIX * RS),
               imax(imax(plan_partials(QTL, true) + plan_partials(KVL, true), plan_partials(GTL, true)) * PARTIAL,
                    X_XS + DX * 16 * T * 4)));
// Region H: queries and attention's output, or the hidden units; then the partial sums of out and of down; between
// steps x_t. Hidden units, or queries, land when a peer has this rank's slice, which follows out's, or down's, sums.
constexpr int H_Q = 0, H_ATT = QT * NT * 256, H_BYTES = imax(2 * QT, HC) * NT * 256;
constexpr int H_SIZE = up128(imax(imax(H_BYTES, plan_partials(DX, false) * PARTIAL), T * A * 4));

constexpr int M_X = 0, M_H = M_X + X_SIZE, M_SSQ = M_H + H_SIZE;  // M_SSQ: float32[S][NT * 8], sums of squares by slice
constexpr int M_PART = M_SSQ + up128(S * NT * 32);                // the same of this slice, by tile
constexpr int M_BAR = M_PART + up128(DX * NT * 32), M_PROGRESS = M_BAR + 248, M_TOKEN = M_BAR + 252,
              M_RING = M_BAR + 512;
constexpr int STAGES = (TP_SMEM - M_RING) / SLOT < 12 ? (TP_SMEM - M_RING) / SLOT : 12;
static_assert(STAGES >= 2, "too little shared memory");

enum Barrier { BAR_X, BAR_Q, BAR_COMB, BAR_ATT, BAR_HID, BAR_V, BAR_GO, BAR_RING };  // ring: full and empty, by slot

// ---- scratch in global memory, in 16-byte words

constexpr size_t N_STREAM = size_t(NC) * D16 * NT * 32;  // partial sums of the stream, of all clusters
constexpr size_t N_KV = size_t(T) * HD / 2;              // suffix keys and values, float32[T][2 HD]
constexpr size_t B_X1 = 0, B_X2 = 2 * N_STREAM, B_KV = 4 * N_STREAM, SCRATCH = B_KV + 2 * N_KV;
static_assert(SCRATCH == TP_SCRATCH, "denoise_cluster.py disagrees on the scratch memory");

struct Args {
  const byte* weights;      // fragments [L][layer_bytes], a CTA's in the order in which it uses them
  const long long* starts;  // [NC * S]: where a CTA's begin in a layer, bytes
  const float* table;       // [N][2L+1][3][D]: scale, shift, gate
  const float* shifted;     // [N][L][NC * S][TILES][16]: W shift
  const float* out_w;       // [D][A]
  const float* out_shift;   // [N][A]: action_out_proj of the final norm's shift, and its bias
  const float* in_w;        // [D][A]
  const float* in_b;        // [D]
  const float* inv_freq;    // [HD/2]
  const byte* cache_k;      // bf16 [L][rows][HD], layer_stride bytes from layer to layer
  const byte* cache_v;
  const long long* length;  // valid rows
  const float* noise;       // [T][A]
  float* x_t;               // [N+1][T][A]
  float* v_t;               // [N][T][A]
  uint4* scratch;           // zero at the start
  u32* hang;                // [NC * S] host memory: see `watch`
  u32* trace;
  long long layer_stride, layer_bytes;
  int steps;
  float dt, eps;
  u32 zero;  // 0, which the compiler doesn't know
};

// ---- a CTA's view

struct Block {
  const Args& a;
  byte* smem;
  u32 base;  // of smem in the shared window
  int cluster, rank, warp, lane;
  int n = 0;                // layers done
  u32 slot = 0, phase = 0;  // of the ring
  u32 x_parity = 0;

  __device__ Block(const Args& args, byte* s) : a(args), smem(s), base(u32(__cvta_generic_to_shared(s))) {
    u32 r;
    asm("mov.u32 %0, %%cluster_ctarank;" : "=r"(r));
    cluster = blockIdx.x / S, rank = int(r), warp = threadIdx.x >> 5, lane = threadIdx.x & 31;
    forget();
  }
  // Make the compiler forget what these are made of: what it derives from them it would keep in registers, or in local
  // memory, over all layers, and a fetch from there costs more than to derive it again.
  __device__ __forceinline__ void forget() { asm volatile("" : "+r"(base), "+r"(rank), "+r"(warp), "+r"(lane)); }
  __device__ __forceinline__ int g() const { return lane >> 2; }  // a lane's place in the tensor cores' operands
  __device__ __forceinline__ int t() const { return lane & 3; }
  __device__ __forceinline__ u32 bar(int i) const { return base + M_BAR + i * 8; }
  __device__ __forceinline__ u32 full(u32 s) const { return base + M_BAR + BAR_RING * 8 + s * 16; }
  __device__ __forceinline__ u32 empty(u32 s) const { return full(s) + 8; }
  __device__ __forceinline__ byte* ring(u32 s) const { return smem + M_RING + s * SLOT; }
  __device__ __forceinline__ bool attends() const { return NC == NH || cluster < NH; }
  // blocks of the stream's slice, hidden blocks of the cluster, tiles of the CTA
  __device__ __forceinline__ int x0() const { return share(D16, S, rank); }
  __device__ __forceinline__ int xn() const { return D16 % S == 0 ? DX : share(D16, S, rank + 1) - x0(); }
  __device__ __forceinline__ int hn() const {
    return F16 % NC == 0 ? HC : share(F16, NC, cluster + 1) - share(F16, NC, cluster);
  }
  __device__ __forceinline__ int g0() const { return share(2 * hn(), S, rank); }
  __device__ __forceinline__ int gn() const {
    return F16 % NC == 0 && 2 * HC % S == 0 ? GTL : share(2 * hn(), S, rank + 1) - g0();
  }
  __device__ __forceinline__ int q0() const { return share(QT, S, rank); }
  __device__ __forceinline__ int qn() const { return QT % S == 0 ? QTL : share(QT, S, rank + 1) - q0(); }
  __device__ __forceinline__ int kv0() const { return share(KVT, NH * S, cluster * S + rank); }
  __device__ __forceinline__ int kvn() const { return share(KVT, NH * S, cluster * S + rank + 1) - kv0(); }
};

// Cycles up to each mark, summed up: 0 stream here, 1 qkv multiplied, 2 sent, 3 queries here, 4 prefix scored, 5 suffix
// scored, 6 softmax, 7 values weighed, 8 outputs here, 9 combined, 10 attention here, 11 out, 12 gathered, 13 stream
// here, 15 gate|up multiplied, 16 sent, 17 hidden here, 18 down, 14 gathered, 19 embedded, 20 step done.
#ifdef TP_TRACE
#define MARK(i)                              \
  if (threadIdx.x == 0) {                    \
    const u32 now_ = u32(clock64());         \
    u32* m_ = (u32*)(b.smem + M_RING - 256); \
    m_[1 + (i)] += now_ - m_[0];             \
    m_[0] = now_;                            \
  }
#else
#define MARK(i)
#endif

// ---- waiting

// Waits are short loops without an end of their own; a spare warp watches instead. Where the first thread waits is a
// word in shared memory, and if that stays the same for seconds the kernel says where (in memory of the host, which
// outlives the trap; [NC * S] words: 1 << 31 | what << 20 | layer) and traps.
enum What {
  WAIT_NONE,
  WAIT_X,
  WAIT_Q,
  WAIT_KV,
  WAIT_COMB,
  WAIT_ATT,
  WAIT_X2,
  WAIT_HID,
  WAIT_X1,
  WAIT_V,
  WAIT_GO,
  FINISHED
};
__device__ __forceinline__ void note(const Block& b, int what) {
  if (threadIdx.x == 0) *(volatile u32*)(b.smem + M_PROGRESS) = u32(what) << 20 | u32(b.n);
}
// What the norms of layer n need, to L2: it is read once, by everybody at the same time, while memory is busy with
// weights.
__device__ __forceinline__ void prefetch(const Block& b, int n) {
  const int step = n / L, l = n % L;
  if (step >= b.a.steps) return;
  auto lines = [&](const float* from, int floats) {
#pragma unroll 1
    for (int i = b.lane * 32; i < floats; i += 32 * 32) asm volatile("prefetch.global.L2 [%0];" ::"l"(from + i));
  };
  const float* table = b.a.table + (size_t(step) * (2 * L + 1) + 2 * l) * 3 * D + b.x0() * 16;
  lines(b.a.shifted + (size_t(n) * (NC * S) + b.cluster * S + b.rank) * TILES * 16, TILES * 16);
  lines(table + 2 * D, b.xn() * 16), lines(table + 3 * D, b.xn() * 16);
  lines(table + 5 * D, b.xn() * 16), lines(table + 6 * D, b.xn() * 16);
}
__device__ __forceinline__ void watch(const Block& b) {
  u32 last = 0, layer = ~0u;
  long long since = clock64();
  prefetch(b, 0);
#pragma unroll 1
  for (u32 now = 0; now >> 20 != FINISHED; __nanosleep(500)) {
    now = *(volatile u32*)(b.smem + M_PROGRESS);
    if ((now & 0xfffff) != layer) layer = now & 0xfffff, prefetch(b, int(layer) + 1);
    if (now != last) {
      last = now, since = clock64();
    } else if (clock64() - since > 4000000000ll) {
      *(volatile u32*)(b.a.hang + blockIdx.x) = 1u << 31 | now;
      __threadfence_system();
      const long long end = clock64() + 1000000000ll;  // for the other CTAs to say where they are
#pragma unroll 1
      while (clock64() < end) __nanosleep(10000);
      __trap();
    }
  }
}

__device__ __forceinline__ void mbar_wait(u32 bar, u32 parity) {
  asm volatile(
      "{\n"
      ".reg .pred p;\n"
      "AGAIN:\n"
      "mbarrier.try_wait.parity.shared::cta.b64 p, [%0], %1;\n"
      "@p bra DONE;\n"
      "bra AGAIN;\n"
      "DONE:\n"
      "}" ::"r"(bar),
      "r"(parity)
      : "memory");
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
// All threads wait for use n of an exchange in the cluster; one of them arms the barrier for the next.
__device__ __forceinline__ void receive(const Block& b, int bar, int n, u32 bytes, int what) {
  note(b, what);
  mbar_wait(b.bar(bar), n & 1);
  __syncwarp();
  if (threadIdx.x == 0) mbar_expect(b.bar(bar), bytes);
}
__device__ __forceinline__ void consumers_sync() {
  __syncwarp();  // lanes leave a wait one by one, and this barrier counts warps
  asm volatile("bar.sync 1, %0;" ::"n"(CONSUMERS) : "memory");
}
__device__ __forceinline__ void cluster_sync() {
  asm volatile("barrier.cluster.arrive.release.aligned;\nbarrier.cluster.wait.acquire.aligned;" ::: "memory");
}

// ---- moving data

__device__ __forceinline__ u32 at_rank(u32 address, int rank) {
  u32 x;
  asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(x) : "r"(address), "r"(rank));
  return x;
}
// An address at all ranks. All of them first, as a send reads its registers late.
struct Everyone {
  u32 at[S];
  __device__ __forceinline__ explicit Everyone(u32 address) {
#pragma unroll
    for (int d = 0; d < S; ++d) at[d] = at_rank(address, d);
  }
};
__device__ __forceinline__ void send(u32 to, u32 v, u32 bar) {
  asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.b32 [%0], %1, [%2];" ::"r"(to), "r"(v),
               "r"(bar)
               : "memory");
}
__device__ __forceinline__ void send(u32 to, u32 v, u32 w, u32 bar) {
  asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v2.b32 [%0], {%1, %2}, [%3];" ::"r"(to),
               "r"(v), "r"(w), "r"(bar)
               : "memory");
}
__device__ __forceinline__ void send(u32 to, float4 v, u32 bar) {
  asm volatile(
      "st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v4.b32 [%0], {%1, %2, %3, %4}, [%5];" ::"r"(to),
      "r"(__float_as_uint(v.x)), "r"(__float_as_uint(v.y)), "r"(__float_as_uint(v.z)), "r"(__float_as_uint(v.w)),
      "r"(bar)
      : "memory");
}
__device__ __forceinline__ void bulk_load(u32 to, const void* from, u32 bytes, u32 bar, u64 policy) {
  asm volatile(
      "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes.L2::cache_hint [%0], [%1], %2, [%3], %4;" ::
          "r"(to),
      "l"(from), "r"(bytes), "r"(bar), "l"(policy)
      : "memory");
}

// Words through L2 whose lowest bit is their flag. Use n of a double buffer carries bit `flag(n)`: 1, 1, 0, 0, 1, ...
__device__ __forceinline__ u32 flag(int n) { return ((n >> 1) & 1) ^ 1; }
__device__ __forceinline__ u32 flagged(float v, u32 bit) { return (__float_as_uint(v) & ~1u) | bit; }
__device__ __forceinline__ uint4 peek(const uint4* p) {
  uint4 v;
  asm volatile("ld.relaxed.gpu.global.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "l"(p)
               : "memory");
  return v;
}
__device__ __forceinline__ bool missing(uint4 v, u32 bit) {
  return ((v.x ^ bit) | (v.y ^ bit) | (v.z ^ bit) | (v.w ^ bit)) & 1;
}
__device__ __forceinline__ void publish(uint4* p, float4 v, u32 bit) {
  asm volatile("st.relaxed.gpu.global.v4.u32 [%0], {%1, %2, %3, %4};" ::"l"(p), "r"(flagged(v.x, bit)),
               "r"(flagged(v.y, bit)), "r"(flagged(v.z, bit)), "r"(flagged(v.w, bit))
               : "memory");
}
__device__ __forceinline__ void publish(float* p, float v, u32 bit) {
  asm volatile("st.relaxed.gpu.global.u32 [%0], %1;" ::"l"(p), "r"(flagged(v, bit)) : "memory");
}
// v[i] = p[i * stride], asked for until it is there.
template <int N>
__device__ __forceinline__ void poll(uint4 (&v)[N], const uint4* p, size_t stride, u32 bit) {
#pragma unroll
  for (int i = 0; i < N; ++i) v[i] = peek(p + i * stride);
#pragma unroll 1
  for (;;) {
    bool again = false;
#pragma unroll
    for (int i = 0; i < N; ++i)
      if (missing(v[i], bit)) v[i] = peek(p + i * stride), again = true;
    if (!again) return;
  }
}

// ---- arithmetic

__device__ __forceinline__ u32 pack(float lo, float hi) {
  u32 v;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(v) : "f"(hi), "f"(lo));
  return v;
}
__device__ __forceinline__ void mma(float (&c)[4], uint4 a, uint2 b) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b.x), "r"(b.y));
}
template <int N>
__device__ __forceinline__ void clear(float (&c)[N][4]) {
#pragma unroll
  for (int i = 0; i < N; ++i) c[i][0] = c[i][1] = c[i][2] = c[i][3] = 0;
}
__device__ __forceinline__ float exp2_approx(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ float exchange(float v, int mask) { return __shfl_xor_sync(~0u, v, mask); }
__device__ __forceinline__ u32 exchange(u32 v, int mask) { return __shfl_xor_sync(~0u, v, mask); }
