// Part 5 of 11: matrix products.

__device__ __forceinline__ u32 take_slot(Block& b, bool full = false) {
  const u32 slot = b.slot;
  if (!full) barrier_wait(b.full(slot), b.phase);
  __syncwarp();
  if (++b.slot == STAGES) b.slot = 0, b.phase ^= 1;
  return slot;
}
// Give a slot back. Not before the loads from it have arrived: the copy engine isn't ordered behind loads that are
// still on their way (seen as wrong sums). Hence an address that needs what they brought.
__device__ __forceinline__ void give_slot(const Block& b, u32 slot, u32 seen = 0) {
  __syncwarp();
  if (b.lane == 0) barrier_arrive(b.empty(slot) + (seen & b.a.zero));
}

// The same without a branch, which would make products wait for each other, for what products alone have read.
__device__ __forceinline__ void give_slot_if(const Block& b, u32 slot, bool really) {
  asm volatile("{.reg .pred p; setp.ne.u32 p, %1, 0; @p mbarrier.arrive.shared::cta.b64 _, [%0];}" ::"r"(b.empty(slot)),
               "r"(u32(really && b.lane == 0))
               : "memory");
}

__device__ __forceinline__ uint4 load_fragment(const byte* p, int lane) { return *(const uint4*)(p + lane * 16); }
__device__ __forceinline__ u32 fold(uint4 v) { return v.x; }

// A warp's share of a group whose reduction has so many parts: its tile, the first of its warpgroup, its part.
struct Share {
  int part, first, tile;
  __device__ __forceinline__ Share(const Block& b, int parts) {
    const int group = b.warp >> 2, rows = W / 4 / parts;
    part = group / rows, first = group % rows * 4, tile = first + (b.warp & 3);
  }
};

// One group of tiles, this warp's share of it. x: activations in shared memory; `blocks` of the reduction, a multiple
// of EVEN. A product is issued when the one before has begun, so what else there is to do stands between two.
template <int TILES_, int EVEN>
__device__ __forceinline__ void multiply_group(Block& b, u32 x, int blocks, int tiles, float (&sums)[NT * 4]) {
  constexpr int PARTS = group_parts(TILES_);
  constexpr bool EXACT = EVEN % (KB * PARTS * 4) == 0;
  const Share my(b, PARTS);
  const int rounds = plan_rounds(PARTS, blocks), rounds_of_slot = slot_rounds(PARTS, tiles);
  const int first = my.first < tiles ? my.first : 0;
  const u64 weights = operand(b.base + M_RING + (my.part * tiles + first) * FRAGMENT, 256, 128);
  const u64 all = operand(x, 256, 128);
  // Of a block's activations; blocks that fill up a round have no weight, their activations are any.
  auto place = [&](int unit, int half) {
    const int block = unit * KB + half;
    return (EXACT ? block : min(block, blocks - 1)) * NT * 256;
  };
  auto activations = [&](int unit, int half) { return behind(all, place(unit, half)); };
#pragma unroll
  for (int i = 0; i < NT * 4; ++i) sums[i] = 0;
  u32 slot = 0, from = 0, previous = ~0u;
  int left = 0;  // rounds of the slot
  bool full = false;
#pragma unroll 1
  for (int r = 0; r < rounds; ++r) {
    if (left == 0) slot = take_slot(b, full), left = rounds_of_slot, from = slot * SLOT, full = false;
    const int unit = r * RPS * PARTS + my.part;
    if constexpr (FP8 && FEW) {  // by mma, a tile a warp: of E4M3 weights it takes both blocks of a fragment at once
      const byte* p = b.smem + M_RING + from + (my.part * tiles + min(my.tile, tiles - 1)) * FRAGMENT;
      uint4 w[RPS];
      u32 seen = 0;
#pragma unroll
      for (int i = 0; i < RPS; ++i) w[i] = load_fragment(p + i * PARTS * tiles * FRAGMENT, b.lane), seen ^= fold(w[i]);
#pragma unroll
      for (int i = 0; i < RPS; ++i)
#pragma unroll
        for (int half = 0; half < 2; ++half) {
          const uint4 a = half ? from_e4m3(w[i].z, w[i].w) : from_e4m3(w[i].x, w[i].y);
          uint4 v;  // of the first 8 tokens 8 columns, the other 8, then of the next 8 tokens
          ldmatrix(v, x + place(unit + i * PARTS, half) + b.lane * 16);
          mma_half(sums, a, make_uint2(v.x, v.y));
          if (NT > 1) mma_half(sums + (NT - 1) * 4, a, make_uint2(v.z, v.w));
        }
      if (--left == 0 || r + 1 == rounds) give_slot(b, slot, seen);
    } else if constexpr (FP8) {  // by wgmma, two fragments at a time
      static_assert(RPS % 2 == 0, "pairs of fragments");
      const byte* p = b.smem + M_RING + from + (my.part * tiles + min(my.tile, tiles - 1)) * FRAGMENT;
#pragma unroll 1
      for (int i = 0; i < RPS; i += 2) {
        const uint4 w0 = load_fragment(p + i * PARTS * tiles * FRAGMENT, b.lane),
                    w1 = load_fragment(p + (i + 1) * PARTS * tiles * FRAGMENT, b.lane);
        const uint4 a0 = from_e4m3(w0.x, w0.y), a1 = from_e4m3(w0.z, w0.w), a2 = from_e4m3(w1.x, w1.y),
                    a3 = from_e4m3(w1.z, w1.w);
        begin_products();
        add_product(sums, a0.x, a0.y, a0.z, a0.w, activations(unit + i * PARTS, 0), r | i);
        add_product(sums, a1.x, a1.y, a1.z, a1.w, activations(unit + i * PARTS, 1), 1);
        add_product(sums, a2.x, a2.y, a2.z, a2.w, activations(unit + (i + 1) * PARTS, 0), 1);
        add_product(sums, a3.x, a3.y, a3.z, a3.w, activations(unit + (i + 1) * PARTS, 1), 1);
        commit_products();
        if (i + 2 == RPS && (left == 1 || r + 1 == rounds)) give_slot(b, slot);  // what was loaded has been used
        await_products<0>();  // it reads these registers; other warpgroups multiply meanwhile
      }
      --left;
    } else {
      begin_products();
#pragma unroll
      for (int i = 0; i < RPS; ++i) {
        add_product(sums, behind(weights, from + i * PARTS * tiles * FRAGMENT), activations(unit + i * PARTS, 0),
                    r | i);
        if (i == 0) {
          commit_products();
          await_products<1>();  // the round before is done
          give_slot_if(b, previous, previous != ~0u);
          full = left == 1 && r + 1 < rounds && barrier_over(b.full(b.slot), b.phase);
        }
      }
      commit_products();
      previous = --left == 0 ? slot : ~0u;
    }
    from += RPS * PARTS * tiles * FRAGMENT;
  }
  await_products<0>();
  if (!FP8 && rounds > 0) give_slot(b, slot);
}

