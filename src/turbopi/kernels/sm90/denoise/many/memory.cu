// Many tokens (more than 16): shared memory. Each CTA keeps a part of the stream, see stream.cu of this folder.

constexpr int OWN_N = most(NT, NC);           // 8 tokens of the slice at a time, which a CTA looks after
constexpr int ITEMS_X = most(DX * OWN_N, W);  // (tile, 8 tokens) of the stream that one warp looks after
constexpr int RESIDUAL_AHEAD = 0;             // no registers are left in which weights could wait

// ---- region X holds everything, as each exchange waits until all ranks are done with what lay there: attention and
// queries behind qkv's sums, hidden units over the stream with the feed-forward's partial sums behind them.
// Attention comes when the suffix's partial logits are no longer needed.

constexpr int ROWS = 16;  // of keys, and of values, that don't lie in tiles: see `PrefixShare`
// Such keys are an operand: 8 columns of 8 keys and of the next 8, then what keeps banks apart.
constexpr int KEY_COLUMNS = 2 * 128 + 16, KEY_ROWS = HD / 8 * KEY_COLUMNS;
constexpr int X_KEEP = X_P + (KT + 1) * NT * 256, X_SUFFIX = X_KEEP + up128(NT * 32);
constexpr int X_ATT = up128(imax(X_SUFFIX + ROWS * RS, imax(plan_partials(QKV), plan_others(DX)) * PARTIAL)),
              X_ROWS = X_ATT + imax(QTL, 3) * NT * 256,  // behind queries that still leave, and partial logits
              X_Q = imax(X_ATT + QT * OPERAND * NT, X_ROWS + KEY_ROWS), X_FF_SUMS = HC * NT * OPERAND;
constexpr int X_SUFFIX_SUMS = X_ATT, X_KEY_ROWS = X_ROWS, X_VALUE_ROWS = X_SUFFIX;
// Behind them float32 at a step's end: partial sums of v_t [S][V_PARTS][OWN_T][A], the slice [DX * 16][OWN_T], x_t.
constexpr int OWN_T = OWN_N * 8, V_PARTS = imax(CONSUMERS / A / OWN_T, 1);  // tokens whose x_t a CTA knows
constexpr int X_OWN_V = up128(X_FF_SUMS + imax(plan_others(GTL), plan_others(DX)) * PARTIAL),
              X_OWN_XS = X_OWN_V + S * V_PARTS * OWN_T * A * 4, X_OWN_XT = X_OWN_XS + DX * 16 * OWN_T * 4;
constexpr int X_SIZE = up128(imax(imax(X_BYTES, imax(X_Q + QT * NT * 256, X_OWN_XT + OWN_T * A * 4)),
                                  plan_partials(QKV) * PARTIAL));

// ---- all of it. The ring comes second, for what is read beyond its end lies behind it.

constexpr int SQ = S;  // sums of squares of the stream, float32[SQ][NT * 8]: by slice
constexpr int SIZE_SSQ = up128(SQ * NT * 32), SIZE_PART = up128(imax(DX * OWN_N, NT) * 32), SIZE_BAR = 384 + BESIDE_TRACE,
              SIZE_LIST = up128(MAX_SLOTS * 8);
constexpr int BEHIND = imax(SIZE_SSQ + SIZE_PART + up128(NT * 32) + SIZE_BAR + SIZE_LIST, BEYOND);
constexpr int STAGES = imin((TP_SHARED_BYTES - X_SIZE - BEHIND) / SLOT, 7);
static_assert(STAGES >= 2, "too little shared memory");
constexpr int M_X = 0, M_RING = M_X + X_SIZE, M_SSQ = M_RING + STAGES * SLOT;
constexpr int M_Q = M_X + X_Q, M_ATT = M_X + X_ATT, M_HID = M_X;  // queries, attention, hidden units
constexpr int M_PART = M_SSQ + SIZE_SSQ;   // of this slice, by tile; in attention largest logits
constexpr int M_RMS = M_PART + SIZE_PART;  // 1 / rms of each token
constexpr int M_BAR = M_RMS + up128(NT * 32), M_PROGRESS = M_BAR + 248, M_TOKEN = M_BAR + 252, M_LIST = M_BAR + SIZE_BAR;

// ---- which way things go

