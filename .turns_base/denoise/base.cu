// The whole denoising loop of Pi0.5's action expert, all layers and steps, in one kernel of resident clusters.
// Part 1 of 13, which kernel.py puts together: sizes, shared memory, a CTA's view.
//
// NC clusters of S CTAs stay resident, one a query head: cluster c owns head c, 1/NC of the feed-forward's hidden units
// and 1/NC of the key and value columns. Rank r of each cluster owns the r-th slice of the residual stream's columns; all NC clusters keep the same stream, in float32
// registers. (Of more than 16 tokens each cluster keeps some, and the stream comes together in another way: see
// spread.cu. What follows holds for the rest.)
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
constexpr bool FEW = NT <= 2;              // tokens: registers and shared memory to spare
// Clock cycles before sums are asked for: polls slow down what they wait for.
constexpr u32 PATIENCE = FEW ? 500 : FP8 ? 300 : 400;
constexpr bool SPREAD = !FEW;              // the stream: each CTA keeps and adds up a part, see spread.cu
constexpr int OWN_N = most(NT, NC);        // if so: 8 tokens of the slice at a time, which a CTA looks after
constexpr int ITEMS_X = most(SPREAD ? DX * OWN_N : DX * NT, W);  // (tile, 8 tokens) that one warp looks after
static_assert(D % 16 == 0 && F % 16 == 0 && HD % 16 == 0 && HD <= 256 && T <= 64 && NH % 2 == 0 && A <= CONSUMERS,
              "sizes");

// A product's tiles are multiplied in groups of up to 8. A warpgroup multiplies 4 tiles at once, a warp one of them;
// the warpgroups form rows of tiles and `parts` of the reduction. Tiles that are missing are multiplied, too: whatever
// lies there, it makes rows of its own, which nobody reads. Many tokens' sums are so large that two warpgroups rather
// rest than have parts of their own.
__host__ __device__ constexpr int group_tiles(int left) { return left < 8 ? left : 8; }
__host__ __device__ constexpr int packed_parts(int tiles) { return tiles > 4 ? W / 8 : W / 4; }  // see `filled`
__host__ __device__ constexpr int group_parts(int tiles) { return SPREAD ? W / 8 : packed_parts(tiles); }
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

// ---- shared memory

constexpr int RS = HD * 2 + 16;  // bytes of a suffix key's or value's row: no bank conflicts for ldmatrix
constexpr int FRAGMENT = 512, ROUND_FRAGMENTS = TP_ROUND_FRAGMENTS, SLOT = ROUND_FRAGMENTS * W * FRAGMENT;
// A round: ROUND_FRAGMENTS fragments of the reduction for each part of it. Weights of a group of tiles are filled up with zeros to
// a multiple of `filled` fragments.
__host__ __device__ constexpr int filled(int tiles) { return 4 * packed_parts(tiles); }
__host__ __device__ constexpr int plan_rounds(int tiles, int blocks) {
  return most(most(blocks, KB), filled(tiles)) * filled(tiles) / (ROUND_FRAGMENTS * group_parts(tiles));
}
__host__ __device__ constexpr int slot_rounds(int parts, int tiles) {  // W / (parts * tiles), for they are few
  int n = W / parts;
  for (int i = 1; i < 8; i *= 2) n = i < tiles ? n / 2 : n;
  return n;
}
// With few tokens q|k|v are multiplied by mma: see `QkvProduct`. Its parts are the warps', or of two warps each if all
// would need more memory than the stream that they lie over.
constexpr int QKV = QTL + KVL, QKV_ROUNDS = plan_rounds(group_tiles(QKV), D16);
constexpr bool MMA_QKV = FEW && QKV <= 3 && QKV_ROUNDS * KB <= 4 && (QKV_ROUNDS & (QKV_ROUNDS - 1)) == 0;
static_assert(!MMA_QKV || ROUND_FRAGMENTS * group_parts(QKV) == W, "a fragment of each round for a warp");
// Of other products' weights the first rounds wait in registers for activations, if tokens are few: that is room for as
// many more behind them. A round is a slot then, and all CTAs have as many.
__host__ __device__ constexpr int rounds_ahead(int tiles, bool all, int blocks, int rounds) {
  const int parts = group_parts(group_tiles(tiles));
  return FEW && ROUND_FRAGMENTS == 4 && all && tiles <= 8 && slot_rounds(parts, tiles) == 1 && blocks % (KB * filled(tiles)) == 0
             ? imin(rounds, plan_rounds(group_tiles(tiles), blocks))
             : 0;
}
constexpr int GATE_UP_AHEAD = rounds_ahead(GTL, F16 % NC == 0 && 2 * HC % S == 0, D16, FP8 ? 2 : 4);
constexpr int OUT_AHEAD = rounds_ahead(DX, D16 % S == 0, QT, 1),
              DOWN_AHEAD = rounds_ahead(DX, D16 % S == 0 && F16 % NC == 0, HC, 1),
              RESIDUAL_AHEAD = imin(OUT_AHEAD, DOWN_AHEAD);  // the same code
