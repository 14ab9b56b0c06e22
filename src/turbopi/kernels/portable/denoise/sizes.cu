// The denoising loop of an action expert in one cooperative kernel, for compute capability 8.0 and newer: Pi0.5's, and
// SmolVLA's, whose differences are constants (`Form` in packing.py).
//
// Every step reads all weights once and does little else, so the plan is about two things: weights that are on their way
// all the time, and few, short phases. A phase ends with a barrier of the whole grid; a layer has six:
//
//   q|k|v      stream x weights, 1 / rms, shift, RoPE             -> queries, keys, values; queries alone of a layer across
//   attention  a block: 16 query rows and a share of the keys     -> partial outputs, largest logits, sums
//   combine    all shares of a row                                -> attended; where there are several shares
//   out        attended x weights, gate, residual                 -> x, and the stream of the next norm
//   gate|up    stream x weights, 1 / rms, shift, GeGLU or SwiGLU  -> hidden
//   down       hidden x weights, gate, residual                   -> x, and the stream of the next norm
//
// Of a layer across q|k|v and attention are one phase where blocks and warps are enough (`attend_across`): a barrier less.
// A step adds one phase in front (action_in_proj; where the time is mixed into the tokens, the hidden units of that MLP and
// a product behind them) and one behind (final norm, action_out_proj, Euler step).
//
// x is float32. The stream is x times the next norm's scale, rounded to OPERAND; 1 / rms is multiplied in behind the
// product, and the norm's shift comes as a table that is already multiplied with the weights, `shifted`.
//
// Products: a *tile* is 8 output channels, a *chunk* is the part of the reduction of which a lane has 16 bytes of weights
// (32 columns of bfloat16, 64 of E4M3 or int8). Activations are operand A of mma.sync (16 tokens), weights operand B (8 channels). The
// order of columns within a chunk is free as long as both operands have the same, so a lane takes 16 bytes that lie side
// by side: [tile][chunk][8 channels][32 columns] of weights, [piece][token][32 columns] of activations, both coalesced.
// A block has whole tiles; its warps share out the chunks, and above that (WN) the tiles; their sums meet in shared memory.
// Weights depend on nothing: their first loads are asked for before the barrier in front of the phase, and those of later
// phases are brought to L2 (TP_AHEAD) while DRAM has nothing else to do.

using byte = unsigned char;
using u32 = unsigned;
using u64 = unsigned long long;

constexpr int D = TP_WIDTH, F = TP_MLP_DIM, L = TP_DEPTH, HEADS = TP_HEADS, HD = TP_HEAD_DIM;
constexpr int T = TP_TOKENS, A = TP_ACTION_DIM;
constexpr int KV_HEADS = TP_KV_HEADS, GROUP = HEADS / KV_HEADS;  // of query heads, which share keys and values
constexpr int SELF_EVERY = TP_SELF_EVERY;  // so many-th layers attend to the suffix, too; the others to the prefix alone
constexpr bool ACROSS = SELF_EVERY != 1;   // whether there are such others
constexpr bool CAUSAL = TP_CAUSAL;         // a token of the suffix sees those before it and itself
constexpr bool MODULATED = TP_MODULATED;   // a step has norms' weights of its own; else the time is mixed into the tokens
constexpr bool ACROSS_AT_ONCE = TP_ACROSS_AT_ONCE;  // across, q|k|v and attention are one phase
constexpr int BLOCKS = TP_BLOCKS, WARPS = TP_WARPS, THREADS = WARPS * 32;
constexpr u32 LOOKS = TP_LOOKS;
constexpr bool FP8 = TP_FP8, INT8 = TP_INT8;  // INT8: weights alone, which become bfloat16 in registers, exactly
constexpr bool SCALED = FP8 || INT8;          // each output channel has a scale
constexpr int WEIGHT_BYTES = SCALED ? 1 : 2, OPERAND_BYTES = FP8 ? 1 : 2;  // an operand: an activation that meets weights
constexpr int CHUNK = 64 / WEIGHT_BYTES;                 // columns
constexpr int PIECES = OPERAND_BYTES / WEIGHT_BYTES;     // of 64 bytes: a token's activations in a chunk
constexpr int PIECE = CHUNK / PIECES;                    // columns. Tokens lie side by side, so that lines are read whole
constexpr int CHUNK_BYTES = 512;           // of a tile
constexpr int ROWS = T * GROUP;  // of the queries of a key/value head, row = token * GROUP + head in the group
constexpr int HEAD_ROW_TILES = (ROWS + 15) / 16, ROW_TILES = KV_HEADS * HEAD_ROW_TILES;
constexpr int SPLITS = TP_SPLITS;  // shares of the keys
constexpr int SPLIT_KEYS = TP_SPLIT_KEYS;
constexpr bool COMBINES = SPLITS > 1;
constexpr int QKV_ROWS = (HEADS + 2 * KV_HEADS) * HD;
constexpr long long HEAD_STRIDE = KV_HEADS > 1 ? TP_CACHE_ROWS * HD * 2ll : 0;  // bytes of the cache, from head to head
constexpr int LAYER_PHASES = COMBINES ? 6 : 5, FIRST_PHASES = MODULATED ? 1 : 2, STEP_PHASES = LAYER_PHASES * L + FIRST_PHASES + 1;
__device__ __forceinline__ bool is_self(int layer) { return !ACROSS || (SELF_EVERY > 0 && layer % SELF_EVERY == 0); }

