// Matrix products.

__device__ __forceinline__ u32 take_slot(Cta& b) {
  const u32 slot = b.slot;
  barrier_wait(b.full(slot), b.phase);
  __syncwarp();
  if (++b.slot == STAGES) b.slot = 0, b.phase ^= 1;
  return slot;
}
// Give a slot back. Not before the loads from it have arrived: the copy engine isn't ordered behind loads that are
// still on their way (seen as wrong sums). Hence an address that needs what they brought.
__device__ __forceinline__ void give_slot(const Cta& b, u32 slot, u32 seen = 0, u32 warps = 1) {
  __syncwarp();
  if (b.lane() == 0)  // for so many warps
    asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0], %1;" ::"r"(b.empty(slot) + (seen & b.a.zero)), "r"(warps)
                 : "memory");
}

// The same without a branch, which would make products wait for each other, for what products alone have read.
__device__ __forceinline__ void give_slot_if(const Cta& b, u32 slot, bool really) {
  asm volatile("{.reg .pred p; setp.ne.u32 p, %1, 0; @p mbarrier.arrive.shared::cta.b64 _, [%0];}" ::"r"(b.empty(slot)),
               "r"(u32(really && b.lane() == 0))
               : "memory");
}

__device__ __forceinline__ uint4 load_fragment(const byte* p, int lane) { return *(const uint4*)(p + lane * 16); }
__device__ __forceinline__ u32 fold(uint4 v) { return v.x; }

// A warp's share of a group whose reduction has so many parts: its tile, the first of its warpgroup, its part.
struct Share {
  int part, first, tile;
  __device__ __forceinline__ Share(const Cta& b, int parts) {
    const int group = b.warp() >> 2, rows = W / 4 / parts;
    part = group / rows, first = group % rows * 4, tile = first + (b.warp() & 3);
  }
};

// A lane's share of a fragment of weights, as operand A.
__device__ __forceinline__ uint4 load_weights(const Cta& b, u32 at) {
  uint4 v;  // ldmatrix's second quarter of lanes fetches rows g + 8, which lie behind the other columns of rows g
  ldmatrix(v, b.base + at + b.lane() % 8 * 16 + b.lane() / 8 % 2 * 256 + b.lane() / 16 * 128);
  return v;
}

// This warp's share of the first rounds of a group of tiles, read before its activations are there.
template <int TILES_, int ROUNDS>
struct Ahead {
  uint4 weights[imax(ROUNDS * ROUND_FRAGMENTS, 1)];

  __device__ __forceinline__ explicit Ahead(Cta& b) {
    constexpr int PARTS = group_parts(TILES_);
    const Share my(b, PARTS);
#pragma unroll
    for (int r = 0; r < ROUNDS; ++r) {
      const u32 slot = take_slot(b), at = M_RING + slot * SLOT + (my.part * TILES_ + my.tile) * FRAGMENT;
      u32 seen = 0;
#pragma unroll
      for (int i = 0; i < ROUND_FRAGMENTS; ++i) {
        weights[r * ROUND_FRAGMENTS + i] = load_weights(b, at + i * PARTS * TILES_ * FRAGMENT);
        seen ^= fold(weights[r * ROUND_FRAGMENTS + i]);
      }
      give_slot(b, slot, seen);
    }
  }
};

// One group of tiles, this warp's share of it. x: where activations lie in shared memory; `blocks` of the reduction, a
// multiple of EVEN, of whose rounds AHEAD have been loaded.
template <int TILES_, int EVEN, int AHEAD>
struct GroupProduct {
  static constexpr int PARTS = group_parts(TILES_);
  static constexpr bool EXACT = EVEN % (KB * filled(TILES_)) == 0;
  static constexpr bool SOME_REST = TILES_ <= 4 && PARTS == 2;  // warpgroups that have no tile
  static constexpr int UNROLL = EXACT && MANY ? 16 : 1;  // where the number of rounds is known
  Cta& b;
  const Share my;
  const int blocks, tiles, rounds, rounds_of_slot;
  const u32 first;  // this part's first activations, as an operand's place
  float (&sums)[NT * 4];

