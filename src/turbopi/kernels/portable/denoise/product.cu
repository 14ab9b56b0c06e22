// A product of activations with the block's tiles of weights.
//
//   Product<Shape> p(weights)   names the tiles
//   p.ask()                     asks for the first weights, before the barrier
//   p.run(...)                  all passes: multiply, add up the warps' sums in shared memory, finish each item
//
// An item is two neighbouring channels of a tile for one token. `finish` says what becomes of it: `factors` loads what
// depends on no other block, for the first item before the barrier, and `apply` takes the sums. All lanes of a warp come to
// `apply` (`valid` says which have an item), and four lanes side by side have the 8 channels of a token.

struct Item {
  int tile, token, pair;  // channels tile * 8 + 2 * pair, + 1
  bool valid;
};

// Tiles are shared out evenly: a block's first one.
template <class S>
__device__ __forceinline__ int first_tile(int block, int tiles = S::TILES, int blocks = BLOCKS) {
  return (long long)tiles * block / blocks;
}

template <class S>
struct Product {
  const byte* weights;  // this lane's of the product's first tile and chunk
  int thread;
  int first, end;  // tiles
  uint4 w[S::IN_FLIGHT];

  // tiles: the first ones alone
  __device__ __forceinline__ explicit Product(const byte* all, int tiles = S::TILES) : thread(thread_of_phase()) {
    weights = all + thread % 32 * 16;
    const int block = block_of_phase(), party = block / S::RANGES;
    first = first_tile<S>(party, tiles, S::PARTIES), end = first_tile<S>(party + 1, tiles, S::PARTIES);
    if (S::LEFT_OUT && party >= S::PARTIES) end = first;
  }
  // The first token. A member that is 0 costs sm_80's kernels registers
  __device__ __forceinline__ int from() const { return S::RANGES > 1 ? blockIdx.x % S::RANGES * S::RANGE : 0; }
  __device__ __forceinline__ int first_chunk() const { return thread / 32 / S::WN * S::WARP_CHUNKS; }
  // Load number n of a lane, counted over all passes.
  __device__ __forceinline__ uint4 load(int pass, int n) const {
    const int tile = first + pass * S::PASS_TILES + thread / 32 % S::WN * S::WARP_TILES + n % S::WARP_TILES;
    const int chunk = n / S::WARP_TILES;
    uint4 v = make_uint4(0, 0, 0, 0);
    const bool there = S::CHUNKS % S::WK == 0 || first_chunk() + chunk < S::CHUNKS;
    if (tile < end && there)
      v = load_weights(weights + ((long long)tile * S::CHUNKS + first_chunk() + chunk) * CHUNK_BYTES);
    return v;
  }
  __device__ __forceinline__ void ask() {
#pragma unroll
    for (int n = 0; n < S::IN_FLIGHT; ++n) w[n] = load(0, n);
  }
  __device__ __forceinline__ void load_chunk(uint4 (&a)[S::GROUPS][S::PARTS], const byte* activation, int chunk) const {
    const int lane = thread % 32, at = first_chunk() + chunk;
    const bool there = S::CHUNKS % S::WK == 0 || at < S::CHUNKS;
#pragma unroll
    for (int group = 0; group < S::GROUPS; ++group) {
      const int token = from() + group * 8 + lane / 4;
#pragma unroll
      for (int piece = 0; piece < S::PARTS; ++piece) {
        a[group][piece] = make_uint4(0, 0, 0, 0);
        if (there && token < T && (S::RANGES == 1 || token < from() + S::RANGE))
          a[group][piece] = load_shared_by_grid(activation + ((at * S::PARTS + piece) * T + token) * 64 + lane % 4 * 16);
      }
    }
  }
  __device__ __forceinline__ Item item(int pass, int index) const {
    const int tile = index / (4 * S::RANGE);
    Item i{first + pass * S::PASS_TILES + tile, from() + index / 4 % S::RANGE, index % 4, false};
    i.valid = tile < S::PASS_TILES && i.tile < end && (T % S::RANGES == 0 || i.token < T);
    return i;
  }