constexpr bool QKV_PAIRS = QKV * W * PARTIAL > D16 * NT * 256;
constexpr int QKV_PARTS = QKV_PAIRS ? W / 2 : W;
constexpr int KEY_TILE = QT * FRAGMENT;     // bytes of 16 keys, or values
constexpr int SLOT_TILES = ROUND_FRAGMENTS;             // of them in a slot
constexpr int KT = most(KEY_TILES, S);      // tiles of a rank's prefix keys
constexpr int SUFFIX = most(T, S);          // suffix keys of a rank, at most 8
static_assert(SLOT_TILES * KEY_TILE <= SLOT, "a slot's keys");
static_assert(SUFFIX <= 8, "more suffix keys than the first rows of a tile");
// In small models a CTA may have no hidden units. It sends a word in their place, to keep the others from running
// ahead.
constexpr bool IDLE = 2 * (F16 / NC) < S, IDLE_Q = QT < S;  // the same of queries

// A message lands without asking, so its place must be free at every receiver before any sender can have it. What makes
// it so: a rank goes on only with what it got from all ranks of its cluster, and each sends its part of an exchange
// when all its warps that have work in what goes before are done with it: they each send a part, or follow a barrier of
// the warps that have. (Warps without a tile multiply too, whatever they read; nobody reads their sums.)
//
// Region X holds the stream (operand of qkv and gate|up). When those have read it, their partial sums lie there, then
// attention's weights, suffix keys and values, and the partial outputs that other ranks send.
//   sums of qkv over the stream: nothing is sent to X before a peer has this rank's queries, sent when they are read
//   attention's outputs over them: so they land later still; the next slice follows the attention of all ranks, and
//   that the outputs of all ranks, which their warps send when they have weighed
//   sums of gate|up over the stream, or in M_SUMS: the next slice lands when a peer has this rank's hidden units, made
//   of those sums
constexpr int X_BYTES = D16 * NT * OPERAND;
// Bytes of a partial output's tile for 8 tokens: bfloat16, as weights of the suffix can be large, or float32.
constexpr int OUTPUT = SPREAD ? 256 : 512;
constexpr int X_TOPS = 0, X_SUMS = S * NT * 32, X_COMB = 2 * X_SUMS, X_P = X_COMB + S * QTL * NT * OUTPUT;
constexpr int X_SUFFIX_SUMS_FEW = X_P + (KT + 1) * NT * 256,
              X_KEEP = X_SUFFIX_SUMS_FEW + (SPREAD ? 0 : 3 * NT * 256), X_SUFFIX = X_KEEP + up128(NT * 32);
constexpr int ROWS = SPREAD ? 16 : SUFFIX;  // of keys, and of values, that don't lie in tiles: see `PrefixShare`
// If SPREAD such keys are an operand: 8 columns of 8 keys and of the next 8, then what keeps banks apart.
constexpr int KEY_COLUMNS = 2 * 128 + 16, KEY_ROWS = SPREAD ? HD / 8 * KEY_COLUMNS : ROWS * RS;
// Between steps, if tokens are few: what ranks add to v_t, then by item the slice in float32 and what it adds to v_t.
constexpr int X_VPART = 0, X_XS = up128(S * T * A * 4);
constexpr int XS_PART = A > 32 ? 512 : 0, XS_ITEM = imax(XS_PART + A * 32, 512);  // over the item, if read at once
// If SPREAD, region X holds everything, as each exchange waits until all ranks are done with what lay there: attention
// and queries behind qkv's sums, hidden units over the stream with the feed-forward's partial sums behind them.
// Attention comes when the suffix's partial logits are no longer needed.
constexpr int X_ATT = up128(imax(X_SUFFIX + ROWS * RS,
                                 imax(plan_partials(QKV), plan_others(DX)) * PARTIAL)),
              X_ROWS = X_ATT + imax(QTL, 3) * NT * 256,  // behind queries that still leave, and partial logits
              X_Q = imax(X_ATT + QT * OPERAND * NT, X_ROWS + KEY_ROWS), X_FF_SUMS = HC * NT * OPERAND;
