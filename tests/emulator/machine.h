// A multiprocessor cluster on a CPU: what the kernels' CUDA C++ needs to be compiled by an ordinary compiler and run.
// emulate.py puts it in front of a kernel's source, in which each asm statement has become a call of a function here.
//
// Threads are fibers, switched only where they wait, in an order that `seed` shuffles. Copies are as late as the seed
// likes, and products either read their operands at once or when they are waited for. So a barrier that nobody keeps
// shows as wrong numbers with some seed, and one that nobody completes as "everybody waits".

#include <ucontext.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <functional>
#include <map>
#include <memory>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#define __device__
#define __host__
#define __global__
#define __forceinline__ inline
#define __grid_constant__
#define __launch_bounds__(...)
#define __cluster_dims__(...)
#define __builtin_assume(...) ((void)0)

struct float2 { float x, y; };
struct float4 { float x, y, z, w; };
struct uint2 { unsigned x, y; };
struct ushort2 { unsigned short x, y; };
struct uint4 { unsigned x, y, z, w; };
struct int4 { int x, y, z, w; };
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline int4 make_int4(int x, int y, int z, int w) { return {x, y, z, w}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
template <typename T> T max(T a, T b) { return a < b ? b : a; }
template <typename T> T min(T a, T b) { return b < a ? b : a; }
inline float rsqrtf(float x) { return 1 / std::sqrt(x); }
using std::fmaf; using std::fmaxf;
inline float __fdividef(float x, float y) { return x / y; }
inline float __fadd_rn(float x, float y) { return x + y; }
inline float __fmul_rn(float x, float y) { return x * y; }
inline float __fsub_rn(float x, float y) { return x - y; }
inline void sincosf(float x, float* sine, float* cosine) { *sine = std::sin(x), *cosine = std::cos(x); }
inline float exp2f(float x) { return std::exp2(x); }
inline float __uint_as_float(unsigned x) { float y; memcpy(&y, &x, 4); return y; }
inline unsigned __float_as_uint(float x) { unsigned y; memcpy(&y, &x, 4); return y; }
inline float __int_as_float(int x) { return __uint_as_float(x); }
inline int __float_as_int(float x) { return __float_as_uint(x); }
template <typename T> T __ldg(const T* p) { return *p; }
template <typename T> T __ldcg(const T* p) { return *p; }
inline unsigned __byte_perm(unsigned x, unsigned y, unsigned s) {
    const uint64_t both = uint64_t(y) << 32 | x;
    unsigned r = 0;
    for (int i = 0; i < 4; ++i) r |= unsigned(both >> (s >> 4 * i & 7) * 8 & 255) << 8 * i;
    return r;
}

namespace machine {

struct Dim { unsigned x; };
struct Thread;
// Operand A of a product: where it lies in shared memory, or what this thread has of it.
struct OperandA {
    uint64_t place = 0;
    unsigned registers[4] = {};
    bool in_registers = false;
    OperandA(uint64_t where) : place(where) {}
    OperandA(unsigned a, unsigned b, unsigned c, unsigned d) : registers{a, b, c, d}, in_registers(true) {}
};
struct Pending {
    float* sums;
    OperandA a;
    uint64_t b;
    bool keep;
    int group;
    void (*multiply)(const Thread&, const Pending&);
};
struct Thread {
    ucontext_t context;
    std::unique_ptr<char[]> stack;
    Dim index, block;
    int rank, shuffles = 0, committed = 0, done = 0;  // groups of products
    unsigned cluster_use = 0;  // of the cluster's barrier that it arrived at
    std::vector<Pending> pending;
    bool ended = false;
};
struct MBarrier { int count, pending, bytes; unsigned phase; };
struct Barrier { int arrived = 0; unsigned uses = 0; };
struct Warp { char values[2][32][64]; int arrived[2] = {0, 0}; };
struct Map { uint64_t address; uint32_t axes, number_bytes; uint64_t sizes[3], strides[2]; uint32_t box[3]; };
struct Copy { Map map; unsigned to, bar; int at[3]; unsigned mask; std::string bytes; };  // of a map, or these

constexpr int SHARED = 256 * 1024, PLACE = 24;  // bits of an address within a CTA; above them its rank
constexpr unsigned FIRST = 128;  // address of a CTA's shared memory: as aligned as kernels ask for, no more
inline std::vector<Thread> threads;
inline Thread* now;
inline ucontext_t scheduler;
inline Dim grid;
inline int cta_threads, ranks, shared_bytes;
inline std::vector<std::unique_ptr<char[]>> memory;  // of each rank
inline std::map<unsigned, MBarrier> mbarriers;
inline std::map<int, Barrier> barriers;  // by rank and number; cluster's: -1
inline std::vector<Warp> warps;
inline std::vector<Copy> copies;
inline std::vector<unsigned> signals;  // to other CTAs' barriers, on their way
inline std::vector<int> going;  // threads of each rank that haven't ended
inline std::mt19937 random;
inline bool eager, uneven;  // uneven: again and again a block stands still for a while
inline long moved, rounds;  // moved: counts all that lets somebody go on
inline std::function<void()> kernel;

inline void check_there(unsigned address) {
    if (!going.at(address >> PLACE)) throw std::runtime_error("shared memory of a CTA that has ended");
}
inline char* at(unsigned address, size_t bytes = 1) {
    const unsigned place = address & ((1u << PLACE) - 1);
    if (place < FIRST || place + bytes > FIRST + shared_bytes) throw std::runtime_error("an address outside a CTA's shared memory");
    return memory.at(address >> PLACE).get() + place;
}
inline char* shared() { return memory[now->rank].get() + FIRST; }
inline void wait_until(const std::function<bool()>& over) {
    do swapcontext(&now->context, &scheduler);  // also who needn't wait lets others go first
    while (!over());
    ++moved;
}
inline unsigned arrive_at(Barrier& b, int count) {  // which use of the barrier that was
    const unsigned use = b.uses;
    if (++b.arrived == count) b.arrived = 0, ++b.uses, ++moved;
    return use;
}
inline void meet(Barrier& b, int count) {
    const unsigned use = arrive_at(b, count);
    wait_until([&] { return b.uses != use; });
}

// ---- mbarriers
inline MBarrier& barrier(unsigned bar) {
    auto found = mbarriers.find(bar);
    if (found == mbarriers.end()) throw std::runtime_error("a barrier that nobody has initialised");
    check_there(bar);
    return found->second;
}
inline void changed(MBarrier& b) {
    if (b.pending < 0) throw std::runtime_error("more arrivals than a barrier's phase has");
    if (b.pending == 0 && b.bytes == 0) b.pending = b.count, b.phase ^= 1, ++moved;
}
inline void arrive(unsigned bar, int bytes = 0, int times = 1) {
    MBarrier& b = barrier(bar);
    b.bytes += bytes, b.pending -= times, changed(b);
}
inline void deliver(size_t i) {
    const unsigned bar = signals[i];
    signals.erase(signals.begin() + i), arrive(bar), ++moved;
}
inline void arrived_bytes(unsigned bar, int bytes) { MBarrier& b = barrier(bar); b.bytes -= bytes, changed(b); }

// ---- numbers
inline float bf16(const char* p) { uint16_t x; memcpy(&x, p, 2); return __uint_as_float(unsigned(x) << 16); }
inline float e4m3(unsigned char x) {
    const int exponent = x >> 3 & 15, mantissa = x & 7;
    if ((x & 127) == 127) return NAN;
    const float value = exponent ? std::ldexp(8 + mantissa, exponent - 10) : std::ldexp(mantissa, -9);
    return x & 128 ? -value : value;
}
inline unsigned to_bf16(float x) {
    unsigned bits; memcpy(&bits, &x, 4);
    return std::isnan(x) ? 0x7fff : (bits + 0x7fff + (bits >> 16 & 1)) >> 16;
}
inline unsigned to_e4m3(float x) {
    if (std::isnan(x)) return 127;
    unsigned best = 0;
    const float size = std::fabs(x);
    for (unsigned code = 0; code < 127; ++code) {  // to the nearest, halves to even
        const float ours = std::fabs(e4m3(code) - size), least = std::fabs(e4m3(best) - size);
        if (ours < least || (ours == least && code % 2 == 0)) best = code;
    }
    return best | (std::signbit(x) ? 128 : 0);
}

inline unsigned half_of_e4m3(unsigned char x) {  // exact: float16 has all of E4M3's numbers
    unsigned bits; const float value = e4m3(x); memcpy(&bits, &value, 4);
    if (std::isnan(value)) return 0x7fff;
    const unsigned exponent = bits >> 23 & 255, sign = bits >> 16 & 0x8000;
    return exponent ? sign | (exponent - 112) << 10 | (bits >> 13 & 0x3ff) : sign;
}
inline float half(unsigned x) {
    const int exponent = x >> 10 & 31, mantissa = x & 0x3ff;
    const float value = exponent == 31 ? (mantissa ? NAN : INFINITY)
                        : exponent     ? std::ldexp(1024 + mantissa, exponent - 25)
                                       : std::ldexp(mantissa, -24);
    return x & 0x8000 ? -value : value;
}

// ---- copies
inline unsigned swizzled(unsigned address) { return address ^ (address >> 3 & 0x70); }
inline void make(const Copy& c) {
    if (!c.bytes.empty()) {
        memcpy(at(c.to), c.bytes.data(), c.bytes.size());
        arrived_bytes(c.bar, c.bytes.size());
        ++moved;
        return;
    }
    const Map& m = c.map;
    const int rows = m.box[1] * (m.axes > 2 ? m.box[2] : 1);
    for (int rank = 0; rank < ranks; ++rank) {
        if (!(c.mask >> rank & 1)) continue;
        const unsigned to = (c.to & ((1u << PLACE) - 1)) | rank << PLACE;
        check_there(to);
        for (int row = 0; row < rows; ++row)
            for (unsigned i = 0; i < m.box[0]; ++i) {
                const int x = c.at[0] + i, y = c.at[1] + row % m.box[1], z = m.axes > 2 ? c.at[2] + row / m.box[1] : 0;
                const bool inside = x >= 0 && x < int(m.sizes[0]) && y >= 0 && y < int(m.sizes[1]) &&
                                    (m.axes < 3 || (z >= 0 && z < int(m.sizes[2])));
                char* const place = at(swizzled(to + row * 128 + i * m.number_bytes));
                if (inside)
                    memcpy(place, (char*)m.address + x * m.number_bytes + y * m.strides[0] + z * m.strides[1],
                           m.number_bytes);
                else
                    memset(place, 0, m.number_bytes);
            }
        arrived_bytes((c.bar & ((1u << PLACE) - 1)) | rank << PLACE, rows * 128);
    }
    ++moved;
}

// ---- products of a warpgroup: 64 rows of a, `columns` rows of b, 32 bytes of each
inline float number(const char* p, int i, bool fp8) { return fp8 ? e4m3(((const unsigned char*)p)[i]) : bf16(p + 2 * i); }
// 16 bytes of a row of an operand: the first ones, or the next. Its descriptor as PTX has it (matrix-descriptor): bits 0
// to 13 where it begins, 16 to 29 how far the next 16 bytes of its rows are, 32 to 45 how far the next 8 rows, all in
// units of 16 bytes; 62 and 63 its swizzling: none, where 8 rows of 16 bytes lie one after the other, or (1) of rows of
// 128 bytes.
inline const char* row_of(uint64_t operand, int row, int next) {
    auto units = [&](int from) { return unsigned(operand >> from & 0x3fff) * 16; };
    const unsigned start = units(0) + row / 8 * units(32), swizzling = operand >> 62;
    if (swizzling > 1) throw std::runtime_error("an operand that is swizzled otherwise than by 128 bytes");
    const unsigned address = swizzling ? swizzled(start + row % 8 * 128 + next * 16) : start + row % 8 * 16 + next * units(16);
    return at(address | now->rank << PLACE);
}
// The same of an operand in registers (PTX: wgmma's register fragments): of 8 rows each lane of a quad has 4 bytes.
inline std::string row_of(const Thread* warpgroup, int row, int next) {
    std::string bytes;
    for (int lane = row % 8 * 4; lane < row % 8 * 4 + 4; ++lane)
        bytes.append((const char*)&warpgroup[row / 16 * 32 + lane].pending.front().a.registers[next * 2 + row / 8 % 2], 4);
    return bytes;
}
// One number of an operand whose 16 rows are the product's depth: columns in panels of 64, bits 16 to 29 how far apart.
inline const char* across(uint64_t operand, int row, int column) {
    auto units = [&](int from) { return unsigned(operand >> from & 0x3fff) * 16; };
    const unsigned start = units(0) + row / 8 * units(32) + column / 64 * units(16);
    return at(swizzled(start + row % 8 * 128 + column % 64 * 2) | now->rank << PLACE);
}
inline Thread* warpgroup() { return now - now->index.x % 128; }
template <int COLUMNS, bool FP8, bool ACROSS>
void multiply(const Thread& thread, const Pending& p) {
    const int warp = thread.index.x / 32 % 4, lane = thread.index.x % 32;
    for (int i = 0; i < COLUMNS / 2; ++i) {
        const int row = warp * 16 + lane / 4 + i / 2 % 2 * 8, column = i / 4 * 8 + lane % 4 * 2 + i % 2;
        float sum = p.keep ? p.sums[i] : 0;
        for (int next = 0; next < 2; ++next) {
            const std::string held = p.a.in_registers ? row_of(warpgroup(), row, next) : "";
            const char* const a = p.a.in_registers ? held.data() : row_of(p.a.place, row, next);
            const char* const b = ACROSS ? nullptr : row_of(p.b, column, next);
            for (int k = 0; k < (FP8 ? 16 : 8); ++k)
                sum += number(a, k, FP8) * (ACROSS ? bf16(across(p.b, next * 8 + k, column)) : number(b, k, FP8));
        }
        p.sums[i] = sum;
    }
}
inline void finish(int groups) {  // of this warpgroup, whose threads have all committed them
    Thread* const first = warpgroup();
    for (; !first->pending.empty() && first->pending.front().group < groups;) {
        for (Thread* t = first; t < first + 128; ++t) t->pending.front().multiply(*t, t->pending.front());
        for (Thread* t = first; t < first + 128; ++t) t->pending.erase(t->pending.begin());
    }
    for (Thread* t = first; t < first + 128; ++t) t->done = max(t->done, groups);
}
template <int COLUMNS, bool FP8, bool ACROSS = false>
void product(float* sums, OperandA a, uint64_t b, bool keep) {
    now->pending.push_back({sums, a, b, keep, now->committed, multiply<COLUMNS, FP8, ACROSS>});
}
inline void await(int left) {
    const int groups = now->committed - left;
    if (groups <= now->done) return;
    wait_until([&] {
        for (Thread* t = warpgroup(); t < warpgroup() + 128; ++t)
            if (t->committed < groups) return false;
        return true;
    });
    if (groups > now->done) finish(groups);
}
inline void commit() {
    ++now->committed;
    if (!eager) return;
    for (Thread* t = warpgroup(); t < warpgroup() + 128; ++t)
        if (t->committed < now->committed) return;
    finish(now->committed);
}

// ---- the run
inline std::string fault;  // of a thread: exceptions end at its stack's
inline void run_thread() {
    try {
        kernel();
    } catch (const std::exception& error) {
        fault = error.what();
    }
    now->ended = true, --going[now->rank], ++moved;
    swapcontext(&now->context, &scheduler);
}
inline void run_cluster(int first) {
    memory.clear(), mbarriers.clear(), barriers.clear(), copies.clear(), signals.clear(), fault.clear();
    going.assign(ranks, cta_threads);
    for (int rank = 0; rank < ranks; ++rank) {
        memory.emplace_back(new char[SHARED]);
        memset(memory.back().get(), 0xff, SHARED);  // NaN: what is read before it is there shows
    }
    threads = std::vector<Thread>(ranks * cta_threads);
    warps = std::vector<Warp>(threads.size() / 32);
    std::vector<int> order(threads.size());
    for (size_t i = 0; i < threads.size(); ++i) {
        Thread& t = threads[i];
        order[i] = i;
        t.rank = i / cta_threads, t.index.x = i % cta_threads, t.block.x = first + t.rank;
        t.stack.reset(new char[128 * 1024]);
        getcontext(&t.context);
        t.context.uc_stack.ss_sp = t.stack.get(), t.context.uc_stack.ss_size = 128 * 1024, t.context.uc_link = nullptr;
        makecontext(&t.context, run_thread, 0);
    }
    int idle = 0, slow = -1;
    long until = 0;
    for (bool left = true; left;) {
        const long before = moved;
        if (uneven && rounds >= until) slow = int(random() % (ranks + 1)) - 1, until = rounds + random() % 200;
        left = false;
        std::shuffle(order.begin(), order.end(), random);
        for (int i : order) {
            if (threads[i].ended) continue;
            left = true, now = &threads[i];
            if (now->rank == slow) continue;
            swapcontext(&scheduler, &now->context);
            if (!fault.empty()) throw std::runtime_error(fault);
        }
        const bool some = moved != before;
        for (size_t i = copies.size(); i-- > 0;)
            if (!some || random() % 8 == 0) {  // late, in any order
                const Copy c = copies[i];
                copies.erase(copies.begin() + i), make(c);
            }
        for (size_t i = signals.size(); i-- > 0;)
            if (!some || random() % 8 == 0) deliver(i);
        idle = moved == before ? idle + 1 : 0, ++rounds;
        if (moved == before) until = 0;  // all others wait for the one that stands still
        if (left && idle == 100) throw std::runtime_error("everybody waits for somebody else");
    }
    while (!signals.empty()) deliver(0);  // to somebody who has ended
}

template <typename T>
T given(const void* value) {
    T copy;
    memcpy(&copy, value, sizeof copy);
    return copy;
}

}  // namespace machine

#define threadIdx (machine::now->index)
#define blockIdx (machine::now->block)
#define gridDim (machine::grid)
#define clock() (unsigned(machine::rounds) * 100)
inline long long clock64() {  // others go on while somebody looks at it
    swapcontext(&machine::now->context, &machine::scheduler);
    return machine::rounds * 100;
}
inline void __threadfence_system() {}
inline void __trap() { throw std::runtime_error("a trap"); }
inline unsigned __cvta_generic_to_shared(const void* p) {
    return unsigned((const char*)p - machine::shared() + machine::FIRST) | machine::now->rank << machine::PLACE;
}
inline void __syncthreads() { machine::meet(machine::barriers[machine::now->rank * 16], machine::cta_threads); }

// What all lanes of the warp have, once all of them are here.
template <typename T, typename Read>
auto exchanged(const T& value, Read read) {
    static_assert(sizeof(T) <= 64, "an exchange's room");
    machine::Thread& t = *machine::now;
    machine::Warp& w = machine::warps[(t.rank * machine::cta_threads + t.index.x) / 32];
    const int lane = t.index.x % 32, turn = t.shuffles++ & 1;
    if (w.arrived[turn] == 32) w.arrived[turn] = 0;
    memcpy(&w.values[turn][lane], &value, sizeof(T));
    if (++w.arrived[turn] == 32) ++machine::moved;
    machine::wait_until([&] { return w.arrived[turn] == 32; });
    return read([&](int from) {
        T found;
        memcpy(&found, &w.values[turn][from % 32], sizeof(T));
        return found;
    });
}
template <typename T>
T __shfl_sync(unsigned, T value, int from) {
    return exchanged(value, [&](auto of_lane) { return of_lane(from); });
}
template <typename T>
T __shfl_xor_sync(unsigned mask, T value, int by) { return __shfl_sync(mask, value, (threadIdx.x % 32) ^ by); }
inline bool __any_sync(unsigned, bool mine) {
    return exchanged(mine, [&](auto of_lane) {
        for (int lane = 0; lane < 32; ++lane)
            if (of_lane(lane)) return true;
        return false;
    });
}
inline bool __all_sync(unsigned mask, bool mine) { return !__any_sync(mask, !mine); }
inline void __syncwarp() { __shfl_sync(~0u, 0, 0); }

// ---- the instructions, by name: first what they write, then what they read
inline void ptx_nothing() {}
inline void ptx_unknown(const char* what) { throw std::runtime_error(std::string("machine.h has no instruction for: ") + what); }
inline void ptx_mbarrier_init(unsigned bar, unsigned count) { machine::mbarriers[bar] = {int(count), int(count), 0, 0}; }
inline void ptx_mbarrier_expect(unsigned bar, unsigned bytes) { machine::arrive(bar, bytes); }
inline void ptx_mbarrier_arrive(unsigned bar, int times = 1) { machine::arrive(bar, 0, times); }
inline void ptx_mbarrier_arrive_remote(unsigned bar, unsigned cta) {
    machine::signals.push_back((bar & ((1u << machine::PLACE) - 1)) | cta << machine::PLACE);
}
inline void ptx_mbarrier_wait(unsigned bar, unsigned parity) {
    machine::wait_until([&] { return machine::barrier(bar).phase != parity; });
}
inline void ptx_mbarrier_test(unsigned& over, unsigned bar, unsigned parity) {
    swapcontext(&machine::now->context, &machine::scheduler);
    over = machine::barrier(bar).phase != parity;
}
inline void ptx_cluster_sync() { machine::meet(machine::barriers[-1], machine::ranks * machine::cta_threads); }
inline void ptx_cluster_exchange() {  // behind all that was sent
    while (!machine::signals.empty()) machine::deliver(0);
    ptx_cluster_sync();
}
inline void ptx_cluster_arrive() {
    machine::now->cluster_use = machine::arrive_at(machine::barriers[-1], machine::ranks * machine::cta_threads);
}
inline void ptx_cluster_wait() {
    machine::wait_until([use = machine::now->cluster_use] { return machine::barriers[-1].uses != use; });
}
inline void ptx_bar_sync(int number, int count) { machine::meet(machine::barriers[machine::now->rank * 16 + number], count); }
inline void ptx_mapa(unsigned& there, unsigned address, int rank) {
    there = (address & ((1u << machine::PLACE) - 1)) | rank << machine::PLACE;
}
template <typename Number>
void st_async(unsigned to, const std::vector<Number>& all, unsigned bar) {
    machine::check_there(to);
    memcpy(machine::at(to, all.size() * 4), all.data(), all.size() * 4);
    machine::arrived_bytes(bar, all.size() * 4);
}
inline void ptx_st_async(unsigned to, float x, float y, float z, float w, unsigned bar) { st_async<float>(to, {x, y, z, w}, bar); }
inline void ptx_st_async(unsigned to, unsigned x, unsigned y, unsigned bar) { st_async<unsigned>(to, {x, y}, bar); }
inline void ptx_st_async(unsigned to, unsigned x, unsigned bar) { st_async<unsigned>(to, {x}, bar); }
inline void ptx_rcp(float& y, float x) { y = 1 / x; }
inline void ptx_tanh(float& y, float x) { y = std::tanh(x); }
inline void ptx_ex2(float& y, float x) { y = std::exp2(x); }
inline void ptx_store_four(unsigned to, unsigned x, unsigned y, unsigned z, unsigned w) {
    const unsigned all[4] = {x, y, z, w};
    memcpy(machine::at(to, 16), all, 16);
}
inline void ptx_store_four(unsigned to, unsigned v) { ptx_store_four(to, v, v, v, v); }
inline void ptx_store_one(unsigned to, unsigned v) { memcpy(machine::at(to, 4), &v, 4); }
inline void ptx_wgmma_commit() { machine::commit(); }
inline void ptx_wgmma_wait(int left) { machine::await(left); }
inline void ptx_cvt_bf16x2(unsigned& both, float high, float low) {
    both = machine::to_bf16(high) << 16 | machine::to_bf16(low);
}
inline void ptx_and_or(unsigned& y, unsigned a, unsigned b, unsigned c) { y = (a & b) | c; }
inline void ptx_fma_bf16x2(unsigned& both, unsigned a, unsigned b, unsigned c) {
    auto one = [&](int from) {
        auto of = [&](unsigned x) { return __uint_as_float((x >> from & 0xffff) << 16); };
        return machine::to_bf16(fmaf(of(a), of(b), of(c)));
    };
    both = one(16) << 16 | one(0);
}
inline void ptx_cvt_s8(int& whole, float x) {
    whole = x != x ? 0 : int(std::nearbyint(std::min(std::max(x, -128.0f), 127.0f)));
}
inline void ptx_cvt_float(float& x, int whole) { x = float(whole); }
inline void ptx_cvt_e4m3x2(unsigned short& both, float high, float low) {
    both = machine::to_e4m3(high) << 8 | machine::to_e4m3(low);
}
inline void ptx_cvt_e4m3_halves(unsigned& low, unsigned& high, unsigned four) {
    auto two = [&](int from) {
        return machine::half_of_e4m3(four >> from & 255) | machine::half_of_e4m3(four >> (from + 8) & 255) << 16;
    };
    low = two(0), high = two(16);
}
// Four matrices of 8 x 8 numbers of 16 bits: lane 8 i + r tells where row r of matrix i is, lane 4 r + c gets its
// numbers 2 c and 2 c + 1.
inline void ptx_ldmatrix(unsigned& v0, unsigned& v1, unsigned& v2, unsigned& v3, unsigned address) {
    unsigned* const v[4] = {&v0, &v1, &v2, &v3};
    const int lane = threadIdx.x % 32;
    exchanged(address, [&](auto of_lane) {
        for (int i = 0; i < 4; ++i) memcpy(v[i], machine::at(of_lane(i * 8 + lane / 4) + lane % 4 * 4), 4);
        return 0;
    });
}
// The same, transposed: numbers c of its rows 2 r and 2 r + 1, for lane 4 c + r.
inline void ptx_ldmatrix_transposed(unsigned& v0, unsigned& v1, unsigned& v2, unsigned& v3, unsigned address) {
    unsigned* const v[4] = {&v0, &v1, &v2, &v3};
    const int lane = threadIdx.x % 32;
    exchanged(address, [&](auto of_lane) {
        for (int i = 0; i < 4; ++i)
            for (int half = 0; half < 2; ++half)
                memcpy((char*)v[i] + half * 2, machine::at(of_lane(i * 8 + lane % 4 * 2 + half) + lane / 4 * 2), 2);
        return 0;
    });
}
// c += a b of mma.m16n8k16, whose fragments PTX draws: lane 4 g + t has of a the columns 2 t, 2 t + 1 of row g, of row g +
// 8, and the columns 8 further of both; of b the rows 2 t, 2 t + 1 and 8 further of column g; of c the columns 2 t, 2 t + 1
// of row g and of row g + 8.
template <typename Number>
void mma(float* const (&c)[4], const std::array<unsigned, 6>& mine, Number number) {
    const int g = threadIdx.x % 32 / 4, t = threadIdx.x % 4;
    exchanged(mine, [&](auto of_lane) {
        for (int i = 0; i < 4; ++i)
            for (int k = 0; k < 16; ++k) {
                const unsigned a = of_lane(g * 4 + k % 8 / 2)[i / 2 + k / 8 * 2];
                const unsigned b = of_lane((2 * t + i % 2) * 4 + k % 8 / 2)[4 + k / 8];
                *c[i] += number(a >> k % 2 * 16 & 0xffff) * number(b >> k % 2 * 16 & 0xffff);
            }
        return 0;
    });
}
inline void ptx_mma_bf16(float& c0, float& c1, float& c2, float& c3, unsigned a0, unsigned a1, unsigned a2, unsigned a3,
                         unsigned b0, unsigned b1) {
    mma({&c0, &c1, &c2, &c3}, {a0, a1, a2, a3, b0, b1}, [](unsigned x) { return __uint_as_float(x << 16); });
}
inline void ptx_mma_half(float& c0, float& c1, float& c2, float& c3, unsigned a0, unsigned a1, unsigned a2, unsigned a3,
                         unsigned b0, unsigned b1) {
    mma({&c0, &c1, &c2, &c3}, {a0, a1, a2, a3, b0, b1}, machine::half);
}
// The same of mma.m16n8k32: where bfloat16 has two columns, E4M3 has four.
inline void ptx_mma_e4m3(float& c0, float& c1, float& c2, float& c3, unsigned a0, unsigned a1, unsigned a2, unsigned a3,
                         unsigned b0, unsigned b1) {
    float* const c[4] = {&c0, &c1, &c2, &c3};
    const int g = threadIdx.x % 32 / 4, t = threadIdx.x % 4;
    exchanged(std::array<unsigned, 6>{a0, a1, a2, a3, b0, b1}, [&](auto of_lane) {
        for (int i = 0; i < 4; ++i)
            for (int k = 0; k < 32; ++k) {
                const unsigned a = of_lane(g * 4 + k % 16 / 4)[i / 2 + k / 16 * 2];
                const unsigned b = of_lane((2 * t + i % 2) * 4 + k % 16 / 4)[4 + k / 16];
                *c[i] += machine::e4m3(a >> k % 4 * 8 & 255) * machine::e4m3(b >> k % 4 * 8 & 255);
            }
        return 0;
    });
}
template <typename... Pairs>
void ptx_add_bf16(void* to, Pairs... pairs) {
    uint16_t* place = (uint16_t*)to;
    auto add = [&](unsigned x) {
        const float there = __uint_as_float((unsigned)*place << 16);
        *place++ = machine::to_bf16(there + __uint_as_float(x << 16));
    };
    for (const unsigned both : {pairs...}) add(both & 0xffff), add(both >> 16);
}
// Of all blocks, which here are one cluster.
inline void ptx_add_released(unsigned* to, unsigned what) { *to += what, ++machine::moved; }
inline void ptx_load_acquired(unsigned& value, const unsigned* from) {
    swapcontext(&machine::now->context, &machine::scheduler);  // others go on while somebody looks
    value = *from;
}
inline void ptx_copy_16(unsigned to, const void* from) { memcpy(machine::at(to, 16), from, 16); }
inline void ptx_put(void* to, unsigned value) { memcpy(to, &value, 4); }
inline void ptx_load_once(unsigned& x, unsigned& y, unsigned& z, unsigned& w, const void* from) {
    const uint4 v = *(const uint4*)from;
    x = v.x, y = v.y, z = v.z, w = v.w;
}
inline void ptx_copy_bytes(unsigned to, const void* from, unsigned bytes, unsigned bar, uint64_t) {
    machine::Copy c{};
    c.to = to, c.bar = bar, c.bytes.assign((const char*)from, bytes);
    machine::copies.push_back(c);
}
template <typename Map>
void ptx_copy_3d(unsigned to, const Map* map, int x, int y, int z, unsigned bar, unsigned mask = 0) {
    machine::Copy c;
    memcpy(&c.map, map, sizeof c.map);
    c.to = to, c.bar = bar, c.at[0] = x, c.at[1] = y, c.at[2] = z, c.mask = mask ? mask : 1u << machine::now->rank;
    machine::copies.push_back(c);
}
template <typename Map>
void ptx_copy_2d(unsigned to, const Map* map, int x, int y, unsigned bar, unsigned mask = 0) {
    ptx_copy_3d(to, map, x, y, 0, bar, mask);
}
