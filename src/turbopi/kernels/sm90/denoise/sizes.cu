// The whole denoising loop of Pi0.5's action expert, all layers and steps, in one kernel of resident clusters.
//
// NC clusters of S CTAs stay resident, one a query head: cluster c owns head c, 1/NC of the feed-forward's hidden units
// and 1/NC of the key and value columns. Rank r of each cluster owns the r-th slice of the residual stream's columns.
// There are two forms, a translation unit each, which kernel.py puts together from the files here and those of one
// folder: few/ (up to 16 tokens), where every cluster keeps the whole stream in float32 registers, and many/, where each
// cluster keeps some tokens of it and the stream comes together in another way.
//
// What a cluster's CTAs tell each other goes through distributed shared memory (st.async, counted in by an mbarrier of
// the receiver: no cluster barriers). What crosses clusters are sums over heads or over hidden units, two exchanges a
// layer between the CTAs of equal rank, and the suffix's keys and values. Those words go through L2 and carry their own
// flag: the lowest bit of 32 tells its use of the buffer, so the reader asks for a word until that bit is right.
// So all clusters must run at once. The launch is cooperative: the driver starts all of them or none, also where another
// process uses the GPU at the same time. `watch` ends a launch that makes no progress for seconds all the same.
//
// Units: a "block" is 16 columns of a reduction axis, a "tile" 16 output rows, a "fragment" 512 bytes of a weight
// matrix (operand A; tokens are operand B) as the tensor cores read it from shared memory: a tile x one block in
// bfloat16 ([8 rows][8 columns][row][16 bytes]), a tile x two blocks in E4M3 ([8 rows][block][row][16 bytes]).
// Activations that meet weights lie as [block][8 tokens][8 columns][token][16 bytes], of E4M3 [block][8 tokens][token]
// [16 bytes], queries and attention's weights as [block][8 columns][8 tokens][token][16 bytes].

typedef unsigned char byte;

constexpr int D = TP_WIDTH, F = TP_MLP_DIM, L = TP_DEPTH, NH = TP_HEADS, HD = TP_HEAD_DIM, T = TP_TOKENS, A = TP_ACTION_DIM;
constexpr int S = TP_RANKS, NC = NH;                                      // CTAs of a cluster, clusters: one a head
constexpr int KEY_TILES = TP_KEY_TILES;                               // tiles of prefix keys, at most
constexpr int W = 16, CONSUMERS = W * 32, THREADS = CONSUMERS + 128;  // registers are dealt out by warpgroup
constexpr int NT = (T + 7) / 8;
constexpr bool FP8 = TP_FP8;         // weights and the activations they meet in E4M3; what scales them is in the tables
constexpr int KB = FP8 ? 2 : 1;      // blocks of a fragment of weights
constexpr int OPERAND = FP8 ? 128 : 256;  // bytes of a block's activations of 8 tokens that meet weights
constexpr int D16 = D / 16, F16 = F / 16, QT = HD / 16, KVT = HD / 8;

// n things shared out between `parts`: which is the first of part i, and how many a part has at most.
__host__ __device__ constexpr int share(int n, int parts, int i) { return n * i / parts; }
__host__ __device__ constexpr int most(int n, int parts) { return (n + parts - 1) / parts; }
__host__ __device__ constexpr int imax(int a, int b) { return a > b ? a : b; }
__host__ __device__ constexpr int imin(int a, int b) { return a < b ? a : b; }
__host__ __device__ constexpr int up128(int x) { return (x + 127) / 128 * 128; }

constexpr int DX = most(D16, S);           // blocks (and output tiles) of a slice of the stream
constexpr int HC = most(F16, NC);          // hidden blocks of a cluster
constexpr int GTL = most(2 * HC, S);       // gate|up tiles of a CTA: 8 hidden units each
constexpr int QTL = most(QT, S);           // query tiles of a CTA: 8 RoPE pairs each
constexpr int KVL = most(KVT, NH* S);      // key and value tiles of a CTA
constexpr int TILES = QTL + KVL + GTL;     // of a CTA with rows of their own in `shifted`
#ifdef TP_BY_TOKEN
typedef float4 Factors;  // of a lane's two columns (or rows) for its two tokens, as an item has them: see stream.cu
#else
typedef float2 Factors;  // of a lane's two columns (or rows): tokens have one time
#endif
#if defined(TP_BY_TOKEN) && defined(TP_TRACED_WARP)
#define BESIDE_TRACE 128  // the trace lies where else tokens' rows of the table do
#else
#define BESIDE_TRACE 0
#endif
constexpr bool MANY = NT > 2;  // tokens: the form of many/. Without it registers and shared memory are to spare
static_assert(D % 16 == 0 && F % 16 == 0 && HD % 16 == 0 && HD <= 256 && T <= 64 && NH % 2 == 0 && A <= CONSUMERS,
              "sizes");