constexpr int X_SUFFIX_SUMS = SPREAD ? X_ATT : X_SUFFIX_SUMS_FEW, X_KEY_ROWS = SPREAD ? X_ROWS : X_SUFFIX,
              X_VALUE_ROWS = SPREAD ? X_SUFFIX : X_SUFFIX + ROWS * RS;
// Behind them float32 at a step's end: partial sums of v_t [S][V_PARTS][OWN_T][A], the slice [DX * 16][OWN_T], x_t.
constexpr int OWN_T = OWN_N * 8, V_PARTS = imax(CONSUMERS / A / OWN_T, 1);  // tokens whose x_t a CTA knows
constexpr int X_OWN_V = up128(X_FF_SUMS + imax(plan_others(GTL), plan_others(DX)) * PARTIAL),
              X_OWN_XS = X_OWN_V + S * V_PARTS * OWN_T * A * 4, X_OWN_XT = X_OWN_XS + DX * 16 * OWN_T * 4;
constexpr int X_SPREAD = imax(X_Q + QT * NT * 256, X_OWN_XT + OWN_T * A * 4);
constexpr int X_SIZE =
    up128(imax(imax(X_BYTES, SPREAD ? X_SPREAD : X_SUFFIX + 2 * ROWS * RS),
               imax(imax(MMA_QKV ? QKV * QKV_PARTS : plan_partials(QKV), SPREAD ? 0 : plan_partials(GTL)) * PARTIAL,
                    SPREAD ? 0 : X_XS + DX * NT * XS_ITEM)));
// Region H: queries and attention's output, or the hidden units; then the partial sums of out and of down. Hidden
// units, or queries, land when a peer has this rank's slice, which follows out's, or down's, sums.
constexpr int H_Q = 0, H_ATT = QT * NT * 256;
constexpr int H_BYTES = imax(QT * 256 + imax(QT * OPERAND, QTL * 256), HC * OPERAND) * NT;
constexpr int H_SIZE = SPREAD ? 0 : up128(imax(H_BYTES, plan_partials(DX) * PARTIAL));

// Sums of squares of the stream, float32[SQ][NT * 8]: by tile if tokens are few, else by slice.
constexpr int SQ = FEW ? S * DX : S;
__host__ __device__ constexpr int plan_slots(int mt, int blocks) {
  int n = 0;
  for (; mt > 0; mt -= 8) {
    const int tiles = group_tiles(mt), parts = group_parts(tiles);
    n += most(plan_rounds(tiles, blocks), slot_rounds(parts, tiles));
  }
  return n;
}
constexpr int MAX_SLOTS = plan_slots(QTL + KVL, D16) + 2 * most(KT, SLOT_TILES) + plan_slots(DX, QT) +
                          plan_slots(GTL, D16) + plan_slots(DX, HC);
// If SPREAD the ring comes second, for what is read beyond its end lies behind it.
constexpr int BEYOND = 3 * FRAGMENT;  // of a slot: where the missing ones of 4 tiles are read
constexpr int SIZE_SSQ = up128(SQ * NT * 32), SIZE_PART = up128((SPREAD ? imax(DX * OWN_N, NT) : DX * NT) * 32),
              SIZE_BAR = SPREAD ? 384 : 512, SIZE_LIST = up128(MAX_SLOTS * 8);
constexpr int BEHIND = imax(SIZE_SSQ + SIZE_PART + up128(NT * 32) + SIZE_BAR + SIZE_LIST, BEYOND);
constexpr int SPREAD_STAGES = imin((TP_SHARED_BYTES - X_SIZE - BEHIND) / SLOT, 7);
constexpr int M_X = 0, M_H = M_X + X_SIZE, M_SSQ = M_H + (SPREAD ? SPREAD_STAGES * SLOT : H_SIZE);
constexpr int M_Q = SPREAD ? M_X + X_Q : M_H + H_Q, M_ATT = SPREAD ? M_X + X_ATT : M_H + H_ATT,
              M_HID = SPREAD ? M_X : M_H;  // queries, attention, hidden units