constexpr __host__ __device__ int divisor(int of, int limit) {  // the largest one up to the limit
  int found = 1;
  for (int i = 1; i <= limit; ++i)
    if (of % i == 0) found = i;
  return found;
}

constexpr __host__ __device__ int power_of_two(int up_to, int limit) {  // the largest one
  int found = 1;
  while (found * 2 <= up_to && found * 2 <= limit) found *= 2;
  return found;
}

// A product's shape and how warps share it out. RANGES_: tokens are cut into so many; a block has tiles for one of them.
// PARTIES_: of blocks with the same tiles. IN_FLIGHT_: loads of weights that a lane has on their way, at most. INT8_: whether
// the weights are int8.
template <int CHANNELS_, int COLUMNS_, int RANGES_ = 1, int PARTIES_ = BLOCKS / RANGES_, int IN_FLIGHT_ = TP_WEIGHTS_IN_FLIGHT,
          bool INT8_ = INT8>
struct Shape {
  static constexpr bool WHOLE = INT8_;
  static constexpr int TILES = CHANNELS_ / 8, PARTS = WHOLE ? PIECES : 1;  // pieces of a chunk
  static constexpr int CHUNKS = (COLUMNS_ + PARTS * PIECE - 1) / (PARTS * PIECE);
  static constexpr int RANGES = RANGES_, RANGE = (T + RANGES - 1) / RANGES;        // tokens
  static constexpr int GROUPS = (RANGE + 7) / 8, M_TILES = (RANGE + 15) / 16;      // of 8 and of 16 of them
  static constexpr int PARTIES = PARTIES_, BLOCK_TILES = (TILES + PARTIES - 1) / PARTIES;  // of a block at most
  static constexpr bool LEFT_OUT = PARTIES * RANGES < BLOCKS;                      // blocks that have none
  static constexpr int TILE_ROOM = TP_SUMS / M_TILES;                // of a warp, by its registers for sums
  static constexpr int WN_WANTED = (BLOCK_TILES + TILE_ROOM - 1) / TILE_ROOM;
  static constexpr int WN = WN_WANTED <= 1 ? 1 : WN_WANTED <= 2 ? 2 : 4;
  static constexpr int WK = WARPS / WN;
  static constexpr int WARP_WANTED = (BLOCK_TILES + WN - 1) / WN;
  static constexpr int WARP_TILES = WARP_WANTED < TILE_ROOM ? WARP_WANTED : TILE_ROOM;
  static constexpr int PASS_TILES = WN * WARP_TILES;
  static constexpr int PASSES = (BLOCK_TILES + PASS_TILES - 1) / PASS_TILES;
  static constexpr int WARP_CHUNKS = (CHUNKS + WK - 1) / WK;
  static constexpr int LOADS = WARP_CHUNKS * WARP_TILES;  // of a lane, in a pass
  static constexpr int IN_FLIGHT = divisor(LOADS, IN_FLIGHT_);
  static constexpr int A_ROOM = TP_ACTIVATIONS_IN_FLIGHT / (GROUPS * PARTS), A_WANTED = A_ROOM < 1 ? 1 : A_ROOM;
  static constexpr int A_IN_FLIGHT = A_WANTED < WARP_CHUNKS ? A_WANTED : WARP_CHUNKS;  // chunks
  static constexpr int SUM_ROWS = RANGES > 1 ? RANGE : GROUPS * 8, SUM_WORDS = WK * PASS_TILES * SUM_ROWS * 8;
  static constexpr long long BYTES = (long long)TILES * CHUNKS * CHUNK_BYTES;
};
using QkvShape = Shape<QKV_ROWS, D, TP_WIDE_RANGES>;
using OutShape = Shape<D, HEADS * HD, TP_RANGES>;
using GateUpShape = Shape<2 * F, D, TP_WIDE_RANGES>;
using DownShape = Shape<D, F, TP_RANGES>;
using MixShape = Shape<D, D, TP_RANGES, BLOCKS / TP_RANGES, TP_WEIGHTS_IN_FLIGHT, false>;  // bfloat16 beside int8, too
static_assert(MODULATED || !FP8, "the mixed tokens' operands are bfloat16");
// Across at once: a block has a head for up to 8 tokens. Keys and values are on their way beside the weights: half as many
using QueriesShape = Shape<HEADS * HD, D, (T + 7) / 8, HEADS, TP_WEIGHTS_IN_FLIGHT / 2>;
using EmbedShape = Shape<D, F>;  // how a step's first phase shares out columns
constexpr long long QKV_AT = 0, OUT_AT = QkvShape::BYTES, GATE_UP_AT = OUT_AT + OutShape::BYTES;
constexpr long long DOWN_AT = GATE_UP_AT + GateUpShape::BYTES, LAYER_BYTES = DOWN_AT + DownShape::BYTES;
constexpr int D_TILES = D / 8;

