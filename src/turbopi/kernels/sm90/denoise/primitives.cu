// Waiting, moving data, arithmetic.

// ---- waiting

// Waits are short loops without an end of their own; a spare warp watches instead. Where the first thread waits is a
// word in shared memory, and if that stays the same for seconds the kernel says where (in memory of the host, which
// outlives the trap; [NC * S] words: 1 << 31 | what << 20 | layer) and traps.
// `What` they wait for is generated: WAITS of kernel.py.
__device__ __forceinline__ void note(const Cta& b, int what) {
  if (b.thread == 0) *(volatile u32*)(b.smem + M_PROGRESS) = u32(what) << 20 | u32(b.n);
}
__device__ __forceinline__ void pause(u32 since, u32 cycles) {
  while (u32(clock64()) - since < cycles) {
  }
}
__device__ __forceinline__ void prefetch_line(const float* at) { asm volatile("prefetch.global.L2 [%0];" ::"l"(at)); }
// All threads wait for use n of an exchange in the cluster; one of them arms the barrier for the next.
__device__ __forceinline__ void receive(const Cta& b, int bar, int n, u32 bytes, int what) {
  note(b, what);
  barrier_wait(b.bar(bar), n & 1);
  __syncwarp();
  if (b.thread == 0) barrier_expect(b.bar(bar), bytes);
}
// An arrival at a rank's barrier. Nothing was written that a peer reads, so nothing is to be released: that would cost a
// microsecond.
__device__ __forceinline__ void arrive_at(u32 bar) {
  asm volatile("mbarrier.arrive.relaxed.cluster.shared::cluster.b64 _, [%0];" ::"r"(bar) : "memory");
}
// Barriers of some warps. Lanes leave a wait one by one, and these barriers count warps.
template <int BARRIER, int WARPS>
__device__ __forceinline__ void arrive() {
  __syncwarp();
  asm volatile("bar.arrive %0, %1;" ::"n"(BARRIER), "n"(WARPS * 32) : "memory");
}
template <int BARRIER, int WARPS>
__device__ __forceinline__ void sync() {
  __syncwarp();
  asm volatile("bar.sync %0, %1;" ::"n"(BARRIER), "n"(WARPS * 32) : "memory");
}
__device__ __forceinline__ void consumers_sync() { sync<CONSUMERS_MEET, W>(); }
__device__ __forceinline__ void consumers_arrive() { arrive<CONSUMERS_MEET, W>(); }  // of a warp that goes on at once

// ---- moving data

// An address at all ranks. All of them first, as a send reads its registers late.
struct Everyone {
  u32 at[S];
  Everyone() = default;
  __device__ __forceinline__ explicit Everyone(u32 address) {
#pragma unroll
    for (int d = 0; d < S; ++d) at[d] = at_rank(address, d);
  }
};
__device__ __forceinline__ void send(u32 to, u32 v, u32 bar) {
  asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.b32 [%0], %1, [%2];" ::"r"(to), "r"(v),
               "r"(bar)
               : "memory");
}
__device__ __forceinline__ void send(u32 to, u32 v, u32 w, u32 bar) {
  asm volatile("st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v2.b32 [%0], {%1, %2}, [%3];" ::"r"(to),
               "r"(v), "r"(w), "r"(bar)
               : "memory");
}
__device__ __forceinline__ void send(u32 to, uint4 v, u32 bar) {
  send(to, make_float4(__uint_as_float(v.x), __uint_as_float(v.y), __uint_as_float(v.z), __uint_as_float(v.w)), bar);
}
__device__ __forceinline__ void bulk_load(u32 to, const void* from, u32 bytes, u32 bar, u64 policy) {
  asm volatile(
      "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes.L2::cache_hint [%0], [%1], %2, [%3], %4;" ::
          "r"(to),
      "l"(from), "r"(bytes), "r"(bar), "l"(policy)
      : "memory");
}

// From shared memory to L2; what is in L2 may be copied from there; until all that this thread has sent so is there.
__device__ __forceinline__ void bulk_store(void* to, u32 from, u32 bytes) {
  asm volatile("cp.async.bulk.global.shared::cta.bulk_group [%0], [%1], %2;" ::"l"(to), "r"(from), "r"(bytes)
               : "memory");
}
__device__ __forceinline__ void show_to_copy_engine() { asm volatile("fence.proxy.async.global;" ::: "memory"); }
__device__ __forceinline__ void await_stored() {
  asm volatile("cp.async.bulk.commit_group;" ::: "memory");
  asm volatile("cp.async.bulk.wait_group 0;" ::: "memory");
  show_to_copy_engine();
}
// `bytes` from L2 to the same place of all ranks, counted in by `bar` of each.
__device__ __forceinline__ void load_for_all(u32 to, const void* from, u32 bytes, u32 bar) {
  asm volatile(
      "cp.async.bulk.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster "
      "[%0], [%1], %2, [%3], %4;" ::"r"(to),
      "l"(from), "r"(bytes), "r"(bar), "h"((unsigned short)((1 << S) - 1))
      : "memory");
}
// From one place in shared memory to one of all ranks, by way of `there` in L2.
__device__ __forceinline__ void copy_to_all(const Cta& b, u32 from, byte* there, u32 to, u32 bytes, int bar) {
  bulk_store(there, b.base + from, bytes);
  await_stored();
  load_for_all(b.base + to, there, bytes, b.bar(bar));
}

