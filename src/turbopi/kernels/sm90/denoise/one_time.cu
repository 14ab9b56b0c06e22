// All tokens have one time, that of the step: what depends on times. token_times.cu is the form in which they differ.

// Where the step's rows of the table begin, and those of layer b.n.
__device__ __forceinline__ const float* step_table(const Cta& b, int step) {
  return b.a.table + size_t(step) * (2 * L + 1) * 3 * D;
}
__device__ __forceinline__ const float* next_table(const float* of_step) { return of_step + (2 * L + 1) * 3 * D; }
__device__ __forceinline__ const float* layer_table(const Cta& b, int step) {
  return b.a.table + (2 * settled(b.n) + step) * (3 * D);
}
// Two columns of a row of the table, which all tokens take.
struct Rows {};
__device__ __forceinline__ Rows rows_of(const Cta&, int) { return {}; }
__device__ __forceinline__ Rows asked_rows(const Cta&, int, int) { return {}; }
__device__ __forceinline__ Factors factors(const float* row, int column, Rows) {
  return __ldg((const float2*)(row + column));
}

// What a norm's shift adds to a lane's rows of a product, `row` and `row` + 8, of 8 tokens.
struct Shifts {
  const float* of;
  __device__ __forceinline__ Shifts(const Cta& b, int) : of(of_tiles(b, b.a.shifted, b.n)) {}
  __device__ __forceinline__ Factors operator()(const Cta&, int row, int) const {
    return make_float2(__ldg(of + row), __ldg(of + row + 8));
  }
};
// The same of gate|up, for a warp's items.
struct GateUpShifts {
  Factors shift[GROUPS_GU];
  __device__ __forceinline__ GateUpShifts(const Cta& b, const Shifts& shifts, const Own<GTL>& own) {
#pragma unroll
    for (int i = 0; i < GROUPS_GU; ++i) shift[i] = shifts(b, gate_up_row(b, own.tile[i]), 0);
  }
  __device__ __forceinline__ void behind_product(const Cta&, const Shifts&, const Own<GTL>&) {}
  __device__ __forceinline__ Factors operator()(int i, int) const { return shift[i]; }
};

// What is added to a token's v_t before its Euler step; the step, of one number.
__device__ __forceinline__ const float* action_shifts(const Cta& b, int step, int) { return b.a.out_shift + step * A; }
struct EulerStep {
  __device__ __forceinline__ EulerStep(const Cta&, int, int, int) {}
  __device__ __forceinline__ float operator()(const Cta& b, float x, float& v) const {
    return __fadd_rn(x, __fmul_rn(b.a.dt, v));
  }
};

struct KeptRow {  // which row a token takes: see token_times.cu
  __device__ __forceinline__ KeptRow(const Cta&, int) {}
  __device__ __forceinline__ void keep(const Cta&) const {}
};

// What the norms of layer n need, to L2: it is read once, by everybody at the same time, while memory is busy with
// weights.
__device__ __forceinline__ void prefetch(const Cta& b, int n) {
  const int step = n / L, l = n % L;
  if (step >= b.a.steps) return;
  auto lines = [&](const float* from, int floats) {
#pragma unroll 1
    for (int i = b.lane() * 32; i < floats; i += 32 * 32) prefetch_line(from + i);
  };
  const float* table = b.a.table + (size_t(step) * (2 * L + 1) + 2 * l) * 3 * D + b.x0() * 16;
  lines(b.a.shifted + (size_t(n) * (NC * S) + b.cluster() * S + b.rank()) * TILES * 16, TILES * 16);
  lines(table + 2 * D, b.xn() * 16), lines(table + 3 * D, b.xn() * 16);
  lines(table + 5 * D, b.xn() * 16), lines(table + 6 * D, b.xn() * 16);
}
