// Attention of a batch's suffixes, as suffix.cu's, where few clusters have all rows. Such a call waits for its delays and its
// instructions, not for the tensor cores or memory. So TP_WGS warpgroups share each block of 64 rows and each thread has
// few instructions; two warpgroups leave half of a multiprocessor's registers, and the CTAs of the kernels in front and
// behind may start beside. suffix.py sets the TP_ constants.
//
// qkv [batch * tokens, (heads + 2) * DIM] are queries, key and value of each token, to which RoPE comes here; a row is a
// head of a token. TP_ROWS rows of one observation belong to a cluster of TP_RANKS CTAs, each of which attends with all
// of them to its share of the keys: of the prefix's, which TMA brings before the kernel in front has ended, and behind
// them of the suffix's own. Of a block's logits each warpgroup has those of TP_PART keys of a tile, and of its results
// TP_COLUMNS columns; weights pass through shared memory. Then each rank gets from all ranks what they have of every
// TP_RANKS-th row, over its total and in bfloat16, with the row's largest logit and total, and adds them up.

constexpr int BLOCK_ROWS = (ROWS + 63) / 64 * 64, MEMBERS = 64 * WGS / BLOCK_ROWS;  // MEMBERS: warpgroups of a block
constexpr int PART = TP_PART, COLUMNS = TP_COLUMNS;
constexpr int ROW_PANEL = ROWS * ROW_BYTES, Q_BYTES = PANELS * ROW_PANEL;  // products read beyond them: rows of nobody
constexpr int W_BYTES = (KEYS + 63) / 64 * ROW_PANEL + BLOCK_ROWS * ROW_BYTES - ROW_PANEL;
constexpr int SLOTS = (ROWS + RANKS - 1) / RANKS, MAIL_BYTES = RANKS * SLOTS * DIM * 2;
static_assert(ROWS % 8 == 0 && MEMBERS >= 1 && BLOCK_ROWS * MEMBERS == 64 * WGS, "blocks of as many warpgroups each");
static_assert(DIM % 64 == 0 && RANKS <= 8 && DEPTH % 4 == 0, "whole panels");
static_assert(PART % 8 == 0 && MEMBERS * PART >= KEYS, "all keys of a tile belong to a warpgroup");
static_assert(COLUMNS % 64 == 0 && MEMBERS * COLUMNS >= DIM, "all columns belong to one");
static_assert(MAIL_BYTES <= STAGE_BYTES, "what is sent lies where keys were");
constexpr int BESIDE = 16;  // rows of the suffix's keys and values that are loaded beside the queries
constexpr int ITEMS = ((ROWS + BESIDE) * CHUNKS + THREADS - 1) / THREADS;
constexpr int VALUES = (BESIDE * DIM / 8 + THREADS - 1) / THREADS;

