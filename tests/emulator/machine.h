// A multiprocessor cluster on a CPU: what the kernels' CUDA C++ needs to be compiled by an ordinary compiler and run.
// emulate.py puts it in front of a kernel's source, in which each asm statement has become a call of a function here.
//
// Threads are fibers, switched only where they wait, in an order that `seed` shuffles. Copies are as late as the seed
// likes, and products either read their operands at once or when they are waited for. So a barrier that nobody keeps
// shows as wrong numbers with some seed, and one that nobody completes as "everybody waits".

#include <ucontext.h>

#include <algorithm>
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
#define __global__
#define __forceinline__ inline
#define __grid_constant__
#define __launch_bounds__(...)

struct float2 { float x, y; };
struct float4 { float x, y, z, w; };
struct uint2 { unsigned x, y; };
struct uint4 { unsigned x, y, z, w; };
inline float2 make_float2(float x, float y) { return {x, y}; }
inline float4 make_float4(float x, float y, float z, float w) { return {x, y, z, w}; }
inline uint2 make_uint2(unsigned x, unsigned y) { return {x, y}; }
inline uint4 make_uint4(unsigned x, unsigned y, unsigned z, unsigned w) { return {x, y, z, w}; }
template <typename T> T max(T a, T b) { return a < b ? b : a; }
template <typename T> T min(T a, T b) { return b < a ? b : a; }
inline float rsqrtf(float x) { return 1 / std::sqrt(x); }
using std::fmaf; using std::fmaxf;
inline float __uint_as_float(unsigned x) { float y; memcpy(&y, &x, 4); return y; }
inline unsigned __byte_perm(unsigned x, unsigned y, unsigned s) {
    const uint64_t both = uint64_t(y) << 32 | x;
    unsigned r = 0;
    for (int i = 0; i < 4; ++i) r |= unsigned(both >> (s >> 4 * i & 7) * 8 & 255) << 8 * i;
    return r;
}