// All ranks' shares of queries, attention or hidden units are wanted by all ranks. CTAs take 18 bytes a cycle from each
// other, however they are sent, but far more from L2. So a share goes into L2 and from there, by one multicast, to all
// ranks (`copy_to_all`): where its way there and back, a microsecond, is won by that.
constexpr bool EVEN_HEAD = QT % S == 0;
constexpr bool COPY_QUERIES = EVEN_HEAD && NT >= (FP8 ? 5 : 6), COPY_ATTENTION = EVEN_HEAD && !FP8 && NT >= 6;
// A block of two tiles at a time, where four warps have made it.
constexpr bool COPY_HIDDEN = (FP8 || NT >= 5) && F16 % NC == 0 && 2 * HC % S == 0 && GTL % 2 == 0 && GTL > 4 && GTL <= 8;
constexpr int COPY_WARP = 7;  // has none of the keys and values that others have just published: its fence needn't wait
constexpr int X_OWN_HIDDEN = X_OWN_V;  // of a rank, before they are sent
static_assert(!COPY_HIDDEN || X_OWN_HIDDEN + GTL / 2 * NT * OPERAND <= X_SIZE, "room for a rank's hidden units");
constexpr bool PARTIALS_OVER_OPERAND = false;
__host__ __device__ constexpr int partials_place(int region) { return region; }
// Prefix keys are scored by wgmma: see attention.cu of this folder.
#ifdef TP_PAIR
constexpr bool ASYNC = false;  // its products mask nothing
#else
constexpr bool ASYNC = ROUNDS == 1 && most(KT, SLOT_TILES) <= STAGES;
#endif
constexpr bool HOLD = false;  // of few tokens: see score.cu
// Where 8 columns of a key among the rows lie (ASYNC); four columns of suffix key (kind 0) or value (1) `row`.
__device__ __forceinline__ int key_row(int row, int eight) {
  return M_X + X_KEY_ROWS + eight * KEY_COLUMNS + row / 8 * 128 + row % 8 * 16;
}
__device__ __forceinline__ int suffix_place(int kind, int row, int quad) {
  return ASYNC && !kind ? key_row(row, quad / 2) + quad % 2 * 8
                        : M_X + (kind ? X_VALUE_ROWS : X_KEY_ROWS) + row * RS + quad * 8;
}
// Prefix keys that rank i has: tiles from `first` on, with `keys` keys in all. Ranks with one more would let the others
// wait. So if what is left behind an even share is little, it is shared out, too: keys `loose0`.., which go with those of the suffix as one more tile (of many keys they don't: see ASYNC).
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

// ---- barriers, behind those of sizes.cu: region X read by all warps here, by all ranks; the stream multiplied by all
// ranks; all warps have seen this rank's slice of the next; sums of squares here

enum ManyBarrier { BAR_DONE = BAR_RING + 2 * 7, BAR_FREE, BAR_ROOM, BAR_HERE, BAR_SQUARES };

// ---- scratch in global memory

// The stream as products take it, four times, and sums of squares float32[S][NT * 8], twice; a word of each CTA, which
// nobody reads; shares on their way to all ranks.
constexpr u32 STAGED = 4;
constexpr size_t N_STAGE = size_t(D16) * NT * (OPERAND / 16), N_SQUARES = size_t(S) * NT * 2;
constexpr size_t N_HEAD = size_t(NC) * QT * NT, N_HIDDEN = size_t(NC) * HC * NT * (OPERAND / 16);
constexpr size_t B_STAGE = B_END, B_SQUARES = B_STAGE + STAGED * N_STAGE;
constexpr size_t B_ORDER = B_SQUARES + 2 * N_SQUARES, B_HIDDEN = B_ORDER + NC * S, B_QUERIES = B_HIDDEN + N_HIDDEN,
                 B_ATT = B_QUERIES + N_HEAD * 16, SCRATCH = B_ATT + N_HEAD * (OPERAND / 16);
static_assert(SCRATCH == TP_SCRATCH_WORDS, "kernel.py disagrees on the scratch memory");
// Stands where a word of the staged stream is still to come. Nothing is rounded to it: the NaN made then is another.
constexpr u32 ABSENT = ~0u;
// Whether there is the token whose 8 columns (E4M3: 16) word i of a staged slice has.
__device__ __forceinline__ bool word_exists(int i) {
  return T % 8 == 0 || i / (OPERAND / 16) % NT * 8 + i % 8 < T;
}
__device__ __forceinline__ u32 word_at_start(size_t at) {
  const bool absent = at >= B_STAGE && at < B_SQUARES && word_exists(int(at - B_STAGE));
  return absent ? ABSENT : 0;
}