// Before activations are multiplied. A fence that waits for whatever this thread has asked memory for; mma needs none.
__device__ __forceinline__ void show_activations() {
  if (!(FP8 && FEW)) show_to_products();
}
// Up to MT tiles (`tiles` of them) times the activations.
template <int MT, int EVEN, int FIRST = 0>
__device__ __forceinline__ void multiply(Block& b, u32 x, int blocks, int tiles, float (*sums)[NT * 4]) {
  if constexpr (FIRST < MT) {
    constexpr int N = group_tiles(MT - FIRST);
    if (FIRST < tiles) {
      multiply_group<N, EVEN>(b, x, blocks, min(tiles - FIRST, N), sums[FIRST / 8]);
      multiply<MT, EVEN, FIRST + N>(b, x, blocks, tiles, sums);
    }
  }
}

// Where a lane's partial sums of 8 tokens lie. Of the last 8 only pairs that exist are kept.
__device__ __forceinline__ int partial_place(const Block& b, int n) {
  return n * 512 + (TAIL == 4 || n + 1 < NT ? b.lane : b.g() * TAIL + min(b.t(), TAIL - 1)) * 16;
}
// So many parts of a tile, always in the same order.
template <int PARTS>
__device__ __forceinline__ float4 add_up(const byte* p) {
  float4 v[PARTS];
#pragma unroll
  for (int i = 0; i < PARTS; ++i) v[i] = *(const float4*)(p + i * PARTIAL);
#pragma unroll
  for (int d = 1; d < PARTS; d *= 2)
#pragma unroll
    for (int i = 0; i + d < PARTS; i += 2 * d)
      v[i].x += v[i + d].x, v[i].y += v[i + d].y, v[i].z += v[i + d].z, v[i].w += v[i + d].w;
  return v[0];
}
// The warps' partial sums to shared memory, and a tile's total back.
template <int MT, int FIRST = 0>
__device__ __forceinline__ void store_partials(const Block& b, byte* to, int tiles, float (*sums)[NT * 4]) {
  if constexpr (FIRST < MT) {
    constexpr int N = group_tiles(MT - FIRST), PARTS = group_parts(N);
    const Share my(b, PARTS);
    const float* sum = sums[FIRST / 8];
    if (FIRST + my.tile < tiles && my.tile < N) {
#pragma unroll
      for (int n = 0; n < NT; ++n)
        if (n + 1 < NT || b.t() < TAIL)
          *(float4*)(to + (plan_partials(FIRST) + my.tile * PARTS + my.part) * PARTIAL + partial_place(b, n)) =
              make_float4(sum[n * 4], sum[n * 4 + 1], sum[n * 4 + 2], sum[n * 4 + 3]);
    }
    store_partials<MT, FIRST + N>(b, to, tiles, sums);
  }
}
template <int MT, int FIRST = 0>
__device__ __forceinline__ float4 total(const Block& b, const byte* from, int tile, int n) {
  constexpr int N = group_tiles(MT - FIRST), PARTS = group_parts(N);
  if constexpr (FIRST + N < MT)
    if (tile >= FIRST + N) return total<MT, FIRST + N>(b, from, tile, n);
  return add_up<PARTS>(from + (plan_partials(FIRST) + (tile - FIRST) * PARTS) * PARTIAL + partial_place(b, n));
}

