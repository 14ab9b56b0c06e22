// out = softmax(scale * q @ k^T) @ v in bfloat16 with float32 logits and sums, over the first `length` keys: TMA feeds
// shared memory, wgmma multiplies. For compute capability 9.0, where there are fewer CTAs than multiprocessors; wide.cu
// has more rows. kernel.py sets the TP_ constants.
//
// q, k and v are columns of matrices [rows, heads, TP_DIM] (possibly of one and the same): heads of q begin at column
// block 0, those of k at `k_first`, of v at `v_first`. In every one of gridDim.x / tiles groups, a head of a picture or
// of all there is, `rows` rows of q see `keys` rows of k and v; one query head has one head of keys.
//
// TP_SHARING CTAs of one group form a cluster: each loads a share of every tile of keys and values into all of them.
// All tiles must have room then, as nobody waits for the others to free a slot.
//
// TP_WHOLE: there are KEYS keys for each warpgroup and no length, so that nothing is decided while it runs.
//
// A CTA has 64 rows of q, a producer warp and TP_WGS consumer warpgroups, which take tiles of TP_KEYS keys in turn: one
// multiplies while another weighs. In the end each gets the others' sums of a share of the columns.

constexpr int SHARING = TP_SHARING;
constexpr bool WHOLE = TP_WHOLE;
constexpr int Q_PANEL = 64 * ROW_BYTES, Q_BYTES = PANELS * Q_PANEL, FOURS = (BLOCKS + 3) / 4;
static_assert(STAGES >= 2 * WGS, "a warpgroup would wait for a slot that it holds");
static_assert(WGS <= 2, "in the end each gets the sums of one other");
static_assert(KEYS % (8 * SHARING) == 0 && SHARING <= 8, "a swizzle's rows are one CTA's share, or several");
// which warpgroup ends up with a block of 8 columns; blocks go in fours, as that many leave together
__device__ constexpr int owner(int block) { return block / 4 * WGS / FOURS; }

// into all CTAs of the cluster, at the same place in each
__device__ __forceinline__ void load_into_all(u32 to, const TensorMap* map, int column, int head, int row, u32 bar) {
    asm volatile(
        "cp.async.bulk.tensor.3d.shared::cluster.global.mbarrier::complete_tx::bytes.multicast::cluster"
        " [%0], [%1, {%2, %3, %4}], [%5], %6;"
        ::"r"(to), "l"(map), "r"(column), "r"(head), "r"(row), "r"(bar), "h"((u16)((1 << SHARING) - 1)) : "memory");
}