extern "C" __global__ void __launch_bounds__(THREADS, 512 / THREADS)
attention(SUFFIX_PARAMETERS) {
    extern __shared__ char raw[];
    const u32 keys = (shared_address(raw) + 1023) / 1024 * 1024, values = keys + STAGE_BYTES;
    const u32 queries = values + STAGE_BYTES, weights = queries + Q_BYTES, barriers = weights + W_BYTES;
    const u32 mail_full = barriers, full = barriers + 8, mail = keys;
    auto array = [&](u32 address) { return raw + (address - shared_address(raw)); };
    float(*const row_tops)[BLOCK_ROWS] = (float(*)[BLOCK_ROWS])array(barriers + 16);
    float(*const row_totals)[BLOCK_ROWS] = row_tops + MEMBERS;
    const u32 ends = barriers + 16 + 2 * MEMBERS * BLOCK_ROWS * 4;
    const int warpgroup = __shfl_sync(~0u, threadIdx.x / 128, 0);  // the same for all, as the compiler now sees
    const int block = warpgroup / MEMBERS, member = warpgroup % MEMBERS;
    const int warp = threadIdx.x / 32 % 4, lane = threadIdx.x % 32;
    const int rank = blockIdx.x % RANKS, unit = blockIdx.x / RANKS, batch = quotient(unit, tiles);
    const int first_row = (unit - batch * tiles) * ROWS, count = min(ROWS, tokens * heads - first_row);
    const int mine = (count - rank + RANKS - 1) / RANKS;  // rows that this rank adds up

    // its share of the keys: those from `length` on are the suffix's
    const int begin = starts[batch], length = lengths[batch], share = (length + tokens + RANKS - 1) / RANKS;
    const int from = min(rank * share, length + tokens), valid = min(share, length + tokens - from);
    const int last = (valid + KEYS - 1) / KEYS;
    auto load_tile = [&](int tile) {
        barrier_expect(full, 2 * STAGE_BYTES);
#pragma unroll 1
        for (int p = 0; p < 2 * PANELS; ++p)
            load(keys + p * KEY_PANEL, p < PANELS ? &map_k : &map_v, p % PANELS * 64, 0, begin + from + tile * KEYS, full);
    };
    if (threadIdx.x == 0) {
        barrier_init(mail_full, 1), barrier_init(full, 1);
        asm volatile("fence.mbarrier_init.release.cluster;" ::: "memory");
        barrier_expect(mail_full, mine * RANKS * (2 * DIM + 8));
        if (last > 0) load_tile(0);
    }
    __syncthreads();
    cluster_arrive();
    asm volatile("griddepcontrol.launch_dependents;" ::: "memory");

    const int width = (heads + 2) * DIM;
    const u16* const of_batch = qkv + (size_t)batch * tokens * width;
    const float *const cosines = cos + batch * tokens * HALF, *const sines = sin + batch * tokens * HALF;
    // The suffix's keys and values of a tile: as many, its first row, and the token that has it.
    struct Own { int found, first, token; };
    auto own_of = [&](int tile) {
        const int here = from + tile * KEYS, first = max(here, length) - here;
        return Own{max(0, min(KEYS, valid - tile * KEYS) - first), first, here + first - length};
    };
    auto key_of = [&](int token) { return of_batch + (size_t)token * width + heads * DIM; };
    const Own own = own_of(0);
    if (last > 0) {
        barrier_wait(full, 0);
        if (valid < KEYS) clear_rows(values, valid, THREADS);
    }
    cluster_wait();  // all ranks have begun

    asm volatile("griddepcontrol.wait;" ::: "memory");

    // Rows of queries, and behind them BESIDE of the first tile's keys: all are loaded before the first is turned.
    struct Item { int row, c, token; bool there; };
    auto item = [&](int k) {
        const int i = k * THREADS + threadIdx.x, row = i / CHUNKS;
        if (row >= ROWS) return Item{row, i % CHUNKS, own.token + row - ROWS, row - ROWS < own.found};
        return Item{row, i % CHUNKS, quotient(first_row + row, heads), row < count};
    };
    Turn turns[ITEMS];
    uint4 loaded[VALUES];
#pragma unroll
    for (int k = 0; k < ITEMS; ++k) {
        const Item one = item(k);
        const int head = one.row < ROWS ? first_row + one.row - one.token * heads : heads;
        if (one.there) turns[k].load(of_batch + (size_t)one.token * width + head * DIM, one.c);
    }
#pragma unroll
    for (int k = 0; k < VALUES; ++k) {
        const int i = k * THREADS + threadIdx.x, row = i / (DIM / 8);
        if (row < min(own.found, BESIDE)) loaded[k] = *(const uint4*)(key_of(own.token + row) + DIM + i % (DIM / 8) * 8);
    }

#pragma unroll
    for (int k = 0; k < ITEMS; ++k) {
        const Item one = item(k);
        const bool query = one.row < ROWS;
        if (!one.there) continue;
        turns[k].load_angles(cosines + one.token * HALF, sines + one.token * HALF, one.c);
        turns[k].put_turned(query ? queries : keys, query ? ROW_PANEL : KEY_PANEL, query ? one.row : own.first + one.row - ROWS,
                            one.c);
    }
#pragma unroll
    for (int k = 0; k < VALUES; ++k) {
        const int i = k * THREADS + threadIdx.x, row = i / (DIM / 8);
        if (row < min(own.found, BESIDE)) put(place_of(values, KEY_PANEL, own.first + row, i % (DIM / 8) * 8), loaded[k]);
    }

    float sums[COLUMNS / 2] = {}, top[2] = {LOWEST, LOWEST}, total[2] = {};
    const int row = 64 * block + 16 * warp + lane / 4;  // the lane's first one; the second one is 8 further
    const int first_key = member * PART + lane % 4 * 2;
#pragma unroll 1
    for (int tile = 0; tile < last; ++tile) {
        const int here = from + tile * KEYS, seen = min(KEYS, valid - tile * KEYS), done = tile == 0 ? BESIDE : 0;
        if (tile > 0) {  // seldom: nothing is gained by loading ahead
            __syncthreads();
            if (threadIdx.x == 0) load_tile(tile);
            barrier_wait(full, tile & 1);
            if (seen < KEYS) clear_rows(values, seen, THREADS);
        }
        if (const Own own = own_of(tile); own.found > done) {
#pragma unroll 1
            for (int i = done * CHUNKS + threadIdx.x; i < own.found * CHUNKS; i += THREADS) {
                const int token = own.token + i / CHUNKS;
                Turn turn;
                turn.load(key_of(token), i % CHUNKS);
                turn.load_angles(cosines + token * HALF, sines + token * HALF, i % CHUNKS);
                turn.put_turned(keys, KEY_PANEL, own.first + i / CHUNKS, i % CHUNKS);
            }
#pragma unroll 1
            for (int i = done * (DIM / 8) + threadIdx.x; i < own.found * (DIM / 8); i += THREADS) {
                const int at = i / (DIM / 8), column = i % (DIM / 8) * 8;
                put(place_of(values, KEY_PANEL, own.first + at, column), *(const uint4*)(key_of(own.token + at) + DIM + column));
            }
        }
        asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
        __syncthreads();

        float logits[PART / 2];
        {
            const u64 a = operand(queries + 64 * ROW_BYTES * block), b = operand(keys + member * PART * ROW_BYTES);
            begin_products();
#pragma unroll
            for (int k = 0; k < DEPTH; ++k)
                mma_part(logits, a + (k / 4 * ROW_PANEL + k % 4 * 32) / 16, b + (k / 4 * KEY_PANEL + k % 4 * 32) / 16, k > 0);
            commit_products();
            await_products<0>();
            settle(logits);
        }

        float best[2] = {NONE, NONE};
#pragma unroll
        for (int i = 0; i < PART / 2; ++i) {
            const int half = i / 2 % 2, key = first_key + i / 4 * 8 + i % 2;
            const bool of_state = state_token && first_row + row + 8 * half < heads;  // sees no other key of the suffix
            if (key >= seen || (of_state && here + key > length)) logits[i] = NONE;
            best[half] = fmaxf(best[half], logits[i]);
        }
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            best[half] = largest_of_quad(best[half]);
            if (lane % 4 == 0) row_tops[member][row + 8 * half] = best[half];
        }
        __syncthreads();
        if (tile == last - 1) cluster_arrive();  // keys aren't needed any more: what read them has ended
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            const int at = row + 8 * half;
            float largest = NONE;
#pragma unroll
            for (int m = 0; m < MEMBERS; ++m) largest = fmaxf(largest, row_tops[m][at]);
            const float before = top[half];
            top[half] = fmaxf(before, largest * scale);
            const float shrink = power_of_two(before - top[half]);
            total[half] *= shrink;
            if (tile > 0) {
#pragma unroll
                for (int i = 0; i < COLUMNS / 2; ++i)
                    if (i / 2 % 2 == half) sums[i] *= shrink;
            }
#pragma unroll
            for (int i = 2 * half; i < PART / 2; i += 4) {
                const float x = power_of_two(fmaf(logits[i], scale, -top[half]));
                const float y = power_of_two(fmaf(logits[i + 1], scale, -top[half]));
                const int key = first_key + i / 4 * 8;
                total[half] += x + y;
                if (key < KEYS && at < ROWS)
                    asm volatile("st.shared.u32 [%0], %1;"
                                 ::"r"(place_of(weights, ROW_PANEL, at, key) + lane % 4 * 4), "r"(pack(x, y)) : "memory");
            }
            const float whole = sum_of_quad(total[half]);
            if (lane % 4 == 0) row_totals[member][at] = whole;
        }
        asm volatile("fence.proxy.async.shared::cta;" ::: "memory");
        __syncthreads();

        if (member * COLUMNS < DIM) {
            const u64 a = operand(weights + 64 * ROW_BYTES * block);
            const u64 b = operand_across(values + member * (COLUMNS / 64) * KEY_PANEL);
            begin_products();
#pragma unroll
            for (int k = 0; k < KEYS / 16; ++k)
                mma_columns(sums, a + (k / 4 * ROW_PANEL + k % 4 * 32) / 16, b + k * ROW_BYTES, 1);
            commit_products();
            await_products<0>();
            settle(sums);
        }
    }
    if (last == 0) cluster_arrive();
    cluster_wait();  // no rank needs its keys any more

    if (member * COLUMNS < DIM) {
#pragma unroll
        for (int half = 0; half < 2; ++half) {
            const int at = row + 8 * half, to = at % RANKS, slot = rank * SLOTS + at / RANKS;
            float whole = 0;
#pragma unroll
            for (int m = 0; m < MEMBERS; ++m) whole += last > 0 ? row_totals[m][at] : 0.0f;
            const float factor = whole > 0 ? inverse_of(whole) : whole;
            const u32 there = at_rank(mail + slot * DIM * 2, to), bar = at_rank(mail_full, to);
            auto value = [&](int j) { return pack(sums[4 * j + 2 * half] * factor, sums[4 * j + 2 * half + 1] * factor); };
#pragma unroll
            for (int j = 0; j < COLUMNS / 8; j += 4) {
                if (member * COLUMNS + 8 * j >= DIM) break;
                const uint4 v = transpose_quad(value(j), value(j + 1), value(j + 2), value(j + 3), lane);
                if (at < count)
                    send(there + (member * (COLUMNS / 8) + j + lane % 4) * 16,
                         make_float4(__uint_as_float(v.x), __uint_as_float(v.y), __uint_as_float(v.z), __uint_as_float(v.w)),
                         bar);
            }
            if (at < count && member == 0 && lane % 4 == 0) send_end(at_rank(ends + slot * 8, to), top[half], whole, bar);
        }
    }

    barrier_wait(mail_full, 0);

    for (int i = threadIdx.x; i < mine * (DIM / 8); i += THREADS) {
        const int slot = i / (DIM / 8), column = i % (DIM / 8) * 8;
        add_ranks(out + ((size_t)batch * tokens * heads + first_row + rank + slot * RANKS) * DIM + column,
                  array(mail + (slot * DIM + column) * 2), SLOTS * DIM * 2, (const float2*)array(ends) + slot, SLOTS, inverse);
    }
}