// A product's tiles are multiplied in groups of up to 8. A warpgroup multiplies 4 tiles at once, a warp one of them;
// the warpgroups form rows of tiles and `parts` of the reduction. Tiles that are missing are multiplied, too: whatever
// lies there, it makes rows of its own, which nobody reads. Many tokens' sums are so large that two warpgroups rather
// rest than have parts of their own.
__host__ __device__ constexpr int group_tiles(int left) { return left < 8 ? left : 8; }
__host__ __device__ constexpr int packed_parts(int tiles) { return tiles > 4 ? W / 8 : W / 4; }  // see `filled`
__host__ __device__ constexpr int group_parts(int tiles) { return MANY ? W / 8 : packed_parts(tiles); }
__host__ __device__ constexpr int plan_groups(int mt) { return most(mt, 8); }
// Partial sums of all tiles, or of all but one part of each.
__host__ __device__ constexpr int plan_partials(int mt) {
  return mt <= 0 ? 0 : group_tiles(mt) * group_parts(group_tiles(mt)) + plan_partials(mt - 8);
}
__host__ __device__ constexpr int plan_others(int mt) {
  return mt <= 0 ? 0 : group_tiles(mt) * (group_parts(group_tiles(mt)) - 1) + plan_others(mt - 8);
}
constexpr int TAIL = (T - (NT - 1) * 8 + 1) / 2;       // pairs of tokens among the last 8
constexpr int PARTIAL = (NT - 1) * 512 + TAIL * 128;  // bytes of one tile's partial sums

// ---- weights in shared memory, on their way

constexpr int RS = HD * 2 + 16;  // bytes of a suffix key's or value's row: no bank conflicts for ldmatrix
constexpr int FRAGMENT = 512, ROUND_FRAGMENTS = TP_ROUND_FRAGMENTS, SLOT = ROUND_FRAGMENTS * W * FRAGMENT;
// A round: ROUND_FRAGMENTS fragments of the reduction for each part of it. Weights of a group of tiles are filled up
// with zeros to a multiple of `filled` fragments.
__host__ __device__ constexpr int filled(int tiles) { return 4 * packed_parts(tiles); }
__host__ __device__ constexpr int plan_rounds(int tiles, int blocks) {
  return most(most(blocks, KB), filled(tiles)) * filled(tiles) / (ROUND_FRAGMENTS * group_parts(tiles));
}
__host__ __device__ constexpr int slot_rounds(int parts, int tiles) {  // W / (parts * tiles), for they are few
  int n = W / parts;
  for (int i = 1; i < 8; i *= 2) n = i < tiles ? n / 2 : n;
  return n;
}
__host__ __device__ constexpr int plan_slots(int mt, int blocks) {
  int n = 0;
  for (; mt > 0; mt -= 8) {
    const int tiles = group_tiles(mt), parts = group_parts(tiles);
    n += most(plan_rounds(tiles, blocks), slot_rounds(parts, tiles));
  }
  return n;
}
constexpr int KEY_TILE = QT * FRAGMENT;      // bytes of 16 keys, or values
constexpr int SLOT_TILES = ROUND_FRAGMENTS;  // of them in a slot
constexpr int KT = most(KEY_TILES, S);       // tiles of a rank's prefix keys
constexpr int SUFFIX = most(T, S);           // suffix keys of a rank, at most 8
static_assert(SLOT_TILES * KEY_TILE <= SLOT, "a slot's keys");
static_assert(SUFFIX <= 8, "more suffix keys than the first rows of a tile");
constexpr int QKV = QTL + KVL;  // tiles of a CTA
constexpr int MAX_SLOTS = plan_slots(QKV, D16) + 2 * most(KT, SLOT_TILES) + plan_slots(DX, QT) + plan_slots(GTL, D16) +
                          plan_slots(DX, HC);
constexpr int BEYOND = 3 * FRAGMENT;  // of a slot: where the missing ones of 4 tiles are read
// Who scores prefix keys, a tile a warp and round.
constexpr int SCORERS = 8, ROUNDS = most(KT, SCORERS);

// In small models a CTA may have no hidden units. It sends a word in their place, to keep the others from running
// ahead.
constexpr bool IDLE = 2 * (F16 / NC) < S, IDLE_Q = QT < S;  // the same of queries

// ---- what both forms have in region X of shared memory. The rest: few/memory.cu, many/memory.cu.

// A message lands without asking, so its place must be free at every receiver before any sender can have it. What makes
// it so: a rank goes on only with what it got from all ranks of its cluster, and each sends its part of an exchange
// when all its warps that have work in what goes before are done with it: they each send a part, or follow a barrier of
// the warps that have. (Warps without a tile multiply too, whatever they read; nobody reads their sums.)
//
// Region X holds the stream (operand of qkv and gate|up). When those have read it, their partial sums lie there, then
// attention's weights, suffix keys and values, and the partial outputs that other ranks send.
constexpr int X_BYTES = D16 * NT * OPERAND;
// Bytes of a partial output's tile for 8 tokens: bfloat16, as weights of the suffix can be large, or float32.
constexpr int OUTPUT = MANY ? 256 : 512;
constexpr int X_TOPS = 0, X_SUMS = S * NT * 32, X_COMB = 2 * X_SUMS, X_P = X_COMB + S * QTL * NT * OUTPUT;

// ---- scratch in global memory, in 16-byte words: what both forms have

// Partial sums of the stream, of all clusters: float16, for half the bytes that polls read. A word's lowest bit, the
// flag, is that of every other number.
constexpr int PAIRS = NC / 2;
constexpr size_t N_STREAM = size_t(D16) * NT * PAIRS * 32;
// Keeps them within float16's range; sums of E4M3 numbers lack their scales yet.
constexpr float PARTIAL_SCALE = FP8 ? 1.0f / 16384 : 1.0f / 256;
constexpr size_t N_KV = size_t(T) * HD / 2;              // suffix keys and values, float32[T][2 HD]
constexpr size_t B_X1 = 0, B_X2 = 2 * N_STREAM, B_KV = 4 * N_STREAM, B_END = B_KV + 2 * N_KV;
