// The kernel; what it does, sizes and helpers are in base.cu, which comes before it.

extern "C" __global__ void __launch_bounds__(128 * (WGS + 1), TP_LEAVES_ROOM ? 2 : 1)
gemm(GEMM_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024;
    const u32 full = base + STAGES * STAGE_BYTES + RECEIVED_BYTES, empty = full + 8 * STAGES;
    const u32 gathered = empty + 8 * STAGES;
    const int warpgroup = threadIdx.x / 128, rank = CLUSTER > 1 ? blockIdx.x % CLUSTER : 0;
    const int units = m_groups * n_groups * (GATHER ? 1 : SPLITS);
    const int stride = gridDim.x / CLUSTER, first = blockIdx.x / CLUSTER;

    if (threadIdx.x == 128 * WGS) {
        asm volatile("prefetch.tensormap [%0];\nprefetch.tensormap [%1];" ::"l"(&map_w), "l"(&map_a));
        // by one thread: several take turns, 50 cycles for each barrier
#pragma unroll
        for (int s = 0; s < STAGES; ++s) {
            barrier_init(full + 8 * s, 1);
            barrier_init(empty + 8 * s, WGS * (CM + CN - 1));
        }
        if (GATHER) barrier_init(gathered, 1);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
    if (CLUSTER > 1) cluster_sync();
    else __syncthreads();
    asm volatile("griddepcontrol.launch_dependents;");

    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        const int producer = threadIdx.x / 32 - 4 * WGS;  // 0 loads w, 1 loads a
        if (threadIdx.x % 32 == 0 && producer < 2) {
            const int cm = rank % SHARING / CN, cn = rank % CN, others = rank / SHARING * SHARING;  // those before
            const u32 same_row = ((1u << CN) - 1) << (others + cm * CN);
            u32 same_column = 0;
            for (int i = 0; i < CM; ++i) same_column |= 1u << (others + i * CN + cn);
            constexpr int ROWS = TILE_N / CM;
            auto load_w = [&](int s, int k, int n) {
                const u32 bar = full + 8 * s;
                barrier_expect(bar, STAGE_BYTES);
                for (int part = 0; part < PARTS; ++part) {
                    const u32 to = base + s * STAGE_BYTES + A_BYTES + (part * CM + cm) * ROWS * ROW_BYTES;
                    load<(CM > 1)>(to, &map_w, k * BK, part * N + n + cm * ROWS, bar, same_column);
                }
            };
            auto load_a = [&](int s, int k, int m) {
                const u32 to = base + s * STAGE_BYTES + cn * (A_BYTES / CN);
                load<(CN > 1)>(to, &map_a, k * BK, m + cn * (BM / CN), full + 8 * s, same_row);
            };
            if (producer == 1) asm volatile("griddepcontrol.wait;" ::: "memory");
            int slot = 0;
            u32 round = 0, since = 0;  // the last load
            for (int unit = first; unit < units; unit += stride) {
                const Tile t = tile_of(unit, m_groups, n_groups, k_blocks, rank);
#pragma unroll 1
                for (int k = t.k; k < t.k_end; ++k) {
                    if (round) {
                        barrier_wait(empty + 8 * slot, round & 1 ^ 1);
                    } else if (PACED && slot >= LEAD) {
                        const u32 before = full + 8 * (slot - LEAD);
                        while (!barrier_over(before, 0) && (producer == 1 || clock() - since < PACE)) {}
                    }
                    since = clock();
                    if (producer == 0) load_w(slot, k, t.n);
                    else load_a(slot, k, t.m);
                    if (++slot == STAGES) slot = 0, ++round;
                }
            }
            if (ahead && producer == 0)
                asm volatile("cp.async.bulk.prefetch.L2.global [%0], %1;"
                             ::"l"(ahead + (size_t)blockIdx.x * ahead_bytes), "r"(ahead_bytes) : "memory");
            // Others signal this CTA's barriers, which must not end before: a cluster's barrier doesn't wait for signals
            // on their way, unless it waits for all that was stored, too.
            for (int s = 0; CLUSTER > 1 && producer == 0 && s < STAGES; ++s) {
                if (round) barrier_wait(empty + 8 * slot, round & 1 ^ 1);
                if (++slot == STAGES) slot = 0, ++round;
            }
        }
        if (GATHER && !APART) {  // with the consumers
            __syncwarp();
            cluster_sync();
        }
    } else {
        asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
        const int lane = threadIdx.x % 32, warp = threadIdx.x / 32 % 4;
        const int group = __shfl_sync(~0u, warpgroup, 0);  // the same for all, as the compiler now sees
        auto release = [&](int slot) {
            const u32 bar = empty + 8 * slot;
            if (SHARING == 1) {
                if (threadIdx.x % 128 == 0) barrier_arrive(bar);
            } else {  // all that load into this CTA
                const int place = threadIdx.x % 128, own = rank % SHARING;
                if (place < SHARING && (place / CN == own / CN || place % CN == own % CN))
                    barrier_arrive(bar, rank - own + place);
            }
        };
        const u32 a_lower = lower_half(base + group * 8192), b_lower = lower_half(base + A_BYTES);
        int slot = 0, last = 0;
        u32 parity = 0;
        auto multiply = [&](Sum(&to)[BN / 2], bool keep) {  // one step, and no more than it is still going on then
            barrier_wait(full + 8 * slot, parity);
            const u32 a = a_lower + slot * (STAGE_BYTES / 16), b = b_lower + slot * (STAGE_BYTES / 16);
            begin_products();
#pragma unroll
            for (int j = 0; j < 4; ++j) mma(to, operand_of(a + 2 * j), operand_of(b + 2 * j), keep || j > 0);
            commit_products(), await_products<1>();
        };
        auto advance = [&] {
            last = slot++;
            if (slot == STAGES) slot = 0, parity ^= 1;
        };
        [[maybe_unused]] float2* const behind_barriers =
            (float2*)(raw + (gathered + 16 - shared_address(raw)));  // for `Factors` and lines
#if TP_OVERLAP
        auto step = [&](float(&sums)[BN / 2], bool first, bool keep) {
            multiply(sums, keep);
            if (!first) release(last);
            advance();
        };
        auto tile_at = [&](int unit) { return tile_of(unit, m_groups, n_groups, k_blocks, rank); };
        auto end = [&] { await_products<0>(), release(last); };
        overlapped_tiles(step, end, tile_at, first, units, stride, k_blocks, (Element*)out, (const u16*)bias, M, N, group,
                         behind_barriers + group * BN
#if TP_FP8
                         , scale, inverse
#endif
        );
#else
#if TP_PROMOTE
        float parts[BN / 2] = {};  // of the sums: what the tensor cores have not handed over yet
#endif
        for (int unit = first; unit < units; unit += stride) {
            const Tile t = tile_of(unit, m_groups, n_groups, k_blocks, rank);
            const int row = t.m + group * 64 + warp * 16 + lane / 4, col = t.n + lane % 4 * 2;  // and 8 rows on
            const int blocks = max(0, min((N - t.n) / 8, TILE_N / 8));  // of 8 columns, within the matrix
            const int in_row[2] = {row < M ? blocks : 0, row + 8 < M ? blocks : 0};
            float sums[BN / 2];
#if TP_FP8
            Factors<u16> factors;  // where the input is normed, `bias` goes with the offset
            factors.fetch(scale, (const u16*)bias, t.n, N, bias && t.split == 0);
            if (EPILOGUE == 3) factors.scale_up(0.5f * inverse);
            float2* const shared = behind_barriers + group * BN;
#endif
#if TP_NORMED
            Factors<float> of_norm;
            of_norm.fetch(sums_of_w, offset, t.n, N, true);
            float2* const shared_norm = behind_barriers + (FP8 * WGS + group) * BN;
#endif
            u32 offsets[BIASED ? BN / 8 : 1];  // the bias of this lane's columns, read long before it is needed
            if (BIASED) {
#pragma unroll
                for (int j = 0; j < BN / 8; ++j) {
                    const bool needed = GATHER ? owner(j) == t.split : t.split == 0;
                    offsets[j] = bias && j < blocks && needed ? bias[col / 2 + 4 * j] : 0;
                }
            }
#if TP_COPY
            float2 scales[BN / 8], shifts[BN / 8];  // of the next norm
#pragma unroll
            for (int j = 0; j < BN / 8; ++j) {
                const bool needed = j < blocks && (!GATHER || owner(j) == t.split);
                scales[j] = needed ? norm_scale[col / 2 + 4 * j] : make_float2(0.0f, 0.0f);
                shifts[j] = needed ? norm_shift[col / 2 + 4 * j] : make_float2(0.0f, 0.0f);
            }
#endif
#if TP_ROW_PARTS
            const float2* const own_sums = settled(sums_in + (size_t)(lane % 4) * M + row);
#endif
#if TP_RESIDUAL
            const u32* const own_residual[2] = {settled(residual + ((size_t)row * N + col) / 2),
                                                settled(residual + ((size_t)(row + 8) * N + col) / 2)};
#endif
#if TP_RESIDUAL || TP_NORMED
            asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
#if TP_ROW_PARTS
            constexpr int OWN_SUMS = (TP_ROW_PARTS + 3) / 4;
            float2 row_sums[2][OWN_SUMS];
#pragma unroll
            for (int i = 0; i < 2 * OWN_SUMS; ++i) {
                const bool there = row + i % 2 * 8 < M && i / 2 * 4 + lane % 4 < TP_ROW_PARTS;
                row_sums[i % 2][i / 2] =
                    there ? own_sums[(size_t)(i / 2 * 4) * M + i % 2 * 8] : make_float2(0.0f, 0.0f);
            }
#endif
#if TP_RESIDUAL
            u32 before[2][BN / 8];
#pragma unroll
            for (int i = 0; i < BN / 4; ++i) {
                const int half = i % 2, j = i / 2;
                const bool needed = j < in_row[half] && (!GATHER || owner(j) == t.split);
                before[half][j] = needed ? own_residual[half][4 * j] : 0;
            }
#endif
#if TP_ROW_PARTS
            float mean[2], factor[2];
#endif
#if TP_RESIDUAL && !TP_FP8
            float plus[BN / 2];  // bias and residual
#endif
            auto prepare = [&] {  // what was loaded above, for the epilogue
#if TP_RESIDUAL && !TP_FP8
#pragma unroll
                for (int i = 0; i < BN / 4; ++i) {
                    const int half = i % 2, j = i / 2;
                    plus[2 * i] = bf16_low(before[half][j]) + (BIASED ? bf16_low(offsets[j]) : 0.0f);
                    plus[2 * i + 1] = bf16_high(before[half][j]) + (BIASED ? bf16_high(offsets[j]) : 0.0f);
                }
#endif
#if TP_NORMED
                of_norm.share(shared_norm, group);
#endif
#if TP_FP8
                factors.share(shared, group);
#endif
#if TP_ROW_PARTS
#pragma unroll
                for (int half = 0; half < 2; ++half) {
                    float sum = 0.0f, squares = 0.0f;
#pragma unroll
                    for (int i = 0; i < OWN_SUMS; ++i) sum += row_sums[half][i].x, squares += row_sums[half][i].y;
                    mean[half] = settled(sum_of_quad(sum) * inverse_width);
                    const float variance = sum_of_quad(squares) * inverse_width - mean[half] * mean[half];
                    factor[half] = settled(rsqrtf(fmaxf(variance, 0.0f) + eps));
                }
#endif
            };
#if TP_PROMOTE
#pragma unroll
            for (int i = 0; i < BN / 2; ++i) sums[i] = 0.0f;
            // Three warpgroups do it at different times, as nothing is multiplied for one meanwhile; two lose by that.
            int length = TP_PROMOTE - (WGS == 3 ? group : 0);
            for (int k = t.k; k < t.k_end; length = TP_PROMOTE) {
                const int start = k, stop = min(k + length, t.k_end);
                for (; k < stop; ++k) {
                    multiply(parts, k > start);
                    if (k > start) release(last);
                    advance();
                }
                await_products<0>();
                release(last);
#pragma unroll
                for (int i = 0; i < BN / 2; ++i) sums[i] += parts[i];
            }
            prepare();
#else
#if TP_INT8
            int products[BN / 2];
#else
#define products sums
#endif
            // The first products don't wait for what only the epilogue needs.
            multiply(products, false), advance();
            if (t.k + 1 < t.k_end) multiply(products, true), release(last), advance();
            prepare();
            for (int k = t.k + 2; k < t.k_end; ++k) multiply(products, true), release(last), advance();
            await_products<0>();
            release(last);
#if TP_INT8
#pragma unroll
            for (int i = 0; i < BN / 2; ++i)  // volatile: not before they are done
                asm volatile("cvt.rn.f32.s32 %0, %1;" : "=f"(sums[i]) : "r"(products[i]));
#endif
#endif
#if TP_FP8 && !TP_NORMED
#pragma unroll
            for (int j = 0; j < BN / 8; ++j) {  // sums of whole numbers become what they stand for
                const float4 of = *(const float4*)(shared + j * 8 + lane % 4 * 2);
#pragma unroll
                for (int half = 0; half < 2; ++half) {
                    float &x = sums[4 * j + 2 * half], &y = sums[4 * j + 2 * half + 1];
                    x = fmaf(x, of.x, of.y), y = fmaf(y, of.z, of.w);
                }
            }
#endif
#if TP_NORMED
#pragma unroll
            for (int j = 0; j < BN / 8; ++j) {
                const float4 of_w = *(const float4*)(shared_norm + j * 8 + lane % 4 * 2);
#if TP_FP8
                const float4 of = *(const float4*)(shared + j * 8 + lane % 4 * 2);
#endif
#pragma unroll
                for (int half = 0; half < 2; ++half) {
                    float &x = sums[4 * j + 2 * half], &y = sums[4 * j + 2 * half + 1];
#if TP_FP8  // the shift is in x already, once: (x by - mean of_w - plus) factor + plus + bias
                    x = fmaf(fmaf(x, of.x, -fmaf(mean[half], of_w.x, of_w.y)), factor[half], of_w.y + of.y);
                    y = fmaf(fmaf(y, of.z, -fmaf(mean[half], of_w.z, of_w.w)), factor[half], of_w.w + of.w);
#else
                    x = fmaf(x - mean[half] * of_w.x, factor[half], of_w.y);
                    y = fmaf(y - mean[half] * of_w.z, factor[half], of_w.w);
#endif
                }
            }
#endif

#if TP_GATHER
            gather(sums, t.split, raw, base, rank, gathered);
#endif

#if TP_EPILOGUE >= 5
            if (BIASED) {
#pragma unroll
                for (int i = 0; i < BN / 2; ++i)
                    sums[i] += i % 2 ? bf16_high(offsets[i / 4]) : bf16_low(offsets[i / 4]);
            }
            store_part(sums, (u16*)out + ((size_t)t.split * M + t.m + group * 64 + warp * 16) * N + t.n,
                       (char*)(behind_barriers + FP8 * WGS * BN) + threadIdx.x / 32 * ROWS_BYTES,
                       M - (t.m + group * 64 + warp * 16), N, blocks, lane);
#else
#pragma unroll
            for (int half = 0; half < 2; ++half) {
                const size_t begin = (size_t)(row + half * 8) * N;  // of the row
                if (EPILOGUE == 4) {
                    float* const to = (float*)out + (size_t)t.split * M * N + begin + col;
#pragma unroll
                    for (int j = 0; j < TILE_N / 8; ++j) {
                        float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
                        if (BIASED) x += bf16_low(offsets[j]), y += bf16_high(offsets[j]);
                        if (j < in_row[half]) *(float2*)(to + 8 * j) = make_float2(x, y);
                    }
                } else {
#if TP_COPY
                    const float shift = -mean[half] * factor[half];
                    int missing = 0;  // blocks beyond the matrix, which are zeros, in these units `shift`
#pragma unroll
                    for (int j = 0; j < TILE_N / 8; ++j) missing += j >= blocks && (!GATHER || owner(j) == t.split);
                    const float beyond = shift * 2 * missing;
                    float sum = -beyond, squares = -beyond * shift, plain_sum = 0.0f, plain_squares = 0.0f;
                    u32 copies[TILE_N / 8];
#elif TP_RESIDUAL
                    float sum = 0.0f, squares = 0.0f;  // of the row's results
#endif
#if TP_MARKS
                    bool damaged = false;
#endif
                    auto value = [&](int j) -> u32 {
                        float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
#if TP_RESIDUAL && !TP_FP8
                        x += plus[4 * j + 2 * half], y += plus[4 * j + 2 * half + 1];
#else
                        if (BIASED) x += bf16_low(offsets[j]), y += bf16_high(offsets[j]);
#endif
                        if (EPILOGUE == 2) x = gelu(x), y = gelu(y);
                        if (EPILOGUE == 3) {  // of E4M3, `up` has the half and what the result is multiplied by in it
                            x = (FP8 ? twice_gelu(x) : gelu(x)) * sums[BN / 4 + 4 * j + 2 * half];
                            y = (FP8 ? twice_gelu(y) : gelu(y)) * sums[BN / 4 + 4 * j + 2 * half + 1];
                        }
#if TP_RESIDUAL
                        if (FP8) x += bf16_low(before[half][j]), y += bf16_high(before[half][j]);
                        const u32 both = pack(x, y);
                        x = bf16_low(both), y = bf16_high(both);
#if TP_COPY
                        plain_sum += x + y, plain_squares = fmaf(x, x, fmaf(y, y, plain_squares));
                        x = fmaf(x, factor[half], shift), y = fmaf(y, factor[half], shift);
                        copies[j] = pack_e4m3(fmaf(x, scales[j].x, shifts[j].x), fmaf(y, scales[j].y, shifts[j].y));
#endif
                        sum += x + y, squares = fmaf(x, x, fmaf(y, y, squares));
                        return both;
#endif
#if TP_MARKS
                        damaged |= j < blocks && !(fabsf(x) < INFINITE && fabsf(y) < INFINITE);
#endif
#if TP_FP8
                        if (OUT_FP8 && EPILOGUE == 3) return pack_eight_bits(x, y);
                        if (OUT_FP8) return pack_eight_bits(x * inverse, y * inverse);
#endif
                        return pack(x, y);
                    };
                    store_row(settled((Element*)out + begin + t.n), in_row[half], t.split, lane, value);
#if TP_MARKS
                    if (damaged && row + half * 8 < M) marked[(size_t)(row + half * 8) * mark_pitch] = 0x7fff;
#endif
#if TP_COPY
                    auto copied = [&](int j) { return copies[j]; };
                    store_row(settled(copy + begin + t.n), in_row[half], t.split, lane, copied);
                    if (t.n == 0 && t.split == 0 && lane % 4 == 0)  // so that no eps is needed any more
                        squares += eps * factor[half] * factor[half] / inverse_width;
#endif
#if TP_RESIDUAL
                    sum = sum_of_quad(sum), squares = sum_of_quad(squares);
                    const int part = GATHER ? t.n / TILE_N * SPLITS + t.split : t.n / TILE_N;
                    if (in_row[half] && lane % 4 == 0)
                        sums_out[(size_t)part * M + row + half * 8] = make_float2(sum, squares);
#endif
#if TP_COPY
                    plain_sum = sum_of_quad(plain_sum), plain_squares = sum_of_quad(plain_squares);
                    if (in_row[half] && lane % 4 == 0)
                        plain_sums[(size_t)part * M + row + half * 8] = make_float2(plain_sum, plain_squares);
#endif
                }
            }
#endif
        }
#endif
    }
}
