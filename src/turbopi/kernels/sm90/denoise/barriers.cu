// Every barrier: who arrives, how often, how many bytes, who waits in which phase, what it protects.
//
// tests/test_kernels_barriers.py reads these tables and the code, and fails where they differ: a barrier, an arrival or a
// wait that only one of them has, another count, other bytes. So change both: counts are set by `barrier_init` in
// kernel.cu and many/loop.cu. A line that the test's planted faults quote changes there, too. "few/" and "many/" are the
// two forms' folders; "gather ×2" stands twice in `gather`. Warps: 0-15 multiply, 16 loads (Producer), 17 watches, 18
// makes 1 / rms, 19 helps (many: fetches the stream).
//
// ---- mbarriers, in shared memory at M_BAR
//
// count    arrivals that end a phase. A barrier with bytes has one of them for the thread that arms it (`barrier_expect`)
// bytes    that must land, too, before the phase ends; thread 0 arms the next phase behind its wait (`receive`)
// arrives  functions that arrive, or send or copy bytes that count
// waits    functions that wait, with the number of the phase: its lowest bit is the parity
//
// BAR_X: the stream has landed in region X, twice a layer
//   count    1
//   bytes    X_EXPECT = few D16 * T * (OPERAND / 8) + SQUARES_EXPECT, many D16 * NT * 8 * (OPERAND / 8)
//   arrives  few/gather ×2; few/Embedding::send ×2; many/fetch_stream
//   waits    few/receive_stream(half); few/await_squares(use & 1); many/receive_stream(half)
//   who      few: warps 0-15 of all ranks send, with sums of squares; many: warp 19 of each rank, one multicast each
//   to       warps 0-15; few: 18, too
//   guards   region X and, few, M_SSQ: the stream may be multiplied
// BAR_Q: queries, once a layer
//   count    1
//   bytes    Q_EXPECT = few HD * T * 2 + (IDLE_Q ? S * 4 : 0),
//            many HD * (COPY_QUERIES ? NT * 8 : T) * 2 + (IDLE_Q ? S * 4 : 0)
//   arrives  send_queries ×2; many/copy_queries ×2
//   waits    attend_by_warps(b.n) ×2; attend_by_warps(b.n & 1); many/attend_together(b.n); many/attend_together(b.n & 1)
//   who      of all ranks the warps that made queries; COPY_QUERIES: warp 7
//   to       few: warps 0-15; many: 0-7, 12-15
//   guards   M_Q; all ranks have read their sums of q|k|v, so what lies over them may be sent
// BAR_TOPS: what each rank's attention weights go by, once a layer
//   count    1
//   bytes    TOPS_EXPECT = S * ((T + 1) / 2) * 8
//   arrives  weigh_suffix; many/weigh_rows
//   waits    combine(b.n)
//   who      warp 12 of all ranks; ASYNC: 12-15
//   to       warps 0-15
//   guards   X_TOPS
// BAR_COMB: partial outputs and sums of weights, once a layer
//   count    few 1, many ASYNC ? 1 + b.qn() : 1
//   bytes    outputs_expect(b) = few S * ((T + 1) / 2) * 8 + S * b.qn() * ((T + 1) / 2) * (OUTPUT / 4),
//            many S * ((T + 1) / 2) * 8 + (S - ASYNC) * b.qn() * ((T + 1) / 2) * (OUTPUT / 4)
//   arrives  attend_by_warps; send_sums; send_some_sums; many/attend_together ×2
//   waits    combine(b.n)
//   who      of all ranks the warps that weigh values and add up weights; ASYNC: a warp whose columns are this rank's
//            own stores them and arrives
//   to       warps 0-15
//   guards   X_COMB, X_SUMS
// BAR_ATT: attention, once a layer
//   count    1
//   bytes    ATT_EXPECT = few HD * T * (OPERAND / 128) + (IDLE_Q ? S * 4 : 0),
//            many HD * (COPY_ATTENTION ? NT * 8 : T) * (OPERAND / 128) + (IDLE_Q ? S * 4 : 0)
//   arrives  combine; few/AttentionSender::AttentionSender; many/AttentionSender::AttentionSender;
//            many/AttentionSender::end
//   waits    await_operand(b.n)
//   who      of all ranks the warps that combine; COPY_ATTENTION: warp 7
//   to       warps 0-15
//   guards   M_ATT
// BAR_HID: hidden units, once a layer
//   count    1
//   bytes    hidden_bytes(b) = few b.hn() * 16 * T * (OPERAND / 128) + (IDLE ? S * 4 : 0),
//            many COPY_HIDDEN ? HC * NT * OPERAND : b.hn() * 16 * T * (OPERAND / 128) + (IDLE ? S * 4 : 0)
//   arrives  few/gate_up; many/gate_up ×2; send_no_units
//   waits    await_operand(b.n)
//   who      of all ranks the warps that have a tile's sums; COPY_HIDDEN: one of four warps for two tiles
//   to       warps 0-15
//   guards   M_HID
// BAR_V: what ranks add to v_t, once a step
//   count    1
//   bytes    V_EXPECT = few S * T * A * 4 + SQUARES_EXPECT, many S * (V_PARTS * A + 1) * OWN_T * 4
//   arrives  few/send_v; few/advance; many/advance_own
//   waits    few/advance(step); many/advance_own(step)
//   who      warps 0-15 of all ranks, with the last sums of squares
//   to       warps 0-15
//   guards   X_VPART or X_OWN_V; M_SSQ
// BAR_GO: all ranks have read what was added to v_t, once a step; few
//   count    S
//   arrives  few/advance
//   waits    few/advance(step & 1)
//   who      threads 0-7 of each rank, one arrival at each rank
//   to       warps 0-15, before they send the next embedded stream
//   guards   X_VPART, which the next stream overwrites
// BAR_RMS: 1 / rms of all tokens, twice a layer
//   count    1
//   arrives  make_inverse_rms
//   waits    inverse_rms(half)
//   who      warp 18
//   to       the warps that need 1 / rms
//   guards   M_RMS
// BAR_DONE: this CTA is done with region X, twice a layer; many
//   count    W
//   arrives  many/done_with_x
//   waits    many/fetch_stream(uses & 1)
//   who      warps 0-15
//   to       warp 19
//   guards   region X, before the next stream
// BAR_FREE: all ranks are done with region X, twice a layer; many
//   count    S
//   arrives  many/fetch_stream
//   waits    many/fetch_stream(uses & 1)
//   who      warp 19 of each rank
//   to       warp 19
//   guards   region X at all ranks, before the multicast
// BAR_ROOM: all ranks have multiplied the stream, twice a layer; many
//   count    S
//   arrives  many/give_room
//   waits    many/await_room(b.room & 1)
//   who      threads 0-7 of each rank, behind CONSUMERS_MEET
//   to       the warps that send or copy queries or hidden units
//   guards   what lies over the stream: queries, hidden units
// BAR_HERE: this rank's slice of the stream is complete in L2, twice a layer; many
//   count    W
//   arrives  many/await_slice
//   waits    many/fetch_stream(uses++ & 1)
//   who      warps 0-15
//   to       warp 19
//   guards   B_STAGE, before the copy engine reads it
// BAR_SQUARES: sums of squares of all ranks, twice a layer; many. Warp 18 arms it (`await_squares`)
//   count    1
//   bytes    SQUARES_EXPECT = few SQ * ((T + 1) / 2) * 8, many S * NT * 32
//   arrives  many/pass_on_squares
//   waits    many/await_squares(use & 1)
//   who      warp 19 of all ranks
//   to       warp 18
//   guards   M_SSQ
// full: BAR_RING, one a slot of the ring: its weights, keys or values are here
//   count    1
//   bytes    bytes
//   arrives  Producer::run
//   waits    take_slot(b.phase); GroupProduct::from_slots(phase); few/QkvProduct::load(phase)
//   who      the copy engine, for warp 16, which arms the slot
//   to       warps 0-15; in QkvProduct a warp waits for its own slot alone
//   guards   the slot may be read
// empty: BAR_RING, one a slot: all warps have read it
//   count    W
//   arrives  give_slot; give_slot_if
//   waits    Producer::run(free ^ !wrapped); Producer::run(free)
//   who      warps 0-15, once each; QkvProduct: one warp arrives for all of them, at the slots that it doesn't read
//   to       warp 16; the first of its waits holds gate|up back until the keys have been scored
//   guards   the slot may be overwritten
//
// ---- functions that wait or arrive for others, and who calls them with what
//
// receive_stream: few/project(0); few/gate_up(1); many/project(0); many/gate_up(1)
// await_operand: few/consume(half, expect_hidden); many/consume(half, expect_hidden)
// await_squares: make_inverse_rms(use)
// await_slice: many/receive_stream()
// inverse_rms: finish_item(token, 0); few/gate_up(n * 8 + 2 * b.t(), 1); many/gate_up(0, 1); send_no_units(0, 1)
// done_with_x: many/embed_own(); many/consume()
// give_room: many/project(); many/gate_up()
// await_room: many/project(); many/copy_queries(); many/gate_up() ×3
// take_slot: Ahead::Ahead(); GroupProduct::operator(); attend_by_warps() ×5; many/attend_together() ×2; many/weigh_some()
// meet: Own::add_up()
// give_slot_if: GroupProduct::from_slots(previous, another && r > AHEAD)
// send_queries: few/project(staged); many/project(staged)
// copy_queries: many/project()
// pass_on_squares: many/fetch_stream(turn)
// send_squares: few/Embedding::send(x, BAR_X); few/advance(x, BAR_V)
// send_sums: attend_by_warps(tiles, suffix) ×2
// send_some_sums: many/attend_together(b.warp(), tiles, rows)
// send_v: few/advance()
// send_no_units: few/gate_up(); many/gate_up()
//
// ---- barriers of a CTA's warps (bar.sync, bar.arrive): in parentheses how many warps
//
// number   of the barrier; attention's numbers are others' between attentions
// arrives  functions whose warps go on at once
// waits    functions whose warps arrive and wait
//
// CONSUMERS_MEET: all that multiply
//   number   1
//   arrives  few/project(W)
//   waits    begin_trace(W); end_trace(W); few/consume(W); few/project(W) ×4; many/project(W) ×3; attend_by_warps(W);
//            many/attend_together(W); many/AttentionSender::end(W); many/gate_up(W); send_no_units(W); Own::add_up(W) ×2;
//            few/send_v(W); few/advance(W); many/embed_own(W); many/advance_own(W)
//   who      warps 0-15; in few/project 8-15 only arrive where they have no items
//   guards   partial sums, weights, x_t: what stands in front of the call
// TOPS: the prefix's largest logits in M_PART are complete
//   number   2
//   arrives  many/attend_together(SCORERS)
//   waits    weigh_prefix(SCORERS); many/attend_together(SCORERS)
//   who      warps 0-7; ASYNC: those without a tile only arrive
//   guards   M_PART, before weights are made of it
// SUFFIX_SUMS: partial logits of the suffix; not ASYNC
//   number   3
//   arrives  score_suffix(4)
//   waits    score_suffix(4)
//   who      13-15 arrive, 12 waits
//   guards   X_SUFFIX_SUMS
// ROWS_HERE: keys of the suffix and loose keys of the prefix; ASYNC
//   number   3
//   arrives  many/attend_together(W - SCORERS)
//   waits    many/attend_together(W - SCORERS)
//   who      8-11 arrive, 12-15 wait
//   guards   X_KEY_ROWS
// WEIGHTS: the prefix's weights; HOLD
//   number   4
//   arrives  attend_by_warps(SCORERS + 4)
//   waits    attend_by_warps(SCORERS + 4) ×2
//   who      0-6 arrive; 7 and 8-11 wait
//   guards   X_P
// TOPS_FOR_ROWS: as TOPS, for the rows; ASYNC
//   number   4
//   arrives  many/attend_together(TOPS_FOR_ROWS_WARPS) ×2
//   waits    many/weigh_rows(TOPS_FOR_ROWS_WARPS)
//   who      0-7 arrive, 12-15 wait
//   guards   M_PART
// WEIGHTS_FOR_SUFFIX: as TOPS, and the prefix's weights, for the suffix's; not ASYNC
//   number   5
//   arrives  attend_by_warps(SCORERS + 4) ×2
//   waits    weigh_suffix(SCORERS + 4); attend_by_warps(SCORERS + 4)
//   who      0-7 arrive, 12-15 wait
//   guards   M_PART, X_P
// SUFFIX_WEIGHTS: the suffix's weights; HOLD
//   number   6
//   arrives  weigh_suffix(WEIGHERS + 1)
//   waits    send_sums(WEIGHERS + 1); attend_by_warps(WEIGHERS + 1)
//   who      12 arrives; 7, 8-11, 13-15 wait
//   guards   X_P behind the prefix's tiles, X_KEEP
// SQUARES_KEPT: tiles' sums of squares; many
//   number   7
//   waits    many/publish_stream(KEEPERS)
//   who      0-7, which keep the stream
//   guards   M_PART
// TILE_MEETS: partial sums of a tile of gate|up, out or down; few, QKV_PAIRS: of two warps' q|k|v
//   number   8
//   waits    Own::meet(group_parts(group_tiles(MT))); few/QkvProduct::store(2)
//   who      8 + tile: the warps that share it; 8 + i: warps i and i + 8
//   guards   partial sums in region X, H or M_SUMS
// HIDDEN_BLOCK_MADE: hidden units of two tiles; many, COPY_HIDDEN
//   number   2
//   waits    many/gate_up(4)
//   who      2 + block: the four warps of its two tiles, one of which copies
//   guards   X_OWN_HIDDEN
// __syncthreads: the mbarriers are initialised
//   waits    turbopi_denoise
//   who      all warps, once
//   guards   M_BAR
// cluster_exchange: all CTAs of the cluster have begun; all are done
//   waits    turbopi_denoise ×2
//   who      all threads of a cluster: nobody leaves while a peer may still write to it
//   guards   M_BAR and shared memory of the peers

// Macros, as one constant more in this scope changes the code that ptxas makes. score.cu and many/attention.cu name
// those of attention.
#define CONSUMERS_MEET 1
#define SQUARES_KEPT 7
#define TILE_MEETS 8         // and 7 more
#define HIDDEN_BLOCK_MADE 2  // and 3 more

enum Barrier { BAR_X, BAR_Q, BAR_TOPS, BAR_COMB, BAR_ATT, BAR_HID, BAR_V, BAR_GO, BAR_RMS, BAR_RING };
