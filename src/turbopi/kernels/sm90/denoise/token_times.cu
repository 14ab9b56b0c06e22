// Every token has a time of its own in each step: what depends on times, as one_time.cu has it for one.
//
// The table has a row for each time that occurs, and `token_rows` says which one a token takes in a step. In products'
// layouts a lane has two tokens of 8: so it takes factors and shifts for two. Shifts lie with a lane's two rows side by
// side, and those of gate|up are asked for behind the product, as there are too many of them to wait in registers.

constexpr size_t TABLE_ROW = size_t(2 * L + 1) * 3 * D, SHIFTED_ROW = size_t(L) * (NC * S) * (TILES * 16);
typedef unsigned short Row;
constexpr int ROWS_KEPT = NT * 8;  // of a step, in shared memory; of tokens that don't exist the last one's
constexpr int M_TOKEN_ROWS = M_BAR + SIZE_BAR - 128;
static_assert(ROWS_KEPT * sizeof(Row) <= 128, "room for rows");

// Rows of tokens `token` and `token` + 1 (even): of this step, from shared memory; of any step.
struct Rows {
  u32 even, odd;
};
__device__ __forceinline__ Rows rows_of(const Cta& b, int token) {
  const ushort2 two = *(const ushort2*)(b.smem + M_TOKEN_ROWS + token * sizeof(Row));
  return {two.x, two.y};
}
__device__ __forceinline__ u32 asked_row(const Cta& b, int step, int token) {
  return u32(__ldg(b.a.token_rows + step * T + imin(token, T - 1)));
}
__device__ __forceinline__ Rows asked_rows(const Cta& b, int step, int token) {
  return {asked_row(b, step, token), asked_row(b, step, token + 1)};
}

// Where the table's first row has what this step, or layer b.n, takes.
__device__ __forceinline__ const float* step_table(const Cta& b, int) { return b.a.table; }
__device__ __forceinline__ const float* next_table(const float* of_step) { return of_step; }
__device__ __forceinline__ const float* layer_table(const Cta& b, int step) {
  return b.a.table + 2 * (settled(b.n) - step * L) * (3 * D);
}
// Two numbers side by side for two tokens, as an item has them. SIZE: of a row.
template <size_t SIZE>
__device__ __forceinline__ Factors two_of_rows(const float* first_row, Rows rows) {
  const float2 even = __ldg((const float2*)(first_row + rows.even * SIZE)),
               odd = __ldg((const float2*)(first_row + rows.odd * SIZE));
  return make_float4(even.x, odd.x, even.y, odd.y);
}
// Two columns.
__device__ __forceinline__ Factors factors(const float* first_row, int column, Rows rows) {
  return two_of_rows<TABLE_ROW>(first_row + column, rows);
}

// What a norm's shift adds to a lane's rows of a product, `row` and `row` + 8, of 8 tokens n.
struct Shifts {
  const float* of;  // the table's first row
  __device__ __forceinline__ Shifts(const Cta& b, int step) : of(of_tiles(b, b.a.shifted, b.n - step * L)) {}
  __device__ __forceinline__ Factors operator()(const Cta& b, int row, int n) const {
    return two_of_rows<SHIFTED_ROW>(of + row + b.g(), rows_of(b, n * 8 + 2 * b.t()));  // [tile][8][2]
  }
};
// The same of gate|up, for a warp's items: before the product, if there is room for them to wait in registers.
struct GateUpShifts {
  static constexpr bool EARLY = OWN<GTL> == 1;
  Factors shift[GROUPS_GU][OWN<GTL>];
  __device__ __forceinline__ GateUpShifts(const Cta& b, const Shifts& shifts, const Own<GTL>& own) {
    if (EARLY) ask(b, shifts, own);
  }
  __device__ __forceinline__ void behind_product(const Cta& b, const Shifts& shifts, const Own<GTL>& own) {
    if (!EARLY) ask(b, shifts, own);
  }
  __device__ __forceinline__ void ask(const Cta& b, const Shifts& shifts, const Own<GTL>& own) {
#pragma unroll
    for (int i = 0; i < GROUPS_GU; ++i)
#pragma unroll
      for (int k = 0; k < OWN<GTL>; ++k)
        shift[i][k] = shifts(b, gate_up_row(b, own.tile[i]), imin(own.n[i][k], NT - 1));
  }
  __device__ __forceinline__ Factors operator()(int i, int k) const { return shift[i][k]; }
};

// What is added to a token's v_t before its Euler step.
__device__ __forceinline__ const float* action_shifts(const Cta& b, int step, int token) {
  return b.a.out_shift + asked_row(b, step, token) * A;
}
// Guidance and Euler step of one number of a token. Rounded after each operation, as PyTorch does; a gain of 0 changes
// nothing, and neither does a step of 0.
struct EulerStep {
  float time, step, gain, target;
  __device__ __forceinline__ EulerStep(const Cta& b, int s, int token, int number) {
    const int at = s * T + imin(token, T - 1);
    time = __ldg(b.a.token_times + at), step = __ldg(b.a.token_steps + at), gain = __ldg(b.a.gain + at);
    target = __ldg(b.a.target + imin(token, T - 1) * A + imin(number, A - 1));
  }
  __device__ __forceinline__ float operator()(const Cta&, float x, float& v) const {
    const float chunk = __fsub_rn(x, __fmul_rn(time, v));  // that v points to
    v = __fsub_rn(v, __fmul_rn(gain, __fsub_rn(target, chunk)));
    return __fadd_rn(x, __fmul_rn(step, v));
  }
};

// One thread's part of a step's rows: asked for early, kept in shared memory when nobody reads those of the step before
// any more.
struct KeptRow {
  bool mine;
  u32 row = 0;
  __device__ __forceinline__ KeptRow(const Cta& b, int step) : mine(b.thread < ROWS_KEPT && step < b.a.steps) {
    if (mine) row = asked_row(b, step, b.thread);
  }
  __device__ __forceinline__ void keep(const Cta& b) const {
    if (mine) *(Row*)(b.smem + M_TOKEN_ROWS + b.thread * sizeof(Row)) = Row(row);
  }
};

// What the norms of layer n need, to L2: as one_time.cu does it, for all rows that tokens take.
__device__ __forceinline__ void prefetch(const Cta& b, int n) {
  constexpr int OF_TILES = most(TILES * 16, 32), OF_SLICE = most(DX * 16, 32);  // lines
  const int step = n / L, l = n % L;
  if (step >= b.a.steps) return;
  const float* const shifted = of_tiles(b, b.a.shifted, l);
  const float* const table = b.a.table + 2 * l * (3 * D) + b.x0() * 16;
  u32 last = ~0u;
#pragma unroll 4
  for (int token = 0; token < T; ++token) {
    const u32 row = asked_row(b, step, token);
    if (row == last && token % 8) continue;  // neighbours mostly have the same
    last = row;
    const bool kept = !MANY || token / 8 % NC == b.cluster();  // here, of the stream
#pragma unroll 1
    for (int i = b.lane(); i < OF_TILES + (kept ? 4 * OF_SLICE : 0); i += 32) {
      const int slice = i - OF_TILES, norm = slice / OF_SLICE;
      prefetch_line(slice < 0 ? shifted + row * SHIFTED_ROW + i * 32
                              : table + row * TABLE_ROW + (2 + norm + norm / 2) * D + slice % OF_SLICE * 32);
    }
  }
}
