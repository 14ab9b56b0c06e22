// Few tokens (up to 16): shared memory. Every cluster keeps the whole stream.

constexpr int ITEMS_X = most(DX * NT, W);  // (tile, 8 tokens) of the stream that one warp looks after

// ---- which way products go

// q|k|v are multiplied by mma: see `QkvProduct`. Its parts are the warps', or of two warps each if all would need more
// memory than the stream that they lie over.
constexpr int QKV_ROUNDS = plan_rounds(group_tiles(QKV), D16);
constexpr bool MMA_QKV = QKV <= 3 && QKV_ROUNDS * KB <= 4 && (QKV_ROUNDS & (QKV_ROUNDS - 1)) == 0;
static_assert(!MMA_QKV || ROUND_FRAGMENTS * group_parts(QKV) == W, "a fragment of each round for a warp");
constexpr bool QKV_PAIRS = QKV * W * PARTIAL > D16 * NT * 256;
constexpr int QKV_PARTS = QKV_PAIRS ? W / 2 : W;
// Of other products' weights the first rounds wait in registers for activations: that is room for as many more behind
// them. A round is a slot then, and all CTAs have as many.
__host__ __device__ constexpr int rounds_ahead(int tiles, bool all, int blocks, int rounds) {
  const int parts = group_parts(group_tiles(tiles));
  return ROUND_FRAGMENTS == 4 && all && tiles <= 8 && slot_rounds(parts, tiles) == 1 && blocks % (KB * filled(tiles)) == 0
             ? imin(rounds, plan_rounds(group_tiles(tiles), blocks))
             : 0;
}
constexpr int GATE_UP_AHEAD = rounds_ahead(GTL, F16 % NC == 0 && 2 * HC % S == 0, D16, FP8 ? 2 : 4);
constexpr int OUT_AHEAD = rounds_ahead(DX, D16 % S == 0, QT, 1),
              DOWN_AHEAD = rounds_ahead(DX, D16 % S == 0 && F16 % NC == 0, HC, 1),
              RESIDUAL_AHEAD = imin(OUT_AHEAD, DOWN_AHEAD);  // the same code

// ---- region X
//
//   sums of qkv over the stream: nothing is sent to X before a peer has this rank's queries, sent when they are read
//   attention's outputs over them: so they land later still; the next slice follows the attention of all ranks, and
//   that the outputs of all ranks, which their warps send when they have weighed
//   sums of gate|up over the stream, or in M_SUMS: the next slice lands when a peer has this rank's hidden units, made
//   of those sums

constexpr int ROWS = SUFFIX;  // of keys, and of values, that don't lie in tiles
constexpr int X_SUFFIX_SUMS = X_P + (KT + 1) * NT * 256, X_KEEP = X_SUFFIX_SUMS + 3 * NT * 256,
              X_SUFFIX = X_KEEP + up128(NT * 32), X_KEY_ROWS = X_SUFFIX, X_VALUE_ROWS = X_SUFFIX + ROWS * RS;
// Between steps: what ranks add to v_t, then by item the slice in float32 and what it adds to v_t.
constexpr int X_VPART = 0, X_XS = up128(S * T * A * 4);
constexpr int XS_PART = A > 32 ? 512 : 0, XS_ITEM = imax(XS_PART + A * 32, 512);  // over the item, if read at once
constexpr int X_SIZE = up128(imax(imax(X_BYTES, X_SUFFIX + 2 * ROWS * RS),
                                  imax(imax(MMA_QKV ? QKV * QKV_PARTS : plan_partials(QKV), plan_partials(GTL)) * PARTIAL,
                                       X_XS + DX * NT * XS_ITEM)));

// ---- region H: queries and attention's output, or the hidden units; then the partial sums of out and of down. Hidden
// units, or queries, land when a peer has this rank's slice, which follows out's, or down's, sums.

constexpr int H_Q = 0, H_ATT = QT * NT * 256;
constexpr int H_BYTES = imax(QT * 256 + imax(QT * OPERAND, QTL * 256), HC * OPERAND) * NT;
constexpr int H_SIZE = up128(imax(H_BYTES, plan_partials(DX) * PARTIAL));

// ---- all of it

constexpr int SQ = S * DX;  // sums of squares of the stream, float32[SQ][NT * 8]: by tile
constexpr int SIZE_SSQ = up128(SQ * NT * 32), SIZE_PART = up128(DX * NT * 32), SIZE_BAR = 512,
              SIZE_LIST = up128(MAX_SLOTS * 8);
constexpr int M_X = 0, M_H = M_X + X_SIZE, M_SSQ = M_H + H_SIZE;
constexpr int M_Q = M_H + H_Q, M_ATT = M_H + H_ATT, M_HID = M_H;  // queries, attention, hidden units
constexpr int M_PART = M_SSQ + SIZE_SSQ;        // of this slice, by tile; in attention largest logits
constexpr int M_RMS = M_PART + SIZE_PART;       // 1 / rms of each token
constexpr int M_ROPE = M_RMS + up128(NT * 32);  // see `keep_rope`
constexpr int M_XT = M_ROPE + QKV * NT * 512;   // x_t
constexpr int M_BAR = M_XT + up128(T * A * 4), M_PROGRESS = M_BAR + 248, M_TOKEN = M_BAR + 252,
              M_LIST = M_BAR + SIZE_BAR, M_SUMS = M_LIST + SIZE_LIST;
__host__ __device__ constexpr int plan_stages(int ring) { return imin((TP_SHARED_BYTES - ring - BEYOND) / SLOT, 11); }
// Partial sums of gate|up, out and down lie in a place of their own unless that costs a slot.
constexpr int SUMS_SIZE = up128(imax(plan_others(GTL), plan_others(DX)) * PARTIAL);
constexpr bool APART = plan_stages(M_SUMS) == plan_stages(M_SUMS + SUMS_SIZE);
constexpr int M_RING = M_SUMS + (APART ? SUMS_SIZE : 0);
constexpr int STAGES = plan_stages(M_RING);
static_assert(STAGES >= 2 && (!MMA_QKV || QKV_ROUNDS <= STAGES), "too little shared memory");

// ---- what shared code asks for

// Where the partial sums of gate|up, out and down lie that else would lie in `region`, over the product's operand.
constexpr bool PARTIALS_OVER_OPERAND = !APART;
__host__ __device__ constexpr int partials_place(int region) { return APART ? M_SUMS : region; }
// Keys and values wait in registers for queries and weights: see score.cu.
constexpr bool HOLD = ROUNDS == 1 && KT <= 2 * SLOT_TILES && STAGES >= 4;
// Where four columns of suffix key (kind 0) or value (1) `row` lie.
__device__ __forceinline__ int suffix_place(int kind, int row, int quad) {
  return M_X + (kind ? X_VALUE_ROWS : X_KEY_ROWS) + row * RS + quad * 8;
}
// Prefix keys that rank i has: tiles from `first` on, with `keys` keys in all.
struct PrefixShare {
  int first, tiles, keys;
  __device__ __forceinline__ PrefixShare(int all, int i) {
    const int count = most(all, 16);
    first = share(count, S, i), tiles = share(count, S, i + 1) - first, keys = min(tiles * 16, all - first * 16);
  }
};

// ---- scratch in global memory

constexpr size_t SCRATCH = B_END;
static_assert(SCRATCH == TP_SCRATCH_WORDS, "kernel.py disagrees on the scratch memory");
__device__ __forceinline__ u32 word_at_start(size_t) { return 0; }
