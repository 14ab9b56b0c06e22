// Attention as narrow.cu has it, for many rows: each of TP_WGS consumer warpgroups has 64 rows of q of its own, and all of
// them take every tile of keys and of values. A CTA goes from one `unit` of 64 * TP_WGS rows to the next, while the
// producer loads what comes then; TP_QUERIES units' q have room.
//
// A warpgroup weighs a tile's logits while its values of the tile before are multiplied, and asks for logits ahead of
// values, so that the tensor cores have work meanwhile.
//
// Three warpgroups' units seldom divide a group's rows: whole units come first, then those that the last rows fill in part,
// whose other warpgroups multiply nothing. CTAs go through them in turns forth and back, so that who has had fewer whole ones
// takes more of the rest.
//
// TP_PACKED: entries of `segments` are for 64 rows; a unit goes by its first, even one, whose segment is the next one's,
// too: see `kernels.interface.Segments`.

constexpr bool PACKED = TP_PACKED;
constexpr int ROWS = 64 * WGS, QUERIES = TP_QUERIES;
constexpr int Q_PANEL = 64 * ROW_BYTES, Q_BYTES = PANELS * Q_PANEL;  // of a warpgroup
static_assert(STAGES >= 2, "a tile of keys and one of values");
// Found by compiling: where a thread has more of them, they spill, and ptxas makes products wait for each other.
static_assert(DIM / 2 + KEYS / 2 + KEYS / 4 <= CONSUMER_REGISTERS - 28, "sums, logits and weights stay in registers");
static_assert(!PACKED || WGS == 2, "packed rows come in pairs of 64");

struct Unit {
    int group, head, row, end_of_rows, first_key, keys;  // rows and keys in the group
};

extern "C" __global__ void __launch_bounds__(THREADS + 128, 1)
attention(ATTENTION_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024;
    const Ring ring{base + QUERIES * WGS * Q_BYTES};
    const u32 q_full = ring.slots + Ring::BYTES, q_empty = q_full + 8 * QUERIES;
    const int warpgroup = __shfl_sync(~0u, threadIdx.x / 128, 0);  // the same for all, as the compiler now sees

    if (threadIdx.x == THREADS) {
        asm volatile("prefetch.tensormap [%0];\nprefetch.tensormap [%1];\nprefetch.tensormap [%2];"
                     ::"l"(&map_q), "l"(&map_k), "l"(&map_v));
    }
    if (threadIdx.x == 0) {
        ring.init(WGS);
        for (int s = 0; s < QUERIES; ++s) barrier_init(q_full + 8 * s, 1), barrier_init(q_empty + 8 * s, WGS);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
    }
    __syncthreads();
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");
    asm volatile("griddepcontrol.wait;" ::: "memory");

    auto next_of = [&](int number) {  // the unit behind one that this CTA has done
        if (WGS != 3) return number + (int)gridDim.x;
        const int round = quotient(number, gridDim.x) + 1;
        return round * (int)gridDim.x + (round & 1 ? (int)gridDim.x - 1 - (int)blockIdx.x : (int)blockIdx.x);
    };
    auto unit_of = [&](int number) {
        if (WGS == 3) {
            const int whole = quotient(rows, ROWS), behind = number - quotient(units, tiles) * whole;
            const int series = behind < 0 ? quotient(number, whole) : behind;
            number = series * tiles + (behind < 0 ? number - series * whole : whole);
        }
        const int series = quotient(number, tiles), group = quotient(series, heads), head = series - group * heads;
        if (!PACKED) return Unit{group, head, (number - series * tiles) * ROWS, rows, 0, keys};
        const int4 segment = segments[2 * number];
        return Unit{group, head, segment.x, segment.y, segment.z, segment.w};
    };

    // Tiles pass through the ring in pairs: keys, then their values.
    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        if (threadIdx.x != THREADS) return;
        u32 place = 0, turn = 0;
#pragma unroll 1
        for (int number = blockIdx.x; number < units; number = next_of(number)) {
            const Unit unit = unit_of(number);
            if (unit.row >= unit.end_of_rows) continue;
            const u32 slot = turn % QUERIES;
            if (turn >= QUERIES) barrier_wait(q_empty + 8 * slot, (turn / QUERIES + 1) & 1);
            barrier_expect(q_full + 8 * slot, WGS * Q_BYTES);
            for (int w = 0; w < WGS; ++w)
                for (int p = 0; p < PANELS; ++p)
                    load(base + (slot * WGS + w) * Q_BYTES + p * Q_PANEL, &map_q, 64 * p, unit.head,
                         unit.group * rows + unit.row + 64 * w, q_full + 8 * slot);
            ++turn;
#pragma unroll 1
            for (int from = 0; from < unit.keys; from += KEYS)
#pragma unroll 1
                for (int values = 0; values < 2; ++values, ++place)
                    ring.load_tile(place, values ? &map_v : &map_k, (values ? v_first : k_first) + unit.head,
                                   unit.group * keys + unit.first_key + from);
        }
        return;
    }

    asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
    const int own = threadIdx.x % 128, warp = own / 32;
    u32 place = 0, turn = 0;