  __device__ __forceinline__ GroupProduct(Cta& block, int x, int n, int t, float (&to)[NT * 4])
      : b(block), my(block, PARTS), blocks(n), tiles(t), rounds(plan_rounds(TILES_, blocks)),
        rounds_of_slot(slot_rounds(PARTS, t)),
        first(behind(operand_place(b.start() + x, FP8 ? NT * 128 : 128), EXACT ? my.part * NT * 256 : 0)), sums(to) {
#pragma unroll
    for (int i = 0; i < NT * 4; ++i) sums[i] = 0;
  }
  // What this warp's fragment i of round r meets. Blocks that fill up a round have no weight, their activations are any
  // (that are numbers: of a pair's missing block its other).
  __device__ __forceinline__ u64 activations(int r, int i) const {
    constexpr int NEXT_TOKENS = FP8 ? 128 : 256;
    const int fragment = (r * ROUND_FRAGMENTS + i) * PARTS;
    if constexpr (EXACT) return operand_at<NEXT_TOKENS>(behind(first, fragment * NT * 256));
    const int here = min(fragment + my.part, most(blocks, KB) - 1);
    const u32 place = behind(first, here * NT * 256);
    return operand_at<NEXT_TOKENS>(KB * (here + 1) > blocks ? place & 0xffff : place);
  }
  __device__ __forceinline__ void multiply(const Ahead<TILES_, AHEAD>& ahead) {
    begin_products();
#pragma unroll
    for (int i = 0; i < AHEAD * ROUND_FRAGMENTS; ++i) {
      const uint4 w = ahead.weights[i];
      add_from_registers(sums, w.x, w.y, w.z, w.w, activations(0, i), i);
    }
    commit_products();
  }

  // Weights from shared memory. A slot is given back when the round behind it has begun.
  __device__ __forceinline__ void from_slots() {
    const int tile = my.first < tiles ? my.first : 0;
    const u32 start = b.start(), weights = operand_place(start + M_RING + (my.part * tiles + tile) * FRAGMENT, 128);
    u32 next = of_warp(b.slot), phase = of_warp(b.phase), slot = 0, previous = 0, from = weights;
    int left = 0;  // rounds of the slot
#pragma unroll(UNROLL)
    for (int r = AHEAD; r < rounds; ++r) {
      const bool another = left == 0;
      if (another) {
        barrier_wait(start + M_BAR + (BAR_RING + next * 2) * 8, phase);
        __syncwarp();
        previous = slot, slot = next, left = rounds_of_slot, from = behind(weights, slot * SLOT);
        if (++next == STAGES) next = 0, phase ^= 1;
      }
      begin_products();
#pragma unroll
      for (int i = 0; i < ROUND_FRAGMENTS; ++i) {
        const u32 at = behind(from, i * PARTS * tiles * FRAGMENT);
        add_product(sums, operand_at<256>(at), activations(r, i), 1);
        if (i == 0) {
          commit_products();
          await_products<1>();  // the round before is done
          give_slot_if(b, previous, another && r > AHEAD);
        }
      }
      commit_products();
      --left, from = behind(from, ROUND_FRAGMENTS * PARTS * tiles * FRAGMENT);
    }
    b.slot = next, b.phase = phase;
    await_products<0>();
    if (rounds > AHEAD) give_slot(b, slot);
  }

  __device__ __forceinline__ void operator()(Ahead<TILES_, AHEAD>& ahead) {
    if constexpr (AHEAD > 0) multiply(ahead);
    if (SOME_REST && my.first >= 4) {
#pragma unroll 1
      for (int r = AHEAD; r < rounds; r += rounds_of_slot) give_slot(b, take_slot(b));
    } else {
      from_slots();
    }
    if constexpr (AHEAD > 0) {
#pragma unroll
      for (int i = 0; i < AHEAD * ROUND_FRAGMENTS; ++i) keep_until_here(ahead.weights[i]);
    }
  }
};