constexpr int M_PART = M_SSQ + SIZE_SSQ;        // of this slice, by tile; in attention largest logits
constexpr int M_RMS = M_PART + SIZE_PART;       // 1 / rms of each token
constexpr int M_ROPE = M_RMS + up128(NT * 32);  // if tokens are few: see `make_rope`
constexpr int M_XT = M_ROPE + (FEW ? (QTL + KVL) * NT * 512 : 0);  // if tokens are few: x_t
constexpr int M_BAR = M_XT + (FEW ? up128(T * A * 4) : 0), M_PROGRESS = M_BAR + 248, M_TOKEN = M_BAR + 252,
              M_LIST = M_BAR + SIZE_BAR, M_SUMS = M_LIST + SIZE_LIST;
__host__ __device__ constexpr int plan_stages(int ring) { return imin((TP_SHARED_BYTES - ring - BEYOND) / SLOT, 11); }
// Partial sums of gate|up, out and down lie in a place of their own unless that costs a slot.
constexpr int SUMS_SIZE = up128(imax(plan_others(GTL), plan_others(DX)) * PARTIAL);
constexpr bool APART = !SPREAD && plan_stages(M_SUMS) == plan_stages(M_SUMS + SUMS_SIZE);
constexpr int M_RING = SPREAD ? M_H : M_SUMS + (APART ? SUMS_SIZE : 0);
constexpr int STAGES = SPREAD ? SPREAD_STAGES : plan_stages(M_RING);
// All ranks' shares of queries, attention or hidden units are wanted by all ranks. CTAs take 18 bytes a cycle from each
// other, however they are sent, but far more from L2. So of many tokens a share goes into L2 and from there, by one
// multicast, to all ranks (`copy_to_all`): where its way there and back, a microsecond, is won by that.
constexpr bool EVEN_HEAD = SPREAD && QT % S == 0;
constexpr bool COPY_QUERIES = EVEN_HEAD && NT >= (FP8 ? 5 : 6), COPY_ATTENTION = EVEN_HEAD && !FP8 && NT >= 6;
// A block of two tiles at a time, where four warps have made it.
constexpr bool COPY_HIDDEN = SPREAD && (FP8 || NT >= 5) && F16 % NC == 0 && 2 * HC % S == 0 && GTL % 2 == 0 &&
                             GTL > 4 && GTL <= 8;
constexpr int COPY_WARP = 7;  // has none of the keys and values that others have just published: its fence needn't wait
constexpr int X_OWN_HIDDEN = X_OWN_V;  // of a rank, before they are sent
static_assert(!COPY_HIDDEN || X_OWN_HIDDEN + GTL / 2 * NT * OPERAND <= X_SIZE, "room for a rank's hidden units");
static_assert(STAGES >= 2 && (!MMA_QKV || QKV_ROUNDS <= STAGES), "too little shared memory");

// Who scores prefix keys, a tile a warp and round. ASYNC: by wgmma, see attention_many.cu.
constexpr int SCORERS = 8, ROUNDS = most(KT, SCORERS);
constexpr bool ASYNC = SPREAD && ROUNDS == 1 && most(KT, SLOT_TILES) <= STAGES;
// Prefix keys that rank i has: tiles from `first` on, with `keys` keys in all. Ranks with one more would let the others
// wait. So if tokens are many and what is left behind an even share is little, it is shared out, too: keys `loose0`..,
// which go with those of the suffix as one more tile (of many keys they don't: see ASYNC).
struct PrefixShare {
  int first, tiles, keys, loose0 = 0, loose = 0;
  __device__ __forceinline__ PrefixShare(int all, int i) {
    const int even = all / 16 / S * S, left = all - even * 16;
    if (ASYNC && left <= S * (16 - SUFFIX)) {
      tiles = even / S, first = tiles * i, keys = tiles * 16;
      loose0 = even * 16 + share(left, S, i), loose = even * 16 + share(left, S, i + 1) - loose0;
      return;
    }
    const int count = most(all, 16);
    first = share(count, S, i), tiles = share(count, S, i + 1) - first, keys = min(tiles * 16, all - first * 16);
  }
};