#pragma unroll 1
    for (int number = blockIdx.x; number < units; number = next_of(number)) {
        const Unit unit = unit_of(number);
        if (unit.row >= unit.end_of_rows) continue;
        const u32 slot = turn % QUERIES, queries = base + (slot * WGS + warpgroup) * Q_BYTES;
        float logits[KEYS / 2], sums[DIM / 2] = {};
        u32 weights[KEYS / 4];
        Softmax softmax{scale};

        barrier_wait(q_full + 8 * slot, (turn / QUERIES) & 1);
        if (WGS == 3 && unit.row + 64 * warpgroup >= unit.end_of_rows) {  // others' rows are the last ones
            if (own == 0) barrier_arrive(q_empty + 8 * slot);
            for (int left = unit.keys; left > 0; left -= KEYS)
                for (int values = 0; values < 2; ++values, ++place) {
                    const u32 tile = ring.await(place);
                    if (values && left < KEYS) {
                        clear_rows(tile, left, THREADS);
                        show_to_products(1, THREADS);
                    }
                    ring.release(place);
                }
            ++turn;
            continue;
        }
        const u32 first = ring.await(place);
        begin_products();
        multiply_keys<Q_PANEL>(logits, queries, first);
        await_products<0>();
        settle(logits);
        ring.release(place);
        int left = unit.keys;  // keys from this tile on
        if (left < KEYS) hide(logits, left);
        softmax.weigh(logits);
        round_weights(logits, weights);
#pragma unroll 1
        for (; left > KEYS; left -= KEYS, place += 2) {
            const u32 keys = ring.await(place + 2), values = ring.await(place + 1);
            begin_products();
            multiply_keys<Q_PANEL>(logits, queries, keys);
            multiply_values(sums, weights, values);
            await_products<1>();
            settle(logits);
            ring.release(place + 2);
            if (left < 2 * KEYS) hide(logits, left - KEYS);
            const float2 shrink = softmax.weigh(logits);
            const bool shrinks = any_shrinks(shrink);
            // ptxas moves a wait in front of arithmetic that doesn't need it, but not out of a branch. Of four warpgroups
            // others multiply meanwhile, and are the sooner for it: 18 us of vision's attention became 21.
            if (WGS == 4 || shrinks) await_products<0>();
            else await_products<0>();
            settle(sums);
            ring.release(place + 1);
            round_weights(logits, weights);
            if (shrinks) shrink_sums(sums, shrink);
        }
        if (own == 0) barrier_arrive(q_empty + 8 * slot);
        const u32 values = ring.await(place + 1);
        if (left < KEYS) {
            clear_rows(values, left, THREADS);
            show_to_products(1, THREADS);
        }
        begin_products();
        multiply_values(sums, weights, values);
        await_products<0>();
        settle(sums);
        ring.release(place + 1);
        place += 2;
        ++turn;
        softmax.end();
        const int at = unit.row + 64 * warpgroup + 16 * warp;
        store_rows(sums, softmax.total, inverse, out + ((size_t)(unit.group * rows + at) * heads + unit.head) * DIM,
                   (size_t)heads * DIM, unit.end_of_rows - at, [](int) { return true; }, MARKS(unit.group * rows + at));
    }
}
