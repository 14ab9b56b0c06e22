// The kernel: sets up a CTA's barriers, then every warp has its role.

extern "C" __global__ void __launch_bounds__(THREADS, 1) __cluster_dims__(S, 1, 1)
    turbopi_denoise(const __grid_constant__ Args args) {
  extern __shared__ __align__(128) byte smem[];
  Cta b(args, smem);
  if (threadIdx.x == 0) {
    note(b, WAIT_NONE);
    for (u32 i = 0; i < STAGES; ++i) barrier_init(b.full(i), 1), barrier_init(b.empty(i), W);
    for (int i = BAR_X; i <= BAR_V; ++i) barrier_init(b.bar(i), arrivals(b, i));
    barrier_init(b.bar(BAR_GO), S), barrier_init(b.bar(BAR_RMS), 1);
    init_own_barriers(b);
    asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    barrier_expect(b.bar(BAR_X), X_EXPECT);
    expect_own(b);
    barrier_expect(b.bar(BAR_Q), Q_EXPECT);
    barrier_expect(b.bar(BAR_TOPS), TOPS_EXPECT);
    barrier_expect(b.bar(BAR_COMB), outputs_expect(b));
    barrier_expect(b.bar(BAR_ATT), ATT_EXPECT);
    barrier_expect(b.bar(BAR_HID), hidden_bytes(b));
    barrier_expect(b.bar(BAR_V), V_EXPECT);
  }
  __syncthreads();
  cluster_exchange();
  if (b.warp() < W) {  // 4 x 112 + 32 registers on each quarter of the multiprocessor are what 5 x 96 were at launch
    asm volatile("setmaxnreg.inc.sync.aligned.u32 112;");
    consume(b);
  } else {
    asm volatile("setmaxnreg.dec.sync.aligned.u32 32;");
    if (b.warp() == W) {
      if (b.lane() == 0) {
        Producer producer(b);
        producer.run();
      }
    } else if (b.warp() == W + 1) {
      watch(b);
    } else if (b.warp() == W + 2) {
      make_inverse_rms(b);
    } else {
      help(b);
    }
  }
  __syncwarp();
  cluster_exchange();  // nobody leaves while a peer may still write to it
}
