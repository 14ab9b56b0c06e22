// A CTA's view: its share of everything.

// What is the same in all lanes of a warp, so that the compiler knows it. wgmma takes its operands' places from
// registers that a warp has once. There the compiler reckons with such places, if it knows that all lanes agree on them
// and on every branch and loop around: else each costs some six instructions more. So nothing that holds for some
// lanes alone may decide where a warp goes on.
__device__ __forceinline__ u32 of_warp(u32 v) { return __shfl_sync(~0u, v, 0); }

struct Cta {
  const Args& a;
  byte* smem;
  u32 base;                 // of smem in the shared window
  u32 cta, thread, warp_;   // cluster and rank; lane; warp
  u32 n = 0;                // layers done
  u32 slot = 0, phase = 0;  // of the ring
  u32 turn = 0, room = 0;   // exchanges of the stream, uses of BAR_ROOM

  __device__ Cta(const Args& args, byte* s)
      : a(args), smem(s), base(u32(__cvta_generic_to_shared(s))), cta(blockIdx.x), thread(threadIdx.x),
        warp_(of_warp(threadIdx.x / 32)) {}
  // The same as `base`, known to be so in all lanes.
  static __device__ __forceinline__ u32 start() {
    extern __shared__ __align__(128) byte dynamic[];
    return u32(__cvta_generic_to_shared(dynamic));
  }
  // For warps that multiply: make the compiler forget what these are made of. What it derives from them it would keep
  // in registers, or in local memory, over all layers, and a fetch from there costs more than to derive it again.
  __device__ __forceinline__ void forget() {
    asm volatile("" : "+r"(base), "+r"(warp_));
    asm volatile("mov.u32 %0, %%ctaid.x;" : "=r"(cta));
    asm volatile("mov.u32 %0, %%tid.x;" : "=r"(thread));
    __builtin_assume(cta < NC * S), __builtin_assume(thread < CONSUMERS), __builtin_assume(warp_ < W);
  }
  __device__ __forceinline__ int cluster() const { return int(cta / S); }
  __device__ __forceinline__ int rank() const { return int(cta % S); }
  __device__ __forceinline__ int warp() const { return int(warp_); }
  __device__ __forceinline__ int lane() const { return int(thread % 32); }
  // A lane's place in the tensor cores' operands.
  __device__ __forceinline__ int g() const { return int(thread / 4 % 8); }
  __device__ __forceinline__ int t() const { return int(thread % 4); }
  __device__ __forceinline__ u32 bar(int i) const { return base + M_BAR + i * 8; }
  __device__ __forceinline__ u32 full(u32 s) const { return base + M_BAR + BAR_RING * 8 + s * 16; }
  __device__ __forceinline__ u32 empty(u32 s) const { return full(s) + 8; }
  __device__ __forceinline__ byte* ring(u32 s) const { return smem + M_RING + s * SLOT; }
  // blocks of the stream's slice, hidden blocks of the cluster, tiles of the CTA
  __device__ __forceinline__ int x0() const { return share(D16, S, rank()); }
  __device__ __forceinline__ int xn() const { return D16 % S == 0 ? DX : share(D16, S, rank() + 1) - x0(); }
  __device__ __forceinline__ int hn() const {
    return F16 % NC == 0 ? HC : share(F16, NC, cluster() + 1) - share(F16, NC, cluster());
  }
  __device__ __forceinline__ int g0() const { return share(2 * hn(), S, rank()); }
  __device__ __forceinline__ int gn() const {
    return F16 % NC == 0 && 2 * HC % S == 0 ? GTL : share(2 * hn(), S, rank() + 1) - g0();
  }
  __device__ __forceinline__ int q0() const { return share(QT, S, rank()); }
  __device__ __forceinline__ int qn() const { return QT % S == 0 ? QTL : share(QT, S, rank() + 1) - q0(); }
  __device__ __forceinline__ int kv0() const { return share(KVT, NH * S, cluster() * S + rank()); }
  __device__ __forceinline__ int kvn() const { return share(KVT, NH * S, cluster() * S + rank() + 1) - kv0(); }
};

// A CTA's rows of all tiles of a layer.
__device__ __forceinline__ const float* of_tiles(const Cta& b, const float* all, u32 layer) {
  return all + (settled(layer) * (NC * S) + b.cta) * (TILES * 16);
}

// A warp's cycles up to each mark, summed up over the loop: see MARKS of kernel.py. TP_TRACED_WARP: which warp's, from 1.
#ifdef TP_TRACED_WARP
#define MARK(i)                                    \
  if (b.thread == (TP_TRACED_WARP - 1) * 32) { \
    const u32 now_ = u32(clock64());         \
    u32* m_ = (u32*)(b.smem + M_BAR + 256); \
    m_[1 + (i)] += now_ - m_[0];             \
    m_[0] = now_;                            \
  }
#else
#define MARK(i)
#endif
