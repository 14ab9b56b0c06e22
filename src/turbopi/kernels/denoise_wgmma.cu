// Part 3 of 10: asynchronous products of the tensor cores (wgmma). The four warps of a warpgroup together add 64 rows x
// 16 columns of operand A, from shared memory or registers, times 16 columns x COLUMNS tokens of operand B, from shared
// memory, to float32 sums: warp i has rows 16 i.., laid out as those of mma.m16n8k16, 8 tokens after 8.
//
// In shared memory an operand consists of core matrices: 8 rows (or tokens) of 16 bytes, one after the other.

// next_rows: bytes from a core matrix to that of the next 8 rows, next_columns: to that of the next 8 columns.
__device__ __forceinline__ u64 operand(u32 address, u32 next_rows, u32 next_columns) {
  return u64((address & 0x3ffff) >> 4) | u64(next_columns >> 4) << 16 | u64(next_rows >> 4) << 32;
}
// The operand that lies `bytes` behind.
__device__ __forceinline__ u64 behind(u64 operand, u32 bytes) {
  u64 v;
  asm("{.reg .b32 low, high; mov.b64 {low, high}, %1; add.u32 low, low, %2; mov.b64 %0, {low, high};}"
      : "=l"(v)
      : "l"(operand), "r"(bytes >> 4));
  return v;
}
// What threads wrote to shared memory (or peers, whose barrier was waited for) before may now be read by products.
__device__ __forceinline__ void show_to_products() { asm volatile("fence.proxy.async.shared::cta;" ::: "memory"); }
// Before a warpgroup's first product, or the first after its registers were touched.
__device__ __forceinline__ void begin_products() { asm volatile("wgmma.fence.sync.aligned;" ::: "memory"); }
__device__ __forceinline__ void commit_products() { asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory"); }
// Until all groups of products that were committed are done, but for the last LEFT.
template <int LEFT>
__device__ __forceinline__ void await_products() {
  asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(LEFT) : "memory");
}

#define TP_R8 "%0, %1, %2, %3"
#define TP_R16 TP_R8 ", %4, %5, %6, %7"
#define TP_R24 TP_R16 ", %8, %9, %10, %11"
#define TP_R32 TP_R24 ", %12, %13, %14, %15"
#define TP_R40 TP_R32 ", %16, %17, %18, %19"
#define TP_R48 TP_R40 ", %20, %21, %22, %23"
#define TP_R56 TP_R48 ", %24, %25, %26, %27"
#define TP_R64 TP_R56 ", %28, %29, %30, %31"
#define TP_SUM(i) "+f"(sums[i]), "+f"(sums[i + 1]), "+f"(sums[i + 2]), "+f"(sums[i + 3])
#define TP_SUMS8 TP_SUM(0)
#define TP_SUMS16 TP_SUMS8, TP_SUM(4)
#define TP_SUMS24 TP_SUMS16, TP_SUM(8)
#define TP_SUMS32 TP_SUMS24, TP_SUM(12)
#define TP_SUMS40 TP_SUMS32, TP_SUM(16)
#define TP_SUMS48 TP_SUMS40, TP_SUM(20)
#define TP_SUMS56 TP_SUMS48, TP_SUM(24)
#define TP_SUMS64 TP_SUMS56, TP_SUM(28)
#define TP_ALL(f)                                                                                          \
  f(8, 4, 5, 6, 7, 8, 9) f(16, 8, 9, 10, 11, 12, 13) f(24, 12, 13, 14, 15, 16, 17) f(32, 16, 17, 18, 19, 20, 21) \
      f(40, 20, 21, 22, 23, 24, 25) f(48, 24, 25, 26, 27, 28, 29) f(56, 28, 29, 30, 31, 32, 33)            \
          f(64, 32, 33, 34, 35, 36, 37)

// sums (or 0, unless `keep`) += a * b, both bfloat16 in shared memory
#define TP_SHARED(N, A, B, KEEP, ...)                                                          \
  if constexpr (COLUMNS == N)                                                                  \
    asm volatile("{.reg .pred p; setp.ne.b32 p, %" #KEEP                                       \
                 ", 0; wgmma.mma_async.sync.aligned.m64n" #N "k16.f32.bf16.bf16 {" TP_R##N     \
                 "}, %" #A ", %" #B ", p, 1, 1, 0, 0;}"                                        \
                 : TP_SUMS##N                                                                     \
                 : "l"(a), "l"(b), "r"(keep));
template <int COLUMNS>
__device__ __forceinline__ void add_product(float (&sums)[COLUMNS / 2], u64 a, u64 b, int keep) {
  TP_ALL(TP_SHARED)
}
// The same with float16 operands, a in registers in the order of mma.m16n8k16.
#define TP_REGISTERS(N, A0, A1, A2, A3, B, KEEP)                                              \
  if constexpr (COLUMNS == N)                                                                 \
    asm volatile("{.reg .pred p; setp.ne.b32 p, %" #KEEP                                      \
                 ", 0; wgmma.mma_async.sync.aligned.m64n" #N "k16.f32.f16.f16 {" TP_R##N      \
                 "}, {%" #A0 ", %" #A1 ", %" #A2 ", %" #A3 "}, %" #B ", p, 1, 1, 0;}"         \
                 : TP_SUMS##N                                                                    \
                 : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "l"(b), "r"(keep));
template <int COLUMNS>
__device__ __forceinline__ void add_product(float (&sums)[COLUMNS / 2], uint4 a, u64 b, int keep) {
  TP_ALL(TP_REGISTERS)
}
