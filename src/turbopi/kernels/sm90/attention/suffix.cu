// Attention of a batch's suffixes: the tokens of an observation over its prefix's keys and each other's. suffix.py sets the
// TP_ constants.
//
// qkv [batch * tokens, (heads + 2) * DIM] are queries, key and value of each token, to which RoPE comes here; a row is a
// head of a token. TP_ROWS rows of one observation belong to a cluster of TP_RANKS CTAs, each of which attends with all
// of them to its share of the keys: of the prefix's, which TMA brings before the kernel in front has ended, and behind
// them of the suffix's own. Then each rank gets from all ranks what they have of its DIM / TP_RANKS columns, every row
// over its total and in bfloat16, with the row's largest logit and total, and adds them up.

constexpr int COLUMNS = DIM / RANKS;
constexpr int Q_PANEL = ROWS * ROW_BYTES, Q_BYTES = PANELS * Q_PANEL;  // a warpgroup may read beyond them: rows of nobody
constexpr int MAIL_BYTES = RANKS * ROWS * COLUMNS * 2, ENDS_BYTES = RANKS * ROWS * 8;
static_assert(WGS <= 2 && ROWS % 8 == 0 && 64 * (WGS - 1) < ROWS && ROWS <= 64 * WGS, "rows of so many warpgroups");
static_assert(DIM % 64 == 0 && COLUMNS % 8 == 0 && RANKS <= 8, "16 bytes of a row go to one rank");
static_assert(STAGES >= 2, "a tile of keys and one of values");

extern "C" __global__ void __launch_bounds__(THREADS + 128, 1)
attention(SUFFIX_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 base = (shared_address(raw) + 1023) / 1024 * 1024;
    const Ring ring{base + Q_BYTES};
    const u32 mail = ring.slots + Ring::BYTES, ends = mail + MAIL_BYTES, mail_full = ends + ENDS_BYTES;
    const int warpgroup = __shfl_sync(~0u, threadIdx.x / 128, 0);  // the same for all, as the compiler now sees
    const int rank = blockIdx.x % RANKS, unit = blockIdx.x / RANKS, batch = unit / tiles;
    const int first_row = (unit - batch * tiles) * ROWS, count = min(ROWS, tokens * heads - first_row);

    if (threadIdx.x == 0) {
        barrier_init(mail_full, 1);
        ring.init(WGS);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
        barrier_expect(mail_full, RANKS * count * (2 * COLUMNS + 8));
    }
    cluster_sync();
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");

    // its share of the keys: those from `length` on are the suffix's
    const int begin = starts[batch], length = lengths[batch], share = (length + tokens + RANKS - 1) / RANKS;
    const int from = min(rank * share, length + tokens), valid = min(share, length + tokens - from);
    const int last = (valid + KEYS - 1) / KEYS;

    // Tiles pass through the ring in pairs: keys, then their values.
    if (warpgroup == WGS) {
        asm volatile("setmaxnreg.dec.sync.aligned.u32 %0;" ::"n"(PRODUCER_REGISTERS));
        if (threadIdx.x == THREADS) {
#pragma unroll 1
            for (int place = 0; place < 2 * last; ++place)
                ring.load_tile(place, place % 2 ? &map_v : &map_k, 0, begin + from + place / 2 * KEYS);
        }
        return;
    }

    asm volatile("setmaxnreg.inc.sync.aligned.u32 %0;" ::"n"(CONSUMER_REGISTERS));
    const int own = threadIdx.x % 128, warp = own / 32, lane = own % 32, width = (heads + 2) * DIM;
    asm volatile("griddepcontrol.wait;" ::: "memory");
    const u16* const of_batch = qkv + (size_t)batch * tokens * width;
    const float *const cosines = cos + batch * tokens * HALF, *const sines = sin + batch * tokens * HALF;
    constexpr int AT_ONCE = 5;  // loads of so many chunks are on their way together
#pragma unroll
    for (int first = 0; first < (ROWS * CHUNKS + THREADS - 1) / THREADS; first += AT_ONCE) {
        Turn turns[AT_ONCE];
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const int i = (first + k) * THREADS + threadIdx.x, row = i / CHUNKS, token = quotient(first_row + row, heads);
            if (row < count) {
                turns[k].load(of_batch + (size_t)token * width + (first_row + row - token * heads) * DIM, i % CHUNKS);
                turns[k].load_angles(cosines + token * HALF, sines + token * HALF, i % CHUNKS);
            }
        }
#pragma unroll
        for (int k = 0; k < AT_ONCE; ++k) {
            const int i = (first + k) * THREADS + threadIdx.x;
            if (i / CHUNKS < count) turns[k].put_turned(base, Q_PANEL, i / CHUNKS, i % CHUNKS);
        }
    }

    // Waits for a tile, puts the suffix's keys and values into it and clears what nobody sees. Whether anything was stored.
    auto complete = [&](int tile) {
        const u32 keys = ring.await(2 * tile), values = ring.await(2 * tile + 1);
        const int here = from + tile * KEYS, seen = min(KEYS, valid - tile * KEYS);
        const int first = max(here, length) - here, found = max(0, seen - first);  // the suffix's: those from `first` on
        const u16* const tokens_of = of_batch + (size_t)(here + first - length) * width + heads * DIM;
        for (int i = threadIdx.x; i < found * CHUNKS; i += THREADS) {
            const int token = here + first - length + i / CHUNKS;
            Turn turn;
            turn.load(tokens_of + (size_t)(i / CHUNKS) * width, i % CHUNKS);
            turn.load_angles(cosines + token * HALF, sines + token * HALF, i % CHUNKS);
            turn.put_turned(keys, KEY_PANEL, first + i / CHUNKS, i % CHUNKS);
        }
        for (int i = threadIdx.x; i < found * (DIM / 8); i += THREADS) {
            const int row = i / (DIM / 8), column = i % (DIM / 8) * 8;
            put(place_of(values, KEY_PANEL, first + row, column),
                *(const uint4*)(tokens_of + (size_t)row * width + DIM + column));
        }
        if (seen < KEYS) clear_rows(values, seen, THREADS);
        return found > 0 || seen < KEYS;
    };
    if (last > 0) complete(0);
    show_to_products(1, THREADS);

    float logits[KEYS / 2], sums[DIM / 2] = {};
    u32 weights[KEYS / 4];
    Softmax softmax{scale};
    const u32 queries = base + 64 * ROW_BYTES * warpgroup;
    for (int tile = 0; tile < last; ++tile) {  // few: nothing is gained by weighing one while another multiplies
        if (tile > 0 && complete(tile)) show_to_products(1, THREADS);
        const u32 keys = ring.await(2 * tile), values = ring.await(2 * tile + 1);
        begin_products();
        multiply_keys<Q_PANEL>(logits, queries, keys);
        await_products<0>();
        settle(logits);
        ring.release(2 * tile);
        const int left = valid - tile * KEYS;
        if (left < KEYS) hide(logits, left);
        if (state_token && first_row + 64 * warpgroup < heads) {  // whose rows see no other key of the suffix
            const int seen = length + 1 - from - tile * KEYS;
#pragma unroll
            for (int i = 0; i < KEYS / 2; ++i) {
                const int row = first_row + 64 * warpgroup + 16 * warp + lane / 4 + i / 2 % 2 * 8;
                if (row < heads && i / 4 * 8 + lane % 4 * 2 + i % 2 >= seen) logits[i] = NONE;
            }
        }
        const float2 shrink = softmax.weigh(logits);
        if (tile > 0 && any_shrinks(shrink)) shrink_sums(sums, shrink);
        round_weights(logits, weights);
        begin_products();
        multiply_values(sums, weights, values);
        await_products<0>();
        settle(sums);
        ring.release(2 * tile + 1);
    }
    softmax.end();

