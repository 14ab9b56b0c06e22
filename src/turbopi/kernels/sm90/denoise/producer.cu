// What brings weights, keys and values.

// One thread of a CTA, which never waits for activations. What it loads is the same in every layer, so a list of it is
// made first: 100 cycles more for a slot are a microsecond in a layer.
struct Producer {
  // Few tokens' weights take up to half of the loop's time to load. At full speed they come in bursts, and what the
  // CTAs tell each other is late: so loads are some cycles apart, and those of gate|up wait for the keys' scores.
  static constexpr u32 PACE = MANY ? 0 : FP8 ? 450 : 750;
  static constexpr bool AHEAD = plan_slots(GTL, D16) > STAGES;  // some of gate|up finds no slot before it begins
  Cta& b;
  uint2* list;  // of slots: where from, bytes; an odd number of bytes: of keys or values, else of weights
  int slots = 0;
  u32 at = 0;

  __device__ explicit Producer(Cta& block) : b(block), list((uint2*)(block.smem + M_LIST)) {}
  __device__ __forceinline__ void add(u32 from, u32 bytes, bool keys) {
    list[slots++] = make_uint2(from, bytes | keys);
  }
  template <int MT, int FIRST = 0>
  __device__ __forceinline__ void product(int blocks, int tiles) {
    if constexpr (FIRST < MT) {
      constexpr int N = group_tiles(MT - FIRST), PARTS = group_parts(N);
      if (FIRST < tiles) {
        const int n = min(tiles - FIRST, N), rounds = plan_rounds(N, blocks), most_rounds = slot_rounds(PARTS, n);
        const u32 round = PARTS * ROUND_FRAGMENTS * n * FRAGMENT;
#pragma unroll 1
        for (int r = 0; r < rounds; r += most_rounds) {
          const u32 bytes = min(most_rounds, rounds - r) * round;
          add(at, bytes, false);
          at += bytes;
        }
        product<MT, FIRST + N>(blocks, tiles);
      }
    }
  }
  __device__ __forceinline__ void keys(u32 from, int count) {  // or values
#pragma unroll 1
    for (int k = 0; k < count; k += SLOT_TILES) add(from + k * KEY_TILE, min(SLOT_TILES, count - k) * KEY_TILE, true);
  }
  __device__ void run() {
    const PrefixShare mine(PREFIX_ROWS(b.a), b.rank());
    const int first = mine.first, count = mine.tiles;
    product<QTL + KVL>(D16, b.qn() + b.kvn());
    keys(0, count);
    const int last_key = slots - 1;
    keys(KEY_TILES * KEY_TILE, count);
    product<DX>(QT, b.xn());
    // When the keys have been scored, memory has nothing else to do for a while. Asked for earlier, gate|up is in the
    // way of what the scores wait for.
    const int gate_up = slots, scored = min(gate_up, last_key + STAGES), back = scored - last_key;
    product<GTL>(D16, b.gn());
    const int gate_up_end = slots;
    product<DX>(b.hn(), b.xn());
    u64 once, keep;  // L2 policies: weights are read once a step; keys and values by every cluster, every step
    asm volatile("createpolicy.fractional.L2::evict_first.b64 %0, 1.0;" : "=l"(once));
    asm volatile("createpolicy.fractional.L2::evict_last.b64 %0, 1.0;" : "=l"(keep));
    const byte* const first_weights = b.a.weights + b.a.starts[b.cluster() * S + b.rank()];
    auto prefetch = [&](const byte* weights, uint2 what) {
      asm volatile("cp.async.bulk.prefetch.L2.global.L2::cache_hint [%0], %1, %2;" ::"l"(weights + what.x), "r"(what.y),
                   "l"(once)
                   : "memory");
    };
    u32 slot = 0, free = 1, loaded = 0;
#pragma unroll 1
    for (int step = 0; step < b.a.steps; ++step) {
      const byte* weights = first_weights;
      const byte* keys = b.a.keys + size_t(first) * KEY_TILE;
#pragma unroll 1
      for (int l = 0; l < L; ++l, weights += b.a.layer_bytes, keys += size_t(2 * KEY_TILES) * KEY_TILE)
#pragma unroll 1
        for (int i = 0; i < slots; ++i) {
          const uint2 what = list[i];
          const bool key = what.y & 1;
          const u32 bytes = what.y & ~1u, full = b.full(slot);
          if (i == scored && (PACE || AHEAD)) {
            const bool wrapped = int(slot) < back;
            barrier_wait(b.empty(slot - back + (wrapped ? STAGES : 0)), free ^ !wrapped);
            if (AHEAD)
#pragma unroll 1
              for (int k = gate_up + STAGES; k < gate_up_end; ++k) prefetch(weights, list[k]);
          }
          barrier_wait(full + 8, free);  // until its last contents have been read
          barrier_expect(full, bytes);
          if (PACE && i < gate_up + STAGES) {  // the others wait for room as it is
            pause(loaded, PACE);
            loaded = u32(clock64());
          }
          bulk_load(b.base + M_RING + slot * SLOT, (key ? keys : weights) + what.x, bytes, full, key ? keep : once);
          if (++slot == STAGES) slot = 0, free ^= 1;
        }
    }
  }
};

// Before the loop, in L * KEY_TILES blocks: puts the valid keys and values into the order in which the tensor cores
// take them (zeros fill up the last tile), once instead of in every step, and zeroes the scratch memory, as no exchange
// has been used yet.
extern "C" __global__ void __launch_bounds__(256) turbopi_denoise_prepare(const __grid_constant__ Args a) {
  const int first = blockIdx.x * 256 + threadIdx.x;
  for (size_t at = first; at < SCRATCH; at += size_t(gridDim.x) * 256) {
    const u32 v = word_at_start(at);
    a.scratch[at] = make_uint4(v, v, v, v);
  }
  const int l = blockIdx.x / KEY_TILES, tile = blockIdx.x % KEY_TILES, length = PREFIX_ROWS(a);
  if (tile * 16 >= length) return;
#ifdef TP_KEEP
  if (a.keys_ready) return;
#endif
  typedef unsigned short half;
  const half* k = (const half*)(a.cache_k + l * a.layer_stride)FIRST_ROW(a);
  const half* v = (const half*)(a.cache_v + l * a.layer_stride)FIRST_ROW(a);
  uint4* to = (uint4*)(a.keys + (size_t(2 * l) * KEY_TILES + tile) * KEY_TILE);
#pragma unroll 4
  for (int i = threadIdx.x; i < QT * 32; i += 256) {
    const int g = (i >> 2) & 7, t = i & 3, column = i / 32 * 16;
    auto key = [&](int row, int col) {
      return tile * 16 + row < length ? *(const u32*)(k + size_t(tile * 16 + row) * HD + column + col) : 0;
    };
    auto value = [&](int row, int col) {
      if (tile * 16 + row >= length) return 0u;
      const u32 bits = v[size_t(tile * 16 + row) * HD + column + col];
      return FP8 ? pack(bf16_low(bits) * a.values_times[l], 0) & 0xffff : bits;
    };
    auto pair = [&](int row, int col) { return value(row, col) | value(row + 8, col) << 16; };
    to[i] = make_uint4(key(g, 2 * t), key(g + 8, 2 * t), key(g, 2 * t + 8), key(g + 8, 2 * t + 8));
    to[KEY_TILES * (KEY_TILE / 16) + i] =
        make_uint4(pair(t, g), pair(t, g + 8), pair(t + 4, g), pair(t + 4, g + 8));
  }
}