// Or else: the warps that share a tile divide its tokens, part p has 8 tokens n = p, p + parts, ... An item is (tile, 8
// tokens), a warp has OWN of them in each group of tiles.
template <int MT>
constexpr int OWN = most(NT, group_parts(group_tiles(MT)));
template <int MT>
struct Own {
  float4 sums[plan_groups(MT)][OWN<MT>];
  int tile[plan_groups(MT)], n[plan_groups(MT)][OWN<MT>];
  bool mine[plan_groups(MT)][OWN<MT>];

  __device__ __forceinline__ Own(const Block& b, int tiles) {
#pragma unroll
    for (int i = 0; i < plan_groups(MT); ++i) {
      const int size = group_tiles(MT - i * 8), parts = group_parts(size);
      const Share my(b, parts);
      tile[i] = i * 8 + my.tile;
#pragma unroll
      for (int k = 0; k < OWN<MT>; ++k)
        n[i][k] = k * parts + my.part, mine[i][k] = my.tile < size && tile[i] < tiles && n[i][k] < NT;
    }
  }
  // To `sums` come all parts' sums of what is mine. They lie APART, or in `region`: over the operand of the
  // product unless SPREAD.
  __device__ __forceinline__ void add_up(const Block& b, int region, int tiles, const float (*mixed)[NT * 4]) {
    byte* const place = b.smem + (APART ? M_SUMS : region);
    auto other = [&](int i, int parts, int part, int n) {
      return (float4*)(place + (plan_others(i * 8) + (tile[i] & 7) * (parts - 1) + part) * PARTIAL +
                       partial_place(b, n));
    };
    if (!APART && !SPREAD) consumers_sync();
#pragma unroll
    for (int i = 0; i < plan_groups(MT); ++i) {
      const int size = group_tiles(MT - i * 8), parts = group_parts(size);
      const Share my(b, parts);
#pragma unroll
      for (int n = 0; n < NT; ++n) {
        const float4 sum = make_float4(mixed[i][n * 4], mixed[i][n * 4 + 1], mixed[i][n * 4 + 2], mixed[i][n * 4 + 3]);
        const int owner = n % parts;
        if (my.part == owner)
          sums[i][n / parts] = sum;
        else if (my.tile < size && tile[i] < tiles && (n + 1 < NT || b.t() < TAIL))
          *other(i, parts, my.part - (my.part > owner), n) = sum;
      }
    }
    if ((APART || SPREAD) && plan_groups(MT) == 1) {  // for the warps of my tile
      __syncwarp();
      asm volatile("bar.sync %0, %1;" ::"r"(8 + (tile[0] & 7)), "n"(group_parts(group_tiles(MT)) * 32) : "memory");
    } else {
      consumers_sync();
    }
#pragma unroll
    for (int i = 0; i < plan_groups(MT); ++i) {
      const int parts = group_parts(group_tiles(MT - i * 8));
#pragma unroll
      for (int k = 0; k < OWN<MT>; ++k)
        if (mine[i][k])
#pragma unroll
          for (int part = 0; part + 1 < parts; ++part) {
            const float4 v = *other(i, parts, part, n[i][k]);
            sums[i][k].x += v.x, sums[i][k].y += v.y, sums[i][k].z += v.z, sums[i][k].w += v.w;
          }
    }
  }
};