#pragma unroll
    for (int half = 0; half < 2; ++half) {
        const int row = 64 * warpgroup + 16 * warp + lane / 4 + 8 * half;
        const float total = softmax.total[half], factor = total > 0 ? inverse_of(total) : total;
        auto value = [&](int j) { return pack(sums[4 * j + 2 * half] * factor, sums[4 * j + 2 * half + 1] * factor); };
#pragma unroll
        for (int j = 0; j < BLOCKS; j += 4) {
            const uint4 v = transpose_quad(value(j), value(j + 1), value(j + 2), value(j + 3), lane);
            const int column = (j + lane % 4) * 8, to = column / COLUMNS;
            if (row < count)
                send(at_rank(mail + ((rank * ROWS + row) * COLUMNS + column % COLUMNS) * 2, to),
                     make_float4(__uint_as_float(v.x), __uint_as_float(v.y), __uint_as_float(v.z), __uint_as_float(v.w)),
                     at_rank(mail_full, to));
        }
        for (int to = lane % 4; to < RANKS; to += 4)
            if (row < count)
                send_end(at_rank(ends + (rank * ROWS + row) * 8, to), softmax.top[half], total, at_rank(mail_full, to));
    }
    barrier_wait(mail_full, 0);
    const char* const received = raw + (mail - shared_address(raw));
    for (int i = threadIdx.x; i < count * (COLUMNS / 8); i += THREADS) {
        const int row = i / (COLUMNS / 8), column = i % (COLUMNS / 8) * 8;
        add_ranks(out + ((size_t)batch * tokens * heads + first_row + row) * DIM + rank * COLUMNS + column,
                  received + (row * COLUMNS + column) * 2, ROWS * COLUMNS * 2, (const float2*)(received + MAIL_BYTES) + row,
                  ROWS, inverse);
    }
}
