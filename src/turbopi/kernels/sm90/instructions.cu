// What kernels for compute capability 9.0 share: TMA and its barriers, operands of wgmma, results on their way out.
// Put in front of a kernel's source by instructions.py.

typedef unsigned int u32;
typedef unsigned long long u64;
typedef unsigned short u16;
struct alignas(64) TensorMap { char bytes[128]; };

__device__ __forceinline__ u32 shared_address(const void* p) { return (u32)__cvta_generic_to_shared(p); }

__device__ __forceinline__ void barrier_init(u32 bar, u32 count) {
    asm volatile("mbarrier.init.shared::cta.b64 [%0], %1;" ::"r"(bar), "r"(count));
}
__device__ __forceinline__ void barrier_expect(u32 bar, u32 bytes) {
    asm volatile("mbarrier.arrive.expect_tx.shared::cta.b64 _, [%0], %1;" ::"r"(bar), "r"(bytes) : "memory");
}
__device__ __forceinline__ void barrier_arrive(u32 bar, u32 cta) {
    asm volatile(
        "{ .reg .b32 remote; mapa.shared::cluster.u32 remote, %0, %1;"
        "mbarrier.arrive.shared::cluster.b64 _, [remote]; }" ::"r"(bar), "r"(cta) : "memory");
}
__device__ __forceinline__ void barrier_arrive(u32 bar) {
    asm volatile("mbarrier.arrive.shared::cta.b64 _, [%0];" ::"r"(bar) : "memory");
}
__device__ __forceinline__ void barrier_wait(u32 bar, u32 parity) {
    asm volatile(
        "{ .reg .pred over;\n"
        "again: mbarrier.try_wait.parity.shared::cta.b64 over, [%0], %1;\n"
        "@over bra done;\n"
        "bra again;\n"
        "done: }" ::"r"(bar), "r"(parity) : "memory");
}
__device__ __forceinline__ bool barrier_over(u32 bar, u32 parity) {
    u32 over;
    asm volatile(
        "{ .reg .pred over; mbarrier.test_wait.parity.shared::cta.b64 over, [%1], %2; selp.u32 %0, 1, 0, over; }"
        : "=r"(over) : "r"(bar), "r"(parity) : "memory");
    return over;
}
__device__ __forceinline__ void cluster_sync() {
    asm volatile("barrier.cluster.arrive.relaxed;\nbarrier.cluster.wait;" ::: "memory");
}
__device__ __forceinline__ void cluster_arrive() {  // the first half of `cluster_sync`
    asm volatile("barrier.cluster.arrive.relaxed;" ::: "memory");
}
__device__ __forceinline__ void cluster_wait() {  // the second
    asm volatile("barrier.cluster.wait;" ::: "memory");
}
__device__ __forceinline__ void cluster_exchange() {  // what was stored before it in others' memory is there after it
    asm volatile("barrier.cluster.arrive.release;\nbarrier.cluster.wait.acquire;" ::: "memory");
}
// An address of this CTA's shared memory as that of another one of the cluster, and a store to such a place, which the
// receiver's barrier counts in.
__device__ __forceinline__ u32 at_rank(u32 address, int rank) {
    u32 there;
    asm volatile("mapa.shared::cluster.u32 %0, %1, %2;" : "=r"(there) : "r"(address), "r"(rank));
    return there;
}
__device__ __forceinline__ void send(u32 to, float4 v, u32 bar) {
    asm volatile(
        "st.async.weak.shared::cluster.mbarrier::complete_tx::bytes.v4.f32 [%0], {%1, %2, %3, %4}, [%5];"
        ::"r"(to), "f"(v.x), "f"(v.y), "f"(v.z), "f"(v.w), "r"(bar) : "memory");
}
// K-major operand in shared memory, rows of 128 bytes, swizzled; groups of 8 rows lie 1024 bytes apart
__device__ __forceinline__ u64 operand(u32 address) {
    return ((u64)(address & 0x3ffff) >> 4) | (1ull << 16) | (64ull << 32) | (1ull << 62);
}

// Values that the compiler is to make here, and once: else it makes addresses anew for each load, after a wait.
template <typename T>
__device__ __forceinline__ T* settled(T* pointer) {
    asm volatile("" : "+l"(pointer));
    return pointer;
}
__device__ __forceinline__ float settled(float x) {
    asm volatile("" : "+f"(x));
    return x;
}
__device__ __forceinline__ u32 settled(u32 x) {
    asm volatile("" : "+r"(x));
    return x;
}

// x / by for 0 <= x < 2^20 and by > 0, in a third of the time that a division takes.
__device__ __forceinline__ int quotient(int x, int by) {
    float inverse;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(inverse) : "f"((float)by));
    return (int)(((float)x + 0.5f) * inverse);  // as far from a whole number as half of one of `by` parts
}

// A warpgroup's products: before the first, or the first after their registers were touched; to make a group of those
// issued since the last; until all groups but the last LEFT are done.
__device__ __forceinline__ void begin_products() { asm volatile("wgmma.fence.sync.aligned;" ::: "memory"); }
__device__ __forceinline__ void commit_products() { asm volatile("wgmma.commit_group.sync.aligned;" ::: "memory"); }
template <int LEFT>
__device__ __forceinline__ void await_products() {
    asm volatile("wgmma.wait_group.sync.aligned %0;" ::"n"(LEFT) : "memory");
}

__device__ __forceinline__ u32 pack(float low, float high) {
    u32 both;
    asm("cvt.rn.bf16x2.f32 %0, %1, %2;" : "=r"(both) : "f"(high), "f"(low));
    return both;
}
__device__ __forceinline__ float bf16_low(u32 both) { return __uint_as_float(both << 16); }
__device__ __forceinline__ float bf16_high(u32 both) { return __uint_as_float(both & 0xffff0000u); }

__device__ __forceinline__ float sum_of_quad(float x) {
    x += __shfl_xor_sync(~0u, x, 1);
    return x + __shfl_xor_sync(~0u, x, 2);
}

// A quad holds 4 blocks of 8 columns of one row, 2 columns of each block a lane; afterwards lane i holds block i.
__device__ __forceinline__ uint4 transpose_quad(u32 p0, u32 p1, u32 p2, u32 p3, int lane) {
    const bool odd = lane & 1, high = lane & 2;
    const u32 r0 = __shfl_xor_sync(~0u, odd ? p0 : p1, 1), r1 = __shfl_xor_sync(~0u, odd ? p2 : p3, 1);
    const u32 x0 = odd ? r0 : p0, x1 = odd ? p1 : r0, y0 = odd ? r1 : p2, y1 = odd ? p3 : r1;
    const u32 s0 = __shfl_xor_sync(~0u, high ? x0 : y0, 2), s1 = __shfl_xor_sync(~0u, high ? x1 : y1, 2);
    return high ? make_uint4(s0, s1, y0, y1) : make_uint4(x0, x1, s0, s1);
}

__device__ __forceinline__ u32 pack_e4m3(float low, float high) {  // saturates; NaN stays NaN
    u16 both;
    asm("cvt.rn.satfinite.e4m3x2.f32 %0, %1, %2;" : "=h"(both) : "f"(high), "f"(low));
    return both;
}
__device__ __forceinline__ u32 to_int8(float x) {  // saturates at 127 and -127; of NaN comes 0
    int whole;
    asm("cvt.rni.sat.s8.f32 %0, %1;" : "=r"(whole) : "f"(x < -127.0f ? -127.0f : x));
    return whole & 0xff;
}
__device__ __forceinline__ u32 pack_int8(float low, float high) { return to_int8(low) | to_int8(high) << 8; }