// Words through L2 whose lowest bit is their flag. Use n of a double buffer carries bit `flag(n)`: 1, 1, 0, 0, 1, ...
__device__ __forceinline__ u32 flag(int n) { return ((n >> 1) & 1) ^ 1; }
__device__ __forceinline__ u32 flagged(float v, u32 bit) { return (__float_as_uint(v) & ~1u) | bit; }
__device__ __forceinline__ uint4 peek(const uint4* p) {
  uint4 v;
  asm volatile("ld.relaxed.gpu.global.v4.u32 {%0, %1, %2, %3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "l"(p)
               : "memory");
  return v;
}
__device__ __forceinline__ uint2 peek(const uint2* p) {
  uint2 v;
  asm volatile("ld.relaxed.gpu.global.v2.u32 {%0, %1}, [%2];" : "=r"(v.x), "=r"(v.y) : "l"(p) : "memory");
  return v;
}
// The bits in which a word differs, and those of `others`: one instruction, where the compiler makes four of `missing`.
__device__ __forceinline__ u32 differing(u32 word, u32 bit, u32 others) {
  u32 v;
  asm("lop3.b32 %0, %1, %2, %3, 0xbe;" : "=r"(v) : "r"(word), "r"(bit), "r"(others));  // (word ^ bit) | others
  return v;
}
__device__ __forceinline__ bool missing(uint4 v, u32 bit) {
  return differing(v.x, bit, differing(v.y, bit, differing(v.z, bit, v.w ^ bit))) & 1;
}
__device__ __forceinline__ bool missing(uint2 v, u32 bit) { return differing(v.x, bit, v.y ^ bit) & 1; }
__device__ __forceinline__ void put(void* p, u32 v) {
  asm volatile("st.relaxed.gpu.global.u32 [%0], %1;" ::"l"(p), "r"(v) : "memory");
}
__device__ __forceinline__ void put(void* p, uint2 v) {
  asm volatile("st.relaxed.gpu.global.v2.u32 [%0], {%1, %2};" ::"l"(p), "r"(v.x), "r"(v.y) : "memory");
}
__device__ __forceinline__ void publish(float* p, float v, u32 bit) {
  put(p, flagged(v, bit));
}
__device__ __forceinline__ void publish(uint2* p, u32 v, u32 w, u32 bit) {
  asm volatile("st.relaxed.gpu.global.v2.u32 [%0], {%1, %2};" ::"l"(p), "r"((v & ~1u) | bit), "r"((w & ~1u) | bit)
               : "memory");
}

// ---- arithmetic

__device__ __forceinline__ u32 pack_half(float lo, float hi) {
  u32 v;
  asm("cvt.rn.f16x2.f32 %0, %1, %2;" : "=r"(v) : "f"(hi), "f"(lo));
  return v;
}
__device__ __forceinline__ float2 unpack_half(u32 v) {
  float2 f;
  asm("{.reg .b16 lo, hi; mov.b32 {lo, hi}, %2; cvt.f32.f16 %0, lo; cvt.f32.f16 %1, hi;}"
      : "=f"(f.x), "=f"(f.y)
      : "r"(v));
  return f;
}
// Two numbers that meet weights, in the lower bits if they are E4M3.
__device__ __forceinline__ u32 pack_operand(float lo, float hi) { return FP8 ? pack_e4m3(lo, hi) : pack(lo, hi); }
__device__ __forceinline__ void mma(float (&c)[4], uint4 a, uint2 b) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b.x), "r"(b.y));
}
__device__ __forceinline__ void mma_half(float* c, uint4 a, uint2 b) {
  asm("mma.sync.aligned.m16n8k16.row.col.f32.f16.f16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a.x), "r"(a.y), "r"(a.z), "r"(a.w), "r"(b.x), "r"(b.y));
}
__device__ __forceinline__ void ldmatrix(uint4& v, u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "r"(address));
}
__device__ __forceinline__ void ldmatrix_transposed(uint4& v, u32 address) {
  asm volatile("ldmatrix.sync.aligned.m8n8.x4.trans.shared.b16 {%0,%1,%2,%3}, [%4];"
               : "=r"(v.x), "=r"(v.y), "=r"(v.z), "=r"(v.w)
               : "r"(address));
}
// Four E4M3 numbers as float16, for mma: it takes columns in any order that both operands have.
__device__ __forceinline__ uint2 from_e4m3(u32 four) {
  uint2 v;
  asm("{.reg .b16 lo, hi; mov.b32 {lo, hi}, %2; cvt.rn.f16x2.e4m3x2 %0, lo; cvt.rn.f16x2.e4m3x2 %1, hi;}"
      : "=r"(v.x), "=r"(v.y)
      : "r"(four));
  return v;
}
template <int N>
__device__ __forceinline__ void clear(float (&c)[N][4]) {
#pragma unroll
  for (int i = 0; i < N; ++i) c[i][0] = c[i][1] = c[i][2] = c[i][3] = 0;
}
// An item of the stream, or of a product, each of its two columns (rows) times a factor.
__device__ __forceinline__ float4 scaled(float4 v, float2 by) {
  return make_float4(v.x * by.x, v.y * by.x, v.z * by.y, v.w * by.y);
}
__device__ __forceinline__ float4 scaled(float4 v, float4 by) {  // each token by its own
  return make_float4(v.x * by.x, v.y * by.y, v.z * by.z, v.w * by.w);
}
// What is added to an item, of two columns (rows), or of each token's.
__device__ __forceinline__ float4 of_item(float2 two) { return make_float4(two.x, two.x, two.y, two.y); }
__device__ __forceinline__ float4 of_item(float4 each) { return each; }
__device__ __forceinline__ float exp2_approx(float x) {
  float y;
  asm("ex2.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(x));
  return y;
}
__device__ __forceinline__ float exchange(float v, int mask) { return __shfl_xor_sync(~0u, v, mask); }
__device__ __forceinline__ u32 exchange(u32 v, int mask) { return __shfl_xor_sync(~0u, v, mask); }
