// The kernel; what it does, sizes and helpers are in gemm_base.cu, which comes before it.

extern "C" __global__ void __launch_bounds__(128 * (WGS + 1), 1)
gemm(const __grid_constant__ TensorMap map_a, const __grid_constant__ TensorMap map_w, void* out, const u32* bias,
#if TP_FP8
     const float* scale, float inverse,
#endif
#if TP_RESIDUAL
     const u32* residual, float2* sums_out,
#endif
#if TP_ROW_PARTS
     const float2* sums_in, float inverse_width, float eps,
#endif
#if TP_NORMED
     const float* sums_of_w, const float* offset,
#endif
#if TP_COPY
     const u32* norm_scale, const u32* norm_shift, float copy_inverse, unsigned char* copy,
#endif
     int M, int N, int k_blocks, int m_groups, int n_groups, const char* ahead, u32 ahead_bytes) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024;
    const u32 full = base + STAGES * STAGE_BYTES, empty = full + 8 * STAGES;
    const int warpgroup = threadIdx.x / 128, rank = CLUSTER > 1 ? blockIdx.x % CLUSTER : 0;
    const int units = m_groups * n_groups * (GATHER ? 1 : SPLITS);
    const int stride = gridDim.x / CLUSTER, first = blockIdx.x / CLUSTER;

    if (threadIdx.x == 128 * WGS) {
        asm volatile("prefetch.tensormap [%0];\nprefetch.tensormap [%1];" ::"l"(&map_a), "l"(&map_w));
    }
    if (threadIdx.x == 0) {
        for (int s = 0; s < STAGES; ++s) {
            barrier_init(full + 8 * s, 1);
            barrier_init(empty + 8 * s, WGS * (CM + CN - 1));
        }
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
    if (CLUSTER > 1) cluster_sync();
    else __syncthreads();
    asm volatile("griddepcontrol.launch_dependents;");

    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        if (threadIdx.x == 128 * WGS) {
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
            int step = 0;
            for (int unit = first; unit < units; unit += stride) {
                const Tile t = tile_of(unit, m_groups, n_groups, k_blocks, rank);
                int k = t.k;
                if (unit == first) {
                    const int early = min(STAGES, t.k_end - t.k);
                    for (; step < early; ++step) load_w(step, k + step, t.n);
                    asm volatile("griddepcontrol.wait;" ::: "memory");
                    for (step = 0; step < early; ++step, ++k) load_a(step, k, t.m);
                }
                for (; k < t.k_end; ++k, ++step) {
                    const int s = step % STAGES;
                    if (step >= STAGES) barrier_wait(empty + 8 * s, (step / STAGES + 1) & 1);
                    load_w(s, k, t.n);
                    load_a(s, k, t.m);
                }
            }
            if (ahead)
                asm volatile("cp.async.bulk.prefetch.L2.global [%0], %1;"
                             ::"l"(ahead + (size_t)blockIdx.x * ahead_bytes), "r"(ahead_bytes) : "memory");
        }
        if (GATHER) {  // with the consumers
            __syncwarp();
            cluster_sync();
            cluster_exchange();
        }
    } else {
        asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
        const int group = warpgroup, lane = threadIdx.x % 32, warp = threadIdx.x / 32 % 4;
        auto release = [&](int step) {
            const u32 bar = empty + 8 * (step % STAGES);
            if (SHARING == 1) {
                if (threadIdx.x % 128 == 0) barrier_arrive(bar);
            } else {  // all that load into this CTA
                const int place = threadIdx.x % 128, own = rank % SHARING;
                if (place < SHARING && (place / CN == own / CN || place % CN == own % CN))
                    barrier_arrive(bar, rank - own + place);
            }
        };
        int step = 0;
#if TP_PROMOTE
        float parts[BN / 2] = {};  // of the sums: what the tensor cores have not handed over yet
#endif
        for (int unit = first; unit < units; unit += stride) {
            const Tile t = tile_of(unit, m_groups, n_groups, k_blocks, rank);
            float sums[BN / 2];
#if TP_FP8
            Factors factors;  // where the input is normed, `bias` goes with the offset
            factors.fetch(scale, (const u16*)bias, t.n, N, bias && t.split == 0);
            float* const shared = (float*)(raw + (empty + 8 * STAGES - shared_address(raw))) + group * 2 * BN;
#if TP_PROMOTE
#pragma unroll
            for (int i = 0; i < BN / 2; ++i) sums[i] = 0.0f;
#endif
#endif
#if TP_NORMED
            Factors of_norm;
            of_norm.fetch(sums_of_w, offset, t.n, N);
            float* const shared_norm =
                (float*)(raw + (empty + 8 * STAGES - shared_address(raw))) + (FP8 * WGS + group) * 2 * BN;
#endif
#if TP_COPY
            u32 scales[BN / 8], shifts[BN / 8];  // of the next norm
#pragma unroll
            for (int j = 0; j < BN / 8; ++j) {
                const int col = t.n + j * 8 + lane % 4 * 2;
                scales[j] = col < N ? norm_scale[col / 2] : 0, shifts[j] = col < N ? norm_shift[col / 2] : 0;
            }
#endif
#if TP_RESIDUAL || TP_NORMED
            asm volatile("griddepcontrol.wait;" ::: "memory");
#endif
#if TP_ROW_PARTS
            constexpr int OWN_SUMS = (TP_ROW_PARTS + 3) / 4;  // of a row's parts: fetched now, needed in the end
            float2 row_sums[2][OWN_SUMS];
#pragma unroll
            for (int i = 0; i < 2 * OWN_SUMS; ++i) {
                const int row = t.m + group * 64 + warp * 16 + lane / 4 + i % 2 * 8, part = i / 2 * 4 + lane % 4;
                const bool there = row < M && part < TP_ROW_PARTS;
                row_sums[i % 2][i / 2] = there ? sums_in[(size_t)part * M + row] : make_float2(0.0f, 0.0f);
            }
#endif
#if TP_RESIDUAL
            u32 before[2][BN / 8];
#pragma unroll
            for (int i = 0; i < BN / 4; ++i) {
                const int half = i % 2, j = i / 2, row = t.m + group * 64 + warp * 16 + lane / 4 + half * 8;
                const int col = t.n + j * 8 + lane % 4 * 2;
                const bool needed = row < M && col < N && (!GATHER || owner(j) == t.split);
                before[half][j] = needed ? residual[((size_t)row * N + col) / 2] : 0;
            }
#endif
            u32 offsets[BIASED ? BN / 8 : 1];  // the bias of this lane's columns, read long before it is needed
            if (BIASED) {
#pragma unroll
                for (int j = 0; j < BN / 8; ++j) {
                    const int col = t.n + j * 8 + lane % 4 * 2;
                    offsets[j] = bias && col < N && (GATHER || t.split == 0) ? bias[col / 2] : 0;
                }
            }
#if TP_PROMOTE
            for (int k = t.k; k < t.k_end;) {
                const int start = k, stop = min(k + TP_PROMOTE, t.k_end);
                for (; k < stop; ++k, ++step) {
                    const int s = step % STAGES;
                    barrier_wait(full + 8 * s, (step / STAGES) & 1);
                    const u32 a = base + s * STAGE_BYTES + group * 8192, b = base + s * STAGE_BYTES + A_BYTES;
                    begin_products();
#pragma unroll
                    for (int j = 0; j < 4; ++j)
                        mma(parts, operand(a + j * 32), operand(b + j * 32), k > start || j > 0);
                    commit_products(), await_products<1>();
                    if (k > start) release(step - 1);
                }
                await_products<0>();
                release(step - 1);
#pragma unroll
                for (int i = 0; i < BN / 2; ++i) sums[i] += parts[i];
            }
#else
            for (int k = t.k; k < t.k_end; ++k, ++step) {
                const int s = step % STAGES;
                barrier_wait(full + 8 * s, (step / STAGES) & 1);
                const u32 a = base + s * STAGE_BYTES + group * 8192, b = base + s * STAGE_BYTES + A_BYTES;
                begin_products();
#pragma unroll
                for (int j = 0; j < 4; ++j)
                    mma(sums, operand(a + j * 32), operand(b + j * 32), k > t.k || j > 0);
                commit_products(), await_products<1>();
                if (k > t.k) release(step - 1);
            }
            await_products<0>();
            release(step - 1);
#endif
#if TP_FP8
            factors.share(shared, group);
#endif
#if TP_FP8 && !TP_NORMED
#pragma unroll
            for (int j = 0; j < BN / 8; ++j) {  // sums of whole numbers become what they stand for
                const float2 by = *(const float2*)(shared + j * 8 + lane % 4 * 2);
                const float2 plus = *(const float2*)(shared + BN + j * 8 + lane % 4 * 2);
#pragma unroll
                for (int half = 0; half < 2; ++half) {
                    float &x = sums[4 * j + 2 * half], &y = sums[4 * j + 2 * half + 1];
                    x = fmaf(x, by.x, plus.x), y = fmaf(y, by.y, plus.y);
                }
            }
#endif

#if TP_NORMED
            of_norm.share(shared_norm, group);
#endif
#if TP_ROW_PARTS
            float mean[2], factor[2];
#pragma unroll
            for (int half = 0; half < 2; ++half) {
                float sum = 0.0f, squares = 0.0f;
#pragma unroll
                for (int i = 0; i < OWN_SUMS; ++i) sum += row_sums[half][i].x, squares += row_sums[half][i].y;
                mean[half] = sum_of_quad(sum) * inverse_width;
                const float variance = sum_of_quad(squares) * inverse_width - mean[half] * mean[half];
                factor[half] = rsqrtf(fmaxf(variance, 0.0f) + eps);
            }
#endif
#if TP_NORMED
#pragma unroll
            for (int j = 0; j < BN / 8; ++j) {
                const float2 of_w = *(const float2*)(shared_norm + j * 8 + lane % 4 * 2);
                const float2 plus = *(const float2*)(shared_norm + BN + j * 8 + lane % 4 * 2);
#if TP_FP8
                const float2 by = *(const float2*)(shared + j * 8 + lane % 4 * 2);
                const float2 biases = *(const float2*)(shared + BN + j * 8 + lane % 4 * 2);
#endif
#pragma unroll
                for (int half = 0; half < 2; ++half) {
                    float &x = sums[4 * j + 2 * half], &y = sums[4 * j + 2 * half + 1];
#if TP_FP8  // the shift is in x already, once: (x by - mean of_w - plus) factor + plus + bias
                    x = fmaf(fmaf(x, by.x, -fmaf(mean[half], of_w.x, plus.x)), factor[half], plus.x + biases.x);
                    y = fmaf(fmaf(y, by.y, -fmaf(mean[half], of_w.y, plus.y)), factor[half], plus.y + biases.y);
#else
                    x = fmaf(x - mean[half] * of_w.x, factor[half], plus.x);
                    y = fmaf(y - mean[half] * of_w.y, factor[half], plus.y);
#endif
                }
            }
#endif

#if TP_GATHER
            gather(sums, t.split, raw, base, rank);
#endif

#pragma unroll
            for (int half = 0; half < 2; ++half) {
                const int row = t.m + group * 64 + warp * 16 + lane / 4 + half * 8;
                const bool inside = row < M;
                constexpr int BLOCKS = TILE_N / 8;
                if (EPILOGUE == 4) {
                    float* to = (float*)out + ((size_t)t.split * M + row) * N;
#pragma unroll
                    for (int j = 0; j < BLOCKS; ++j) {
                        const int col = t.n + j * 8 + lane % 4 * 2;
                        float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
                        if (BIASED) x += bf16_low(offsets[j]), y += bf16_high(offsets[j]);
                        if (inside && col < N) *(float2*)(to + col) = make_float2(x, y);
                    }
                } else {
#if TP_RESIDUAL
                    float sum = 0.0f, squares = 0.0f;  // of the row's results
#endif
#if TP_COPY
                    u32 copies[BLOCKS];
#endif
                    auto value = [&](int j) -> u32 {
                        float x = sums[4 * j + 2 * half], y = sums[4 * j + 2 * half + 1];
                        if (BIASED) x += bf16_low(offsets[j]), y += bf16_high(offsets[j]);
                        if (EPILOGUE == 2) x = gelu(x), y = gelu(y);
                        if (EPILOGUE == 3) {
                            x = gelu(x) * sums[BN / 4 + 4 * j + 2 * half];
                            y = gelu(y) * sums[BN / 4 + 4 * j + 2 * half + 1];
                        }
#if TP_RESIDUAL
                        const u32 both = pack(x + bf16_low(before[half][j]), y + bf16_high(before[half][j]));
                        x = bf16_low(both), y = bf16_high(both);
#if TP_COPY
                        const bool there = t.n + j * 8 < N;
                        x = there ? (x - mean[half]) * factor[half] : 0.0f;
                        y = there ? (y - mean[half]) * factor[half] : 0.0f;
                        copies[j] = pack_e4m3(fmaf(x, bf16_low(scales[j]), bf16_low(shifts[j])) * copy_inverse,
                                              fmaf(y, bf16_high(scales[j]), bf16_high(shifts[j])) * copy_inverse);
#endif
                        sum += x + y, squares += x * x + y * y;
                        return both;
#endif
#if TP_FP8
                        if (OUT_FP8) return pack_e4m3(x * inverse, y * inverse);
#endif
                        return pack(x, y);
                    };
                    store_row((Element*)out + (size_t)row * N, t, N, inside, lane, value);
#if TP_COPY
                    store_row(copy + (size_t)row * N, t, N, inside, lane, [&](int j) { return copies[j]; });
                    if (t.n == 0 && (!GATHER || t.split == 0) && lane % 4 == 0)  // so that no eps is needed any more
                        squares += eps * factor[half] * factor[half] / inverse_width;
#endif
#if TP_RESIDUAL
                    sum = sum_of_quad(sum), squares = sum_of_quad(squares);
                    const int part = GATHER ? t.n / TILE_N * SPLITS + t.split : t.n / TILE_N;
                    if (inside && t.n < N && lane % 4 == 0)
                        sums_out[(size_t)part * M + row] = make_float2(sum, squares);
#endif
                }
            }
        }
    }
    if (CLUSTER > 1) cluster_sync();  // the other CTA may still signal barriers here
}