// Shared memory, words. Sums of products and what attention keeps take turns.
constexpr int DIM_GROUPS = (HD + 63) / 64;        // of 64 columns: what a warp weighs of values
constexpr int KEY_GROUPS = WARPS / DIM_GROUPS < 8 ? WARPS / DIM_GROUPS : 8;  // of warps, which share out the keys
constexpr bool BY_WARPS = HD <= 64 && SPLITS == 1;  // attention of narrow heads: attention_by_warps.cu
constexpr int LOGITS_ROW = SPLIT_KEYS + 4, WEIGHTS_ROW = SPLIT_KEYS / 2 + 4, OUT_ROW = HD + 4;
constexpr int S_RMS = 0, S_WORK = 64;
constexpr int S_WEIGHTS = S_WORK + 16 * LOGITS_ROW, S_OUT = S_WEIGHTS + 16 * WEIGHTS_ROW;
constexpr int QUERIES_ROW = HD / 2 + 16;  // two rows in different banks
constexpr int S_QUERIES = S_OUT + KEY_GROUPS * 16 * OUT_ROW, ATTENTION_END = S_QUERIES + 16 * QUERIES_ROW;
constexpr __host__ __device__ int larger(int a, int b) { return a > b ? a : b; }
constexpr int PRODUCTS_END = S_WORK + larger(larger(QkvShape::SUM_WORDS, OutShape::SUM_WORDS),
                                             larger(GateUpShape::SUM_WORDS, DownShape::SUM_WORDS));  // MixShape's are DownShape's at most
static_assert(larger(ATTENTION_END, PRODUCTS_END) * 4 <= TP_SHARED_BYTES, "too little shared memory");
static_assert(T <= 64 && WARPS >= DIM_GROUPS && WARPS % 4 == 0, "sizes");