extern "C" __global__ void __launch_bounds__(128 * (WGS + 1), 1)
attention(ATTENTION_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024;
    const Ring ring{base + Q_BYTES};
    const u32 q_full = ring.slots + Ring::BYTES;
    const int warpgroup = __shfl_sync(~0u, threadIdx.x / 128, 0);  // the same for all, as the compiler now sees

    if (threadIdx.x == THREADS) {
        asm volatile("prefetch.tensormap [%0];\nprefetch.tensormap [%1];\nprefetch.tensormap [%2];"
                     ::"l"(&map_q), "l"(&map_k), "l"(&map_v));
    }
    if (threadIdx.x == 0) {
        barrier_init(q_full, 1);
        ring.init(1);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
    if (SHARING > 1) cluster_sync();
    else __syncthreads();
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
    // who loads nothing and asks for no length begins when something is there, so what is behind the wait
    if (!WHOLE) asm volatile("griddepcontrol.wait;" ::: "memory");

    const int series = quotient(blockIdx.x, tiles), group = quotient(series, heads), head = series - group * heads;
    const int row = (blockIdx.x - series * tiles) * 64;  // in its group

    // Tiles pass through the ring in rounds: one of keys for each warpgroup, then their values. Each warpgroup's first
    // keys, up to `early`, are loaded and multiplied before the length is known.
    const int early = WHOLE ? WGS : min((keys + KEYS - 1) / KEYS, WGS);
    auto place_of_keys = [](int tile) { return tile / WGS * 2 * WGS + tile % WGS; };

    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        if (threadIdx.x == THREADS) {
            auto load_tile = [&](const TensorMap* map, int first, int tile, int place) {
                if (SHARING == 1) return ring.load_tile(place, map, first + head, group * keys + tile * KEYS);
                ring.claim(place);
                const int part = blockIdx.x % SHARING, from = group * keys + tile * KEYS + part * (KEYS / SHARING);
                for (int p = 0; p < PANELS; ++p)
                    load_into_all(ring.slot(place) + p * KEY_PANEL + part * (KEY_PANEL / SHARING), map, 64 * p,
                                  first + head, from, ring.full(place));
            };
            if (WHOLE) asm volatile("griddepcontrol.wait;" ::: "memory");
            barrier_expect(q_full, Q_BYTES);
            for (int p = 0; p < PANELS; ++p)
                load(base + p * Q_PANEL, &map_q, 64 * p, head, group * rows + row, q_full);
            for (int tile = 0; tile < early; ++tile) load_tile(&map_k, k_first, tile, place_of_keys(tile));
            const int valid = WHOLE ? WGS * KEYS : length ? (int)*length : keys;
            const int last = (valid + KEYS - 1) / KEYS;
#pragma unroll 1
            for (int round = 0; round < last; round += WGS) {
                const int end = min(round + WGS, last);
                for (int tile = max(round, early); tile < end; ++tile)
                    load_tile(&map_k, k_first, tile, place_of_keys(tile));
                for (int tile = round; tile < end; ++tile)
                    load_tile(&map_v, v_first, tile, place_of_keys(tile) + WGS);
            }
        }
    } else {
        asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
        const int own = threadIdx.x % 128, warp = own / 32;
        const int valid = WHOLE ? WGS * KEYS : length ? (int)*length : keys;
        const int last = (valid + KEYS - 1) / KEYS;
        float logits[KEYS / 2], sums[DIM / 2] = {};  // of the values, by weight
        u32 weights[KEYS / 4];
        Softmax softmax{scale};
        auto await_tile = [&](int place) {
            if (WHOLE) __builtin_assume(place < STAGES);
            return ring.await(place);
        };
        // the tile's logits become weights, the sums follow the new top; values beyond the length become 0
        auto weigh = [&](int tile, u32 values) {
            const int left = valid - tile * KEYS;
            if (!WHOLE && left < KEYS) hide(logits, left);
            const float2 shrink = softmax.weigh(logits);
            round_weights(logits, weights);
            if (!WHOLE) shrink_sums(sums, shrink);  // hidden behind the powers of two: no vote
            if (!WHOLE && left < KEYS) {
                clear_rows(values, left, 128);
                show_to_products(2 + warpgroup, 128);
            }
        };

        barrier_wait(q_full, 0);
        int tile = warpgroup, place = place_of_keys(tile);
        if (WHOLE || tile < early) {  // also where the length ends before it: its place is used again in the end
            const u32 first = await_tile(place);
            begin_products();
            multiply_keys<Q_PANEL>(logits, base, first);
            await_products<0>();
            ring.release(place);
        }
        if (WHOLE || tile < last) {
            for (; !WHOLE && tile + WGS < last; tile += WGS, place += 2 * WGS) {
                const u32 values = await_tile(place + WGS);
                weigh(tile, values);
                const u32 next = await_tile(place + 2 * WGS);
                begin_products();
                multiply_values(sums, weights, values);
                multiply_keys<Q_PANEL>(logits, base, next);
                await_products<0>();
                ring.release(place + WGS);
                ring.release(place + 2 * WGS);
            }
            const u32 values = await_tile(place + WGS);
            weigh(tile, values);
            begin_products();
            multiply_values(sums, weights, values);
            await_products<0>();
        }
        softmax.end();

#if TP_WGS == 2
        // the other's sums of this warpgroup's columns, by block and thread; behind them its tops and totals
        constexpr int MOST = (FOURS + 1) / 2 * 4 * 2048, SHARE = MOST + 2048;
        static_assert(2 * SHARE <= Q_BYTES + STAGES * STAGE_BYTES, "no room for the other's sums");
        char* const shared = raw + (base - shared_address(raw));
        sync_consumers(1, THREADS);  // nobody reads tiles any more
#pragma unroll
        for (int to = 0; to < 2; ++to) {
            if (to == warpgroup) continue;
            float4* const there = (float4*)(shared + to * SHARE) + own;
            int count = 0;
#pragma unroll
            for (int j = 0; j < BLOCKS; ++j)
                if (owner(j) == to)
                    there[128 * count++] = make_float4(sums[4 * j], sums[4 * j + 1], sums[4 * j + 2], sums[4 * j + 3]);
            there[MOST / 16] = make_float4(softmax.top[0], softmax.top[1], softmax.total[0], softmax.total[1]);
        }
        sync_consumers(1, THREADS);
        const float4* const received = (const float4*)(shared + warpgroup * SHARE) + own;
        const float4 other = received[MOST / 16];
        float mine[2], theirs[2];
#pragma unroll
        for (int half = 0; half < 2; ++half) {  // who had no keys counts for nothing: its top is LOWEST
            const float top = softmax.top[half], other_top = half ? other.y : other.x, best = fmaxf(top, other_top);
            mine[half] = power_of_two(top - best);
            theirs[half] = power_of_two(other_top - best);
            softmax.total[half] = softmax.total[half] * mine[half] + (half ? other.w : other.z) * theirs[half];
        }
#pragma unroll
        for (int who = 0; who < 2; ++who) {
            if (who != warpgroup) continue;
            int count = 0;
#pragma unroll
            for (int j = 0; j < BLOCKS; ++j) {
                if (owner(j) != who) continue;
                const float4 x = received[128 * count++];
                sums[4 * j] = sums[4 * j] * mine[0] + x.x * theirs[0];
                sums[4 * j + 1] = sums[4 * j + 1] * mine[0] + x.y * theirs[0];
                sums[4 * j + 2] = sums[4 * j + 2] * mine[1] + x.z * theirs[1];
                sums[4 * j + 3] = sums[4 * j + 3] * mine[1] + x.w * theirs[1];
            }
        }
#endif

        const int at = row + warp * 16;
        store_rows(sums, softmax.total, inverse, out + ((size_t)(group * rows + at) * heads + head) * DIM, (size_t)heads * DIM,
                   rows - at, [&](int block) { return owner(block) == warpgroup; }, MARKS(group * rows + at));
    }
    if (SHARING > 1) cluster_sync();  // what this CTA loads for the others may still be on its way
}
