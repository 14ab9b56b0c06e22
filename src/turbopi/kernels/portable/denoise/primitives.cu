// Loads, the grid's barrier, arithmetic.

// Weights: read once, so they take no room in L1.
__device__ __forceinline__ uint4 load_weights(const byte* from) {
  uint4 v;
  asm volatile("ld.global.nc.L1::no_allocate.L2::256B.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "l"(from));
  return v;
}
// What other blocks have written: from L2, as L1 may have an old copy.
__device__ __forceinline__ uint4 load_shared_by_grid(const void* from) { return __ldcg((const uint4*)from); }
__device__ __forceinline__ void to_l2(const void* at) { asm volatile("prefetch.global.L2 [%0];" ::"l"(at)); }

// threadIdx.x and blockIdx.x, of which the compiler doesn't know that they are the same in all phases: what follows from
// them would be made once for all of them, and kept in local memory.
__device__ __forceinline__ int of_phase(int index) {
  asm volatile("" : "+r"(index));
  return index;
}
__device__ __forceinline__ int thread_of_phase() { return of_phase(threadIdx.x); }
__device__ __forceinline__ int block_of_phase() { return of_phase(blockIdx.x); }

// A barrier of the whole grid in two halves: what lies between depends on no other block.
// A block that has looked LOOKS times in vain gives up: a look takes the way to L2 and back, so that is seconds. Time is
// not measured, as it also passes while the GPU is paused or works for others; then nobody looks.
struct Grid {
  u32 *counter, *trace, *hang;
  u32 expected;
  long long last;
  __device__ __forceinline__ explicit Grid(const Args& args)
      : counter(args.counter), trace(args.trace), hang(args.hang), expected(0) {
    if (TP_TRACE) last = clock64();
  }
  // phases: as many as were one, so that a barrier's number says where it is
  __device__ __forceinline__ void arrive(int phases = 1) {
    __syncthreads();
    if (TP_TRACE) note(0);
    expected += phases * BLOCKS;
    if (threadIdx.x == 0) asm volatile("red.release.gpu.global.add.u32 [%0], %1;" ::"l"(counter), "r"(phases) : "memory");
  }
  __device__ __forceinline__ void wait() {
    if (threadIdx.x == 0) {
      u32 arrived, looks = 0;
      do {
        asm volatile("ld.acquire.gpu.global.u32 %0, [%1];" : "=r"(arrived) : "l"(counter) : "memory");
        if (++looks == LOOKS) give_up();
      } while (arrived < expected);
    }
    __syncthreads();
    if (TP_TRACE) note(1);
  }
  __device__ __forceinline__ void give_up() {
    *(volatile u32*)hang = expected;
    __threadfence_system();
    __trap();
    __builtin_unreachable();  // so that nothing is kept for afterwards
  }
  // Cycles of thread 0: [block][phase][working, at the barrier behind it]; phases are PHASES of kernel.py.
  __device__ __forceinline__ void note(int waited) {
    if (threadIdx.x > 0) return;
    const int before = expected / BLOCKS % STEP_PHASES - waited, barrier = before < 0 ? STEP_PHASES - 1 : before;
    const int of_layer = (barrier - FIRST_PHASES) % LAYER_PHASES;
    const int phase = barrier == 0                ? 6
                      : barrier < FIRST_PHASES    ? 8
                      : barrier == STEP_PHASES - 1 ? 7
                                                   : of_layer + (!COMBINES && of_layer > 1);
    const long long now = clock64();
    trace[(blockIdx.x * 9 + phase) * 2 + waited] += now - last, last = now;
  }
};

__device__ __forceinline__ float infinity() { return __int_as_float(0x7f800000); }
__device__ __forceinline__ u32 pack(float low, float high) {
  u32 v;
  asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(v) : "f"(high), "f"(low));
  return v;
}
__device__ __forceinline__ float low_of(u32 v) { return __uint_as_float(v << 16); }
__device__ __forceinline__ float high_of(u32 v) { return __uint_as_float(v & 0xffff0000u); }
// Two neighbouring columns of an activation [piece][token][PIECE columns] that meets weights.
__device__ __forceinline__ void store_operand(byte* activation, int token, int column, float first, float second) {
  byte* const to = activation + ((column / PIECE * T + token) * PIECE + column % PIECE) * OPERAND_BYTES;
#if TP_FP8
  unsigned short both;
  asm("cvt.rn.satfinite.e4m3x2.f32 %0, %1, %2;" : "=h"(both) : "f"(second), "f"(first));
  *(unsigned short*)to = both;
#else
  *(u32*)to = pack(first, second);
#endif
}
__device__ __forceinline__ void mma(float (&c)[4], u32 a0, u32 a1, u32 a2, u32 a3, u32 b0, u32 b1) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "r"(b0), "r"(b1));
}
#if TP_FP8
__device__ __forceinline__ void mma_operands(float (&c)[4], u32 a0, u32 a1, u32 a2, u32 a3, u32 b0, u32 b1) {
  asm("mma.sync.aligned.m16n8k32.row.col.f32.e4m3.e4m3.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a0), "r"(a1), "r"(a2), "r"(a3), "r"(b0), "r"(b1));
}
#else
__device__ __forceinline__ void mma_operands(float (&c)[4], u32 a0, u32 a1, u32 a2, u32 a3, u32 b0, u32 b1) {
  mma(c, a0, a1, a2, a3, b0, b1);
}
#endif
// Bytes 0 and 2 of four int8 as two bfloat16, exactly: 128 and the low seven bits, less 128, or 256 of negative ones.
__device__ __forceinline__ u32 two_of_int8(u32 four) {
  u32 sum, less, v;  // of `and`, `or` one instruction; ptxas makes two of the operators
  asm("lop3.b32 %0, %1, %2, %3, 0xEA;" : "=r"(sum) : "r"(four), "n"(0x007f007f), "n"(0x43004300));
  asm("lop3.b32 %0, %1, %2, %3, 0xEA;" : "=r"(less) : "r"(four), "n"(0x00800080), "n"(0x43004300));
  asm("fma.rn.bf16x2 %0, %1, %2, %3;" : "=r"(v) : "r"(less), "r"(0xbf80bf80u), "r"(sum));  // sum - less
  return v;
}
// The weights that meet a piece of the activations: a lane's 16 bytes, of int8 half of them. Four int8 lie in the order 0,
// 2, 1, 3.
template <bool WHOLE>
__device__ __forceinline__ uint4 piece_of_weights(uint4 w, int piece) {
  if (!WHOLE) return w;
  const u32 first = piece ? w.z : w.x, second = piece ? w.w : w.y;
  return make_uint4(two_of_int8(first), two_of_int8(first >> 8), two_of_int8(second), two_of_int8(second >> 8));
}
// A chunk of 16 rows (8 in `low`, 8 in `high`) times 8: any order of columns that all three have.
__device__ __forceinline__ void mma_chunk(float (&c)[4], uint4 low, uint4 high, uint4 b) {
  mma_operands(c, low.x, high.x, low.y, high.y, b.x, b.y);
  mma_operands(c, low.z, high.z, low.w, high.w, b.z, b.w);
}
__device__ __forceinline__ float2 operator*(float2 v, float by) { return make_float2(v.x * by, v.y * by); }