// ---- barriers. Who waits at which, and what each protects: docs/dev/denoising_kernel.md.

// Of warps of a CTA (bar.sync, bar.arrive); 0 is __syncthreads. score.cu and attention_many.cu name those of attention, 2
// to 6. Macros, as one constant more in this scope changes the code that ptxas makes.
#define CONSUMERS_MEET 1     // all W warps that multiply
#define SQUARES_KEPT 7       // SPREAD: the warps that keep the stream have stored their tiles' sums of squares
#define TILE_MEETS 8         // and 7 more: the warps that share a tile, or pairs of warps, have stored partial sums
#define HIDDEN_BLOCK_MADE 2  // and 3 more (COPY_HIDDEN), between attentions: four warps have made two tiles' hidden units

// In shared memory (mbarrier): the stream, queries, largest logits, partial outputs to be combined, attention, hidden
// units, what ranks add to v_t, the next step, 1 / rms; ring: full and empty, by slot
enum Barrier { BAR_X, BAR_Q, BAR_TOPS, BAR_COMB, BAR_ATT, BAR_HID, BAR_V, BAR_GO, BAR_RMS, BAR_RING };
// if SPREAD: region X read by all warps here, by all ranks; the stream multiplied by all ranks; all warps have seen
// this rank's slice of the next; sums of squares here
enum SpreadBarrier { BAR_DONE = BAR_RING + 2 * 7, BAR_FREE, BAR_ROOM, BAR_HERE, BAR_SQUARES };

// ---- scratch in global memory, in 16-byte words

// Partial sums of the stream, of all clusters: float16, for half the bytes that polls read. A lane's four of two
// clusters lie side by side; a word's lowest bit, the flag, is that of every other number. If SPREAD a cluster's lie
// together, for sectors of L2 that are half written cost as much as whole ones.
constexpr int PAIRS = NC / 2;
constexpr size_t N_STREAM = size_t(D16) * NT * PAIRS * 32;
// Keeps them within float16's range; sums of E4M3 numbers lack their scales yet.
constexpr float PARTIAL_SCALE = FP8 ? 1.0f / 16384 : 1.0f / 256;
constexpr size_t N_KV = size_t(T) * HD / 2;              // suffix keys and values, float32[T][2 HD]
constexpr size_t B_X1 = 0, B_X2 = 2 * N_STREAM, B_KV = 4 * N_STREAM;
// If SPREAD: the stream as products take it, four times, and sums of squares float32[S][NT * 8], twice; a word of each
// CTA, which nobody reads; shares on their way to all ranks.
constexpr u32 STAGED = 4;
constexpr size_t N_STAGE = size_t(D16) * NT * (OPERAND / 16), N_SQUARES = size_t(S) * NT * 2;
constexpr size_t N_HEAD = size_t(NC) * QT * NT, N_HIDDEN = size_t(NC) * HC * NT * (OPERAND / 16);
constexpr size_t B_STAGE = B_KV + 2 * N_KV, B_SQUARES = B_STAGE + STAGED * N_STAGE;
constexpr size_t B_ORDER = B_SQUARES + 2 * N_SQUARES, B_HIDDEN = B_ORDER + NC * S, B_QUERIES = B_HIDDEN + N_HIDDEN,
                 B_ATT = B_QUERIES + N_HEAD * 16, SCRATCH = SPREAD ? B_ATT + N_HEAD * (OPERAND / 16) : B_STAGE;
static_assert(SCRATCH == TP_SCRATCH_WORDS, "kernel.py disagrees on the scratch memory");
// Stands where a word of the staged stream is still to come. Nothing is rounded to it: the NaN made then is another.
constexpr u32 ABSENT = ~0u;
// Whether there is the token whose 8 columns (E4M3: 16) word i of a staged slice has.
__device__ __forceinline__ bool word_exists(int i) {
  return T % 8 == 0 || i / (OPERAND / 16) % NT * 8 + i % 8 < T;
}

// ---- a CTA's view

// What is the same in all lanes of a warp, so that the compiler knows it. wgmma takes its operands' places from
// registers that a warp has once. There the compiler reckons with such places, if it knows that all lanes agree on them
// and on every branch and loop around: else each costs some six instructions more. So nothing that holds for some
// lanes alone may decide where a warp goes on.
__device__ __forceinline__ u32 of_warp(u32 v) { return __shfl_sync(~0u, v, 0); }

