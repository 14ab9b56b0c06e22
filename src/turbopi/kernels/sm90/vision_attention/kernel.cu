// The kernel; what it does, sizes and helpers are in base.cu, which comes before it.

extern "C" __global__ void __launch_bounds__(128 * (WGS + 1), 1)
vision_attention(ATTENTION_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024;
    const u32 keys = base + STAGES * STAGE_BYTES, values = keys + 2 * PAIR_BYTES, queries = values + 2 * PAIR_BYTES;
    const u32 factors = queries + QUERY_BLOCKS * QUERY_BLOCK, full = factors + (1 + FP8) * 3 * DIM * 8;
    const u32 empty = full + 8 * STAGES, near_full = empty + 8 * STAGES, far_full = near_full + 16;
    const int warpgroup = __shfl_sync(~0u, threadIdx.x / 128, 0);  // the same for all, as the compiler now sees
    const int unit = blockIdx.x / CTAS, quarter = blockIdx.x % CTAS, pair = quarter / 2, side = quarter % 2;
    const int rank = quarter % RANKS, picture = quotient(unit, heads), head = unit - picture * heads;
    const int first_row = (picture * CTAS + quarter) * ROWS;

    if (threadIdx.x == THREADS) {
        asm volatile("prefetch.tensormap [%0];\nprefetch.tensormap [%1];" ::"l"(&map_w), "l"(&map_a));
#pragma unroll
        for (int s = 0; s < STAGES; ++s) barrier_init(full + 8 * s, 1), barrier_init(empty + 8 * s, WGS * RANKS);
#pragma unroll
        for (int i = 0; i < 2; ++i) barrier_init(near_full + 8 * i, 1), barrier_init(far_full + 8 * i, 1);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
#pragma unroll
        for (int i = 0; i < 2; ++i) {  // keys, values
            barrier_expect(near_full + 8 * i, SHARE_BYTES);
            barrier_expect(far_full + 8 * i, 2 * SHARE_BYTES);
        }
    }
    cluster_sync();
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");

    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        const int lane = threadIdx.x % 32, warp = __shfl_sync(~0u, threadIdx.x / 32 - 4 * WGS, 0);
        const int kind = warp % 2;  // keys, values
        const u32 own = kind ? values : keys;
        if (warp < 2) {
            if (lane == 0) {
                if (warp == 1) asm volatile("griddepcontrol.wait;" ::: "memory");
                int slot = 0;
                u32 round = 0, since = 0;  // the last load
#pragma unroll 1
                for (int k = 0; k < k_blocks; ++k) {
                    const u32 bar = full + 8 * slot, to = base + slot * STAGE_BYTES;
                    if (round) {
                        barrier_wait(empty + 8 * slot, round & 1 ^ 1);
                    } else if (slot >= LEAD) {
                        const u32 before = full + 8 * (slot - LEAD);
                        while (!barrier_over(before, 0) && (warp == 1 || clock() - since < PACE)) {}
                    }
                    since = clock();
                    if (warp == 0) {
                        barrier_expect(bar, STAGE_BYTES);
#pragma unroll
                        for (int part = 0; part < 3; ++part)  // each loads some, in turns
                            if ((part + k) % RANKS == rank)
                                load<true>(to + A_BYTES + part * PART_BYTES, &map_w, k * BK, rows_of(part, heads, head), bar,
                                           (1 << RANKS) - 1);
                    } else {
                        load<false>(to, &map_a, k * BK, first_row, bar, 0);
                    }
                    if (++slot == STAGES) slot = 0, ++round;
                }
                if (ahead && warp == 0)
                    asm volatile("cp.async.bulk.prefetch.L2.global [%0], %1;"
                                 ::"l"(ahead + (size_t)blockIdx.x * ahead_bytes), "r"(ahead_bytes) : "memory");
                if (RANKS == 2) {
                    const int there = (unit * 2 + (pair ^ 1)) * 2 + kind;
                    await_pair(flags + there);
                    asm volatile("fence.proxy.async.global;" ::: "memory");
                    copy_in(own + PAIR_BYTES, exchange + (size_t)there * PAIR_BYTES, PAIR_BYTES, far_full + 8 * kind);
                }
            }
        } else {
            sync_consumers(4 + kind, 160);  // they are there
            if (lane < BLOCKS) {
                const u32 from = own + lane * KEY_BLOCK + side * QUERY_BLOCK;
                copy_to_cta(at_rank(from, rank ^ 1), from, QUERY_BLOCK, at_rank(near_full + 8 * kind, rank ^ 1));
                if (RANKS == 4) {
#pragma unroll
                    for (int i = 2; i < 4; ++i)
                        copy_to_cta(at_rank(from + PAIR_BYTES, rank ^ i), from, QUERY_BLOCK,
                                    at_rank(far_full + 8 * kind, rank ^ i));
                } else {
                    const size_t here = (unit * 2 + pair) * 2 + kind;
                    copy_out(exchange + here * PAIR_BYTES + lane * KEY_BLOCK + side * QUERY_BLOCK, from, QUERY_BLOCK);
                    asm volatile("fence.proxy.async.global;" ::: "memory");
                }
            }
            __syncwarp();
            if (RANKS == 2 && lane == 0) add_released(flags + (unit * 2 + pair) * 2 + kind, 1);
        }
    } else {
        asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
        const int own = threadIdx.x % 128, lane = own % 32, warp = own / 32;
        const int token = warp * 16 + lane / 4;  // of the CTA's 64, and 8 tokens on

        const Projection p = {sums_in, sums_of_w, offset,
#if TP_FP8
                              scale, bias,
#else
                              nullptr, nullptr,
#endif
                              inverse_width, eps, M, heads, head, k_blocks, first_row, side,
                              raw, base, keys, values, queries, factors, full, empty};
        if (warpgroup == 0) {
            if (BLOCKS % 2 && own < ROWS)  // zeros
                *(uint4*)(raw + (queries - shared_address(raw)) + (BLOCKS - 1) * QUERY_BLOCK + own * 16) = make_uint4(0, 0, 0, 0);
            project<0, KEPT>(p);
        } else {
            project<KEPT, OTHERS>(p);
        }
        show_to_async();
        sync_consumers(1, THREADS);

        const u32 seen = warpgroup * PAIR_BYTES, come = warpgroup ? far_full : near_full;
        float logits[KEYS / 2], sums[DIM / 2];
        const float none = __uint_as_float(0xff800000);  // -inf
        float top[2] = {none, none}, total[2] = {}, shrink[2];
        u32 weights[KEYS / 4];
        barrier_wait(come, 0);
        begin_products();
#pragma unroll
        for (int k = 0; k < DEPTH; ++k) {
            const bool odd = BLOCKS % 2 && k == DEPTH - 1;  // again the block before the last one, which meets zeros
            mma_logits(logits, core_operand(queries + 2 * k * QUERY_BLOCK, QUERY_BLOCK, 128),
                       core_operand(keys + seen + (2 * k - odd) * KEY_BLOCK, KEY_BLOCK, 128), k > 0);
        }
        commit_products(), await_products<0>();
        weigh_rows(logits, logit_scale, top, total, shrink, weights);
        barrier_wait(come + 8, 0);
        begin_products();
#pragma unroll
        for (int k = 0; k < KEYS / 16; ++k)
            mma_values(sums, weights[4 * k], weights[4 * k + 1], weights[4 * k + 2], weights[4 * k + 3],
                       core_operand(values + seen + k * 256, 128, KEY_BLOCK), k > 0);
        commit_products(), await_products<0>();
#pragma unroll
        for (int half = 0; half < 2; ++half) total[half] = sum_of_quad(total[half]);
        join_rows(sums, top, total, logit_scale, raw + (base - shared_address(raw)), warpgroup, own);
        store_rows(
            sums, total, inverse, WGS, warpgroup, lane,
            [&](int half) { return out + ((size_t)(first_row + token + half * 8) * heads + head) * DIM; },
            [](int) { return true; });
    }
    cluster_sync();  // what this CTA sends may still be on its way
}