namespace machine {

struct Dim { unsigned x; };
struct Pending { float* sums; uint64_t a, b; bool keep; int group; };
struct Thread {
    ucontext_t context;
    std::unique_ptr<char[]> stack;
    Dim index, block;
    int rank, shuffles = 0, committed = 0, done = 0;  // groups of products
    std::vector<Pending> pending;
    bool ended = false;
};
struct MBarrier { int count, pending, bytes; unsigned phase; };
struct Barrier { int arrived = 0; unsigned uses = 0; };
struct Warp { uint64_t values[2][32]; int arrived[2] = {0, 0}; };
struct Map { uint64_t address; uint32_t axes, number_bytes; uint64_t sizes[3], strides[2]; uint32_t box[3]; };
struct Copy { Map map; unsigned to, bar; int at[3]; unsigned mask; };

constexpr int SHARED = 256 * 1024, PLACE = 24;  // bits of an address within a CTA; above them its rank
inline std::vector<Thread> threads;
inline Thread* now;
inline ucontext_t scheduler;
inline Dim grid;
inline int cta_threads, ranks;
inline std::vector<std::unique_ptr<char[]>> memory;  // of each rank
inline std::map<unsigned, MBarrier> mbarriers;
inline std::map<int, Barrier> barriers;  // by rank and number; cluster's: -1
inline std::vector<Warp> warps;
inline std::vector<Copy> copies;
inline std::mt19937 random;
inline bool eager;
inline long moved, rounds;  // moved: counts all that lets somebody go on
inline std::function<void()> kernel;

inline char* at(unsigned address) { return memory.at(address >> PLACE).get() + (address & ((1u << PLACE) - 1)); }
inline char* shared() { return memory[now->rank].get(); }
inline void wait_until(const std::function<bool()>& over) {
    do swapcontext(&now->context, &scheduler);  // also who needn't wait lets others go first
    while (!over());
    ++moved;
}
inline void meet(Barrier& b, int count) {
    const unsigned use = b.uses;
    if (++b.arrived == count) b.arrived = 0, ++b.uses, ++moved;
    wait_until([&] { return b.uses != use; });
}

// ---- mbarriers
inline MBarrier& barrier(unsigned bar) {
    auto found = mbarriers.find(bar);
    if (found == mbarriers.end()) throw std::runtime_error("a barrier that nobody has initialised");
    return found->second;
}
inline void changed(MBarrier& b) {
    if (b.pending < 0) throw std::runtime_error("more arrivals than a barrier's phase has");
    if (b.pending == 0 && b.bytes == 0) b.pending = b.count, b.phase ^= 1, ++moved;
}
inline void arrive(unsigned bar, int bytes = 0) {
    MBarrier& b = barrier(bar);
    b.bytes += bytes, --b.pending, changed(b);
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

// ---- copies
inline unsigned swizzled(unsigned address) { return address ^ (address >> 3 & 0x70); }
inline void make(const Copy& c) {
    const Map& m = c.map;
    const int rows = m.box[1] * (m.axes > 2 ? m.box[2] : 1);
    for (int rank = 0; rank < ranks; ++rank) {
        if (!(c.mask >> rank & 1)) continue;
        const unsigned to = (c.to & ((1u << PLACE) - 1)) | rank << PLACE;
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
inline float number(unsigned address, int i, bool fp8) {
    const char* p = at(swizzled(address + i * (fp8 ? 1 : 2)) | now->rank << PLACE);
    return fp8 ? e4m3(*(unsigned char*)p) : bf16(p);
}
inline unsigned row_of(uint64_t operand, int row) { return (operand & 0x3fff) * 16 + row / 8 * 1024 + row % 8 * 128; }
template <int COLUMNS, bool FP8>
void multiply(const Thread& thread, const Pending& p) {
    const int warp = thread.index.x / 32 % 4, lane = thread.index.x % 32, count = FP8 ? 32 : 16;
    for (int i = 0; i < COLUMNS / 2; ++i) {
        const int row = warp * 16 + lane / 4 + i / 2 % 2 * 8, column = i / 4 * 8 + lane % 4 * 2 + i % 2;
        float sum = p.keep ? p.sums[i] : 0;
        for (int k = 0; k < count; ++k)
            sum += number(row_of(p.a, row), k, FP8) * number(row_of(p.b, column), k, FP8);
        p.sums[i] = sum;
    }
}
inline std::function<void(const Thread&, const Pending&)> multiplier;
inline Thread* warpgroup() { return now - now->index.x % 128; }
inline void finish(int groups) {  // of this warpgroup, whose threads have all committed them
    for (Thread* t = warpgroup(); t < warpgroup() + 128; ++t) {
        while (!t->pending.empty() && t->pending.front().group < groups)
            multiplier(*t, t->pending.front()), t->pending.erase(t->pending.begin());
        t->done = max(t->done, groups);
    }
}
template <int COLUMNS, bool FP8>
void product(float* sums, uint64_t a, uint64_t b, bool keep) {
    multiplier = multiply<COLUMNS, FP8>;
    now->pending.push_back({sums, a, b, keep, now->committed});
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
    now->ended = true, ++moved;
    swapcontext(&now->context, &scheduler);
}
inline void run_cluster(int first) {
    memory.clear(), mbarriers.clear(), barriers.clear(), copies.clear(), fault.clear();
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
    int idle = 0;
    for (bool left = true; left;) {
        const long before = moved;
        left = false;
        std::shuffle(order.begin(), order.end(), random);
        for (int i : order) {
            if (threads[i].ended) continue;
            left = true, now = &threads[i];
            swapcontext(&scheduler, &now->context);
            if (!fault.empty()) throw std::runtime_error(fault);
        }
        const bool some = moved != before;
        for (size_t i = copies.size(); i-- > 0;)
            if (!some || random() % 8 == 0) {  // late, in any order
                const Copy c = copies[i];
                copies.erase(copies.begin() + i), make(c);
            }
        idle = moved == before ? idle + 1 : 0, ++rounds;
        if (left && idle == 100) throw std::runtime_error("everybody waits for somebody else");
    }
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
inline unsigned __cvta_generic_to_shared(const void* p) {
    return unsigned((const char*)p - machine::shared()) | machine::now->rank << machine::PLACE;
}
inline void __syncthreads() { machine::meet(machine::barriers[machine::now->rank * 16], machine::cta_threads); }

template <typename T>
T __shfl_sync(unsigned, T value, int from) {
    machine::Thread& t = *machine::now;
    machine::Warp& w = machine::warps[(t.rank * machine::cta_threads + t.index.x) / 32];
    const int lane = t.index.x % 32, turn = t.shuffles++ & 1;
    if (w.arrived[turn] == 32) w.arrived[turn] = 0;
    memcpy(&w.values[turn][lane], &value, sizeof(T));
    if (++w.arrived[turn] == 32) ++machine::moved;
    machine::wait_until([&] { return w.arrived[turn] == 32; });
    memcpy(&value, &w.values[turn][from % 32], sizeof(T));
    return value;
}
template <typename T>
T __shfl_xor_sync(unsigned mask, T value, int by) { return __shfl_sync(mask, value, (threadIdx.x % 32) ^ by); }
inline void __syncwarp() { __shfl_sync(~0u, 0, 0); }

// ---- the instructions, by name: first what they write, then what they read
inline void ptx_nothing() {}
inline void ptx_mbarrier_init(unsigned bar, unsigned count) { machine::mbarriers[bar] = {int(count), int(count), 0, 0}; }
inline void ptx_mbarrier_expect(unsigned bar, unsigned bytes) { machine::arrive(bar, bytes); }
inline void ptx_mbarrier_arrive(unsigned bar) { machine::arrive(bar); }
inline void ptx_mbarrier_arrive_remote(unsigned bar, unsigned cta) {
    machine::arrive((bar & ((1u << machine::PLACE) - 1)) | cta << machine::PLACE);
}
inline void ptx_mbarrier_wait(unsigned bar, unsigned parity) {
    machine::wait_until([&] { return machine::barrier(bar).phase != parity; });
}
inline void ptx_mbarrier_test(unsigned& over, unsigned bar, unsigned parity) {
    swapcontext(&machine::now->context, &machine::scheduler);
    over = machine::barrier(bar).phase != parity;
}
inline void ptx_cluster_sync() { machine::meet(machine::barriers[-1], machine::ranks * machine::cta_threads); }
inline void ptx_bar_sync(int number, int count) { machine::meet(machine::barriers[machine::now->rank * 16 + number], count); }
inline void ptx_mapa(unsigned& there, unsigned address, int rank) {
    there = (address & ((1u << machine::PLACE) - 1)) | rank << machine::PLACE;
}
inline void ptx_st_async(unsigned to, float x, float y, float z, float w, unsigned bar) {
    const float all[4] = {x, y, z, w};
    memcpy(machine::at(to), all, 16);
    machine::arrived_bytes(bar, 16);
}
inline void ptx_rcp(float& y, float x) { y = 1 / x; }
inline void ptx_tanh(float& y, float x) { y = std::tanh(x); }
inline void ptx_wgmma_commit() { machine::commit(); }
inline void ptx_wgmma_wait(int left) { machine::await(left); }
inline void ptx_cvt_bf16x2(unsigned& both, float high, float low) {
    both = machine::to_bf16(high) << 16 | machine::to_bf16(low);
}
inline void ptx_cvt_e4m3x2(unsigned short& both, float high, float low) {
    both = machine::to_e4m3(high) << 8 | machine::to_e4m3(low);
}
template <typename Map>
void ptx_copy_2d(unsigned to, const Map* map, int x, int y, unsigned bar, unsigned mask = 0) {
    machine::Copy c;
    memcpy(&c.map, map, sizeof c.map);
    c.to = to, c.bar = bar, c.at[0] = x, c.at[1] = y, c.at[2] = 0, c.mask = mask ? mask : 1u << machine::now->rank;
    machine::copies.push_back(c);
}
