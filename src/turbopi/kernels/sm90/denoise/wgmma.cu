// Asynchronous products of the tensor cores (wgmma). The four warps of a warpgroup together add 64 rows x
// 16 columns of operand A, from shared memory or registers, times 16 columns x NT * 8 tokens of operand B, from shared
// memory, to float32 sums: warp i has rows 16 i.., laid out as those of mma.m16n8k16, 8 tokens after 8.
//
// In shared memory an operand consists of core matrices: 8 rows (or tokens) of 16 bytes, one after the other.

// An operand is told by two words. The first says where it lies, and next_columns: the bytes from a core matrix to that
// of the next 8 columns. The second says NEXT_ROWS: the bytes to that of the next 8 rows.
__device__ __forceinline__ u32 operand_place(u32 address, u32 next_columns) {
  return (address & 0x3ffff) >> 4 | (next_columns >> 4) << 16;
}
template <int NEXT_ROWS>
__device__ __forceinline__ u64 operand_at(u32 place) {
  return u64(place) | u64(NEXT_ROWS >> 4) << 32;
}
// The place that lies `bytes` behind.
__device__ __forceinline__ u32 behind(u32 place, u32 bytes) { return place + (bytes >> 4); }
// Until here products have read these registers.
__device__ __forceinline__ void keep_until_here(uint4 v) { asm volatile("" ::"r"(v.x), "r"(v.y), "r"(v.z), "r"(v.w)); }
// What threads wrote to shared memory (or peers, whose barrier was waited for) before may now be read by products.
__device__ __forceinline__ void show_to_products() { asm volatile("fence.proxy.async.shared::cta;" ::: "memory"); }
// Generated: add_product(float (&sums)[NT * 4], u64 a, u64 b, int keep), add_from_registers(.., u32 * 4, ..): weights, in bfloat16
// or (32 columns) E4M3; add_rows: as the second, always bfloat16; add_keys(float (&sums)[8], u64 a, u64 b, int keep):
// 64 tokens' queries times 16 keys, bfloat16, from shared memory. The compiler makes all of them wait for each other if
// one stands in a branch of its own.