// Up to MT tiles (`tiles` of them) times the activations at x.
template <int MT, int EVEN, int AHEAD>
__device__ __forceinline__ void multiply(Cta& b, int x, int blocks, int tiles, float (*sums)[NT * 4],
                                         Ahead<group_tiles(MT), AHEAD>& ahead) {
  constexpr int N = group_tiles(MT);
  if constexpr (AHEAD > 0) {
    GroupProduct<MT, EVEN, AHEAD>(b, x, blocks, tiles, sums[0])(ahead);
  } else if (tiles > 0) {
    GroupProduct<N, EVEN, 0>(b, x, blocks, min(tiles, N), sums[0])(ahead);
    if constexpr (N < MT) {
      Ahead<group_tiles(MT - N), 0> next(b);
      multiply<MT - N, EVEN>(b, x, blocks, tiles - N, sums + 1, next);
    }
  }
}

// Where a lane's partial sums of 8 tokens lie. Of the last 8 only pairs that exist are kept.
__device__ __forceinline__ int partial_place(const Cta& b, int n) {
  return n * 512 + (TAIL == 4 || n + 1 < NT ? b.lane() : b.g() * TAIL + min(b.t(), TAIL - 1)) * 16;
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
__device__ __forceinline__ void store_partials(const Cta& b, byte* to, int tiles, float (*sums)[NT * 4]) {
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
__device__ __forceinline__ float4 total(const Cta& b, const byte* from, int tile, int n) {
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
  __device__ __forceinline__ Own(const Cta& b, int tiles) {
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
  __device__ __forceinline__ void meet() const {  // the warps of my tile, in the one group
    __syncwarp();
    asm volatile("bar.sync %0, %1;" ::"r"(TILE_MEETS + (tile[0] & 7)), "n"(group_parts(group_tiles(MT)) * 32) : "memory");
  }
  // Of two parts: the other's to `to`, the rest to `sums`.
  template <int PART>
  __device__ __forceinline__ void share_out(const Cta& b, byte* to, bool real, const float (&mixed)[NT * 4]) {
#pragma unroll
    for (int n = 0; n < NT; ++n) {
      const float4 sum = make_float4(mixed[n * 4], mixed[n * 4 + 1], mixed[n * 4 + 2], mixed[n * 4 + 3]);
      if (n % 2 == PART)
        sums[0][n / 2] = sum;
      else if (real && (n + 1 < NT || b.t() < TAIL))
        *(float4*)(to + partial_place(b, n)) = sum;
    }
  }
  // To `sums` come all parts' sums of what is mine. They pass through `region`, or a place of their own.
  __device__ __forceinline__ void add_up(const Cta& b, int region, int tiles, const float (*mixed)[NT * 4]) {
    byte* const place = b.smem + partials_place(region);
    auto other = [&](int i, int parts, int part, int n) {
      return (float4*)(place + (plan_others(i * 8) + (tile[i] & 7) * (parts - 1) + part) * PARTIAL +
                       partial_place(b, n));
    };
    if (PARTIALS_OVER_OPERAND) consumers_sync();
    if constexpr (plan_groups(MT) == 1 && group_parts(group_tiles(MT)) == 2) {  // branches, where else are selections
      const bool real = tile[0] < imin(tiles, group_tiles(MT));
      byte* const to = place + (tile[0] & 7) * PARTIAL;
      if (n[0][0] == 1)
        share_out<1>(b, to, real, mixed[0]);
      else
        share_out<0>(b, to, real, mixed[0]);
    } else {
#pragma unroll
      for (int i = 0; i < plan_groups(MT); ++i) {
        const int size = group_tiles(MT - i * 8), parts = group_parts(size);
        const Share my(b, parts);
#pragma unroll
        for (int n = 0; n < NT; ++n) {
          const float4 sum =
              make_float4(mixed[i][n * 4], mixed[i][n * 4 + 1], mixed[i][n * 4 + 2], mixed[i][n * 4 + 3]);
          const int owner = n % parts;
          if (my.part == owner)
            sums[i][n / parts] = sum;
          else if (my.tile < size && tile[i] < tiles && (n + 1 < NT || b.t() < TAIL))
            *other(i, parts, my.part - (my.part > owner), n) = sum;
        }
      }
    }
    if (plan_groups(MT) == 1)
      meet();
    else
      consumers_sync();
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