struct Block {
  const Args& a;
  byte* smem;
  u32 base;                 // of smem in the shared window
  u32 cta, thread, warp_;   // cluster and rank; lane; warp
  u32 n = 0;                // layers done
  u32 slot = 0, phase = 0;  // of the ring
  u32 turn = 0, room = 0;   // exchanges of the stream, uses of BAR_ROOM

  __device__ Block(const Args& args, byte* s)
      : a(args), smem(s), base(u32(__cvta_generic_to_shared(s))), cta(blockIdx.x), thread(threadIdx.x),
        warp_(of_warp(threadIdx.x / 32)) {}
  // The same as `base`, known to be so in all lanes.
  static __device__ __forceinline__ u32 start() {
    extern __shared__ __align__(128) byte dynamic[];
    return u32(__cvta_generic_to_shared(dynamic));
  }
  // For warps that multiply: make the compiler forget what these are made of. What it derives from them it would keep
  // in registers, or in local memory, over all layers, and a fetch from there costs more than to derive it again.
  __device__ __forceinline__ void forget() {
    asm volatile("" : "+r"(base), "+r"(warp_));
    asm volatile("mov.u32 %0, %%ctaid.x;" : "=r"(cta));
    asm volatile("mov.u32 %0, %%tid.x;" : "=r"(thread));
    __builtin_assume(cta < NC * S), __builtin_assume(thread < CONSUMERS), __builtin_assume(warp_ < W);
  }
  __device__ __forceinline__ int cluster() const { return int(cta / S); }
  __device__ __forceinline__ int rank() const { return int(cta % S); }
  __device__ __forceinline__ int warp() const { return int(warp_); }
  __device__ __forceinline__ int lane() const { return int(thread % 32); }
  // A lane's place in the tensor cores' operands.
  __device__ __forceinline__ int g() const { return int(thread / 4 % 8); }
  __device__ __forceinline__ int t() const { return int(thread % 4); }
  __device__ __forceinline__ u32 bar(int i) const { return base + M_BAR + i * 8; }
  __device__ __forceinline__ u32 full(u32 s) const { return base + M_BAR + BAR_RING * 8 + s * 16; }
  __device__ __forceinline__ u32 empty(u32 s) const { return full(s) + 8; }
  __device__ __forceinline__ byte* ring(u32 s) const { return smem + M_RING + s * SLOT; }
  // blocks of the stream's slice, hidden blocks of the cluster, tiles of the CTA
  __device__ __forceinline__ int x0() const { return share(D16, S, rank()); }
  __device__ __forceinline__ int xn() const { return D16 % S == 0 ? DX : share(D16, S, rank() + 1) - x0(); }
  __device__ __forceinline__ int hn() const {
    return F16 % NC == 0 ? HC : share(F16, NC, cluster() + 1) - share(F16, NC, cluster());
  }
  __device__ __forceinline__ int g0() const { return share(2 * hn(), S, rank()); }
  __device__ __forceinline__ int gn() const {
    return F16 % NC == 0 && 2 * HC % S == 0 ? GTL : share(2 * hn(), S, rank() + 1) - g0();
  }
  __device__ __forceinline__ int q0() const { return share(QT, S, rank()); }
  __device__ __forceinline__ int qn() const { return QT % S == 0 ? QTL : share(QT, S, rank() + 1) - q0(); }
  __device__ __forceinline__ int kv0() const { return share(KVT, NH * S, cluster() * S + rank()); }
  __device__ __forceinline__ int kvn() const { return share(KVT, NH * S, cluster() * S + rank() + 1) - kv0(); }
};

// A warp's cycles up to each mark, summed up over the loop: see MARKS of kernel.py. TP_TRACED_WARP: which warp's, from 1.
#ifdef TP_TRACED_WARP
#define MARK(i)                                    \
  if (b.thread == (TP_TRACED_WARP - 1) * 32) { \
    const u32 now_ = u32(clock64());         \
    u32* m_ = (u32*)(b.smem + M_BAR + 256); \
    m_[1 + (i)] += now_ - m_[0];             \
    m_[0] = now_;                            \
  }
#else
#define MARK(i)
#endif