  // `meanwhile` is made while the first activations are on their way; what it needs is asked for in front of them.
  template <class Finish, class Meanwhile>
  __device__ __forceinline__ void run(Grid& grid, float* smem, const byte* activation, Finish& finish, Meanwhile& meanwhile) {
    const int warp = thread / 32, lane = thread % 32;
    Item mine = item(0, thread);
    auto factors = finish.factors(mine);
    grid.wait();
    if ((S::TILES < S::PARTIES || S::LEFT_OUT) && first == end) return;  // it would load all activations for nothing
    meanwhile.ask(thread, from());
    uint4 a[S::A_IN_FLIGHT][S::GROUPS][S::PARTS];
    for (int pass = 0; pass < S::PASSES; ++pass) {
      if (S::PASSES > 1) thread = of_phase(thread), first = of_phase(first), end = of_phase(end);
      if (pass == 0 || S::A_IN_FLIGHT < S::WARP_CHUNKS) {
#pragma unroll
        for (int chunk = 0; chunk < S::A_IN_FLIGHT; ++chunk) load_chunk(a[chunk], activation, chunk);
      }
      if (pass == 0) meanwhile.make(thread, from());
      float c[S::WARP_TILES][S::M_TILES][4] = {};
#pragma unroll
      for (int chunk = 0; chunk < S::WARP_CHUNKS; ++chunk) {
        uint4(&here)[S::GROUPS][S::PARTS] = a[chunk % S::A_IN_FLIGHT];
#pragma unroll
        for (int tile = 0; tile < S::WARP_TILES; ++tile) {
          const int n = chunk * S::WARP_TILES + tile, next = n + S::IN_FLIGHT;
#pragma unroll
          for (int piece = 0; piece < S::PARTS; ++piece) {
            const uint4 b = piece_of_weights<S::WHOLE>(w[n % S::IN_FLIGHT], piece);
#pragma unroll
            for (int m = 0; m < S::M_TILES; ++m) {
              const uint4 none = make_uint4(0, 0, 0, 0);
              const uint4 high = 2 * m + 1 < S::GROUPS ? here[2 * m + 1 < S::GROUPS ? 2 * m + 1 : 0][piece] : none;
              mma_chunk(c[tile][m], here[2 * m][piece], high, b);
            }
          }
          if (next < S::LOADS)
            w[n % S::IN_FLIGHT] = load(pass, next);
          else if (pass + 1 < S::PASSES)
            w[n % S::IN_FLIGHT] = load(pass + 1, next - S::LOADS);
        }
        if (chunk + S::A_IN_FLIGHT < S::WARP_CHUNKS) load_chunk(here, activation, chunk + S::A_IN_FLIGHT);
      }
      if (pass > 0) __syncthreads();  // the sums before have been read
      float* const sums = smem + S_WORK;  // [WK][tile][token][8]
#pragma unroll
      for (int tile = 0; tile < S::WARP_TILES; ++tile)
#pragma unroll
        for (int half = 0; half < S::GROUPS; ++half) {
          if (half * 8 + 8 > S::SUM_ROWS && half * 8 + lane / 4 >= S::SUM_ROWS) continue;
          const int at = warp / S::WN * S::PASS_TILES + warp % S::WN * S::WARP_TILES + tile;
          const float(&of)[4] = c[tile][half / 2];
          *(float2*)(sums + (at * S::SUM_ROWS + half * 8 + lane / 4) * 8 + lane % 4 * 2) =
              half % 2 ? make_float2(of[2], of[3]) : make_float2(of[0], of[1]);
        }
      __syncthreads();
      constexpr int ITEMS = S::PASS_TILES * S::RANGE * 4;
      // For the next item's factors, where registers aren't short
      constexpr bool ASKS_AHEAD = MODULATED && S::PASSES == 1 && ITEMS > THREADS;
      Item next = mine;
      auto next_factors = factors;
#pragma unroll 1
      for (int index = thread; index - lane < ITEMS; index += THREADS) {
        if (ASKS_AHEAD) {
          mine = next, factors = next_factors;
          next = item(pass, index + THREADS), next_factors = finish.factors(next);
        } else if (pass > 0 || index >= THREADS) {
          mine = item(pass, index), factors = finish.factors(mine);
        }
        float2 sum = make_float2(0, 0);
        if (mine.valid) {
          const int row = (mine.tile - first - pass * S::PASS_TILES) * S::SUM_ROWS + mine.token - from();
          const float* const of = sums + row * 8 + mine.pair * 2;
#pragma unroll
          for (int k = 0; k < S::WK; ++k) {
            const float2 part = *(const float2*)(of + k * S::PASS_TILES * S::SUM_ROWS * 8);
            sum.x += part.x, sum.y += part.y;
          }
        }
        finish.apply(mine, factors, sum);
      }
    }
  }
};

// Brings the block's weights of a product to L2.
template <class S>
__device__ __forceinline__ void ahead(const byte* weights) {
  if (!TP_AHEAD) return;
  const int block = block_of_phase(), first = first_tile<S>(block), end = first_tile<S>(block + 1);
  const byte* const from = weights + (long long)first * S::CHUNKS * CHUNK_BYTES;
  for (int at = thread_of_phase() * 128; at < (end - first) * S::CHUNKS * CHUNK_BYTES; at += THREADS * 128)
    to_l2(from + at);
}
