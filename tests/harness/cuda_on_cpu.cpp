// The scheduler of cuda_on_cpu.h: a block's threads as fibers on stacks of their own, their warps and barriers.
#include "cuda_on_cpu.h"

#include <stdarg.h>
#include <stdio.h>
#include <sys/mman.h>

#include <mutex>
#include <utility>
#include <vector>

#include "fiber.h"
#include "warp.h"

harness::Index threadIdx, blockIdx, blockDim, gridDim;

namespace harness {
namespace {

constexpr int kMaxThreads = 1024, kMaxWarps = kMaxThreads / kLanes;
constexpr size_t kStackBytes = 128 << 10;  // a thread's; kernels keep a few hundred floats
constexpr size_t kPage = 4096;
constexpr size_t kGuardBytes = 64;         // beside every piece of shared memory
constexpr size_t kSharedBytes = 48 << 10;  // available to a block on every GPU by default
constexpr size_t kArenaBytes = 2 * kSharedBytes;
constexpr int kCudaVersion = 13000;

// Orders of threads and of blocks.
enum Order { forward, reverse, shuffled_by_seed };

struct Piece {
    const void* site;
    const char* name;
    size_t begin, bytes;
};

struct Settings {
    int order = forward;
    uint64_t seed = 0;
    int multiprocessors = 3;
    int fault = 0;
};

struct Meeting {
    Barrier barrier;
    Place place;
    int arrived, predicates;
};

// The one block that runs.
struct Block {
    const char* kernel;
    void (*body)(const void*);
    const void* context;
    int threads, warps, ended;
    bool failed;
    Warp warp[kMaxWarps];
    Meeting meeting;
    int result;  // of the last barrier
    std::vector<Piece> pieces;
    size_t used;
};

Settings settings;
Block block;
Fiber host, fibers[kMaxThreads];
int started = 0;  // fibers that have a stack
char* stacks = nullptr;
alignas(256) char arena[kArenaBytes];
cudaError_t last_error = cudaSuccess;
char message[1024] = "";
int64_t launches = 0, switches = 0;
uint64_t random_state = 0;

uint32_t random_number() {  // SplitMix64
    uint64_t bits = random_state += 0x9e3779b97f4a7c15u;
    bits = (bits ^ bits >> 30) * 0xbf58476d1ce4e5b9u, bits = (bits ^ bits >> 27) * 0x94d049bb133111ebu;
    return static_cast<uint32_t>(bits >> 32);
}

// One of the set bits, by the order of this run.
int choose(uint32_t bits) {
    if (settings.order == forward) return __builtin_ctz(bits);
    if (settings.order == reverse) return 31 - __builtin_clz(bits);
    const uint32_t turn = random_number() & 31u;
    const uint32_t turned = bits >> turn | bits << (-turn & 31u);
    return static_cast<int>((__builtin_ctz(turned) + turn) & 31u);
}

const char* name_of(Operation operation) {
    static const char* const names[] = {"__syncwarp",       "__shfl_sync",     "__shfl_up_sync",
                                        "__shfl_down_sync", "__shfl_xor_sync", "__ballot_sync",
                                        "__any_sync",       "__all_sync",      "__match_any_sync"};
    return names[static_cast<int>(operation)];
}

const char* name_of(Barrier barrier) {
    static const char* const names[] = {"__syncthreads", "__syncthreads_count", "__syncthreads_or",
                                        "__syncthreads_and"};
    return names[static_cast<int>(barrier)];
}

const char* base_name(const char* path) {
    const char* slash = strrchr(path, '/');
    return slash ? slash + 1 : path;
}

// Keeps the first error only: later ones are consequences.
__attribute__((format(printf, 2, 3))) void record(cudaError_t error, const char* format, ...) {
    if (last_error != cudaSuccess) return;
    last_error = error;
    const int at = snprintf(message, sizeof message, "%s: ", block.kernel);
    va_list values;
    va_start(values, format);
    vsnprintf(message + at, sizeof message - static_cast<size_t>(at), format, values);
    va_end(values);
}

template <class... Values>
void fail(const char* format, Values... values) {
    block.failed = true;
    record(cudaErrorLaunchFailure, format, values...);
}

// Abandons the block: its fibers are recreated.
void abandon() {
    Fiber here;
    here.go_to(host);
}

void enter(int thread) {
    threadIdx.x = static_cast<unsigned>(thread);
    ++switches;
}

// The warp of which a thread runs next, or -1: the same while it can, but with a random order.
int choose_warp(int current) {
    if (settings.order != shuffled_by_seed && current >= 0 && block.warp[current].ready) return current;
    uint32_t able = 0;
    for (int w = 0; w < block.warps; ++w) able |= static_cast<uint32_t>(block.warp[w].ready != 0) << w;
    return able ? choose(able) : -1;
}

void finish_barrier() {
    const Meeting& met = block.meeting;
    const int count = met.predicates;
    block.result = met.barrier == Barrier::count ? count
                   : met.barrier == Barrier::any ? count > 0
                                                 : count == block.threads;
    block.meeting.arrived = 0;
    for (int w = 0; w < block.warps; ++w) std::swap(block.warp[w].ready, block.warp[w].at_barrier);
}

// No thread can continue, and some are waiting.
void explain_deadlock() {
    int ended = 0, barred = 0, waiting = 0;
    const Request* request = nullptr;
    int thread = 0;
    for (int w = 0; w < block.warps; ++w) {
        const Warp& warp = block.warp[w];
        ended += __builtin_popcount(warp.ended), barred += __builtin_popcount(warp.at_barrier);
        waiting += __builtin_popcount(warp.waiting);
        if (!request && warp.waiting) {
            thread = w * kLanes + __builtin_ctz(warp.waiting);
            request = warp.alike ? &warp.asked : &warp.requests[thread % kLanes];
        }
    }
    if (request)
        fail(
            "deadlock in block %u: %d threads wait for their warp, thread %d at %s (mask %08x, %s:%d), %d at a "
            "barrier, "
            "%d have returned",
            blockIdx.x, waiting, thread, name_of(request->operation), request->mask, base_name(request->place.file),
            request->place.line, barred, ended);
    else
        fail("block %u: only %d of %d threads reached %s at %s:%d, %d have returned", blockIdx.x, barred, block.threads,
             name_of(block.meeting.barrier), base_name(block.meeting.place.file), block.meeting.place.line, ended);
}

// Switches to the next runnable thread; to the host if there is none.
void go_on() {
    const int here = static_cast<int>(threadIdx.x);
    int warp = choose_warp(here / kLanes);
    if (warp < 0 && block.meeting.arrived == block.threads) {
        finish_barrier();
        warp = choose_warp(settings.order == shuffled_by_seed ? -1 : settings.order == forward ? 0 : block.warps - 1);
    }
    if (warp < 0) {
        if (block.ended < block.threads) explain_deadlock();
        fibers[here].go_to(host);
        return;
    }
    const int next = warp * kLanes + choose(block.warp[warp].ready);
    if (next == here) return;
    enter(next);
    fibers[here].go_to(fibers[next]);
}

// The fiber's loop over blocks.
void live() {
    for (;;) {
        block.body(block.context);
        Warp& warp = block.warp[threadIdx.x / kLanes];
        const uint32_t bit = 1u << threadIdx.x % kLanes;
        warp.ready &= ~bit, warp.ended |= bit;
        ++block.ended;
        go_on();
    }
}

void start_fibers() {
    if (!stacks) {
        void* memory = mmap(nullptr, kStackBytes * kMaxThreads, PROT_READ | PROT_WRITE,
                            MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
        stacks = static_cast<char*>(memory);
        for (int thread = 0; thread < kMaxThreads; ++thread)
            mprotect(stacks + thread * kStackBytes, kPage, PROT_NONE);  // an overflow ends the process
    }
    // Stacks begin in different sets of the cache, or the threads of a block would drive each other out.
    for (int thread = 0; thread < block.threads; ++thread)
        fibers[thread].start(stacks + thread * kStackBytes, kStackBytes - thread * 5 % 64 * 64, live);
    started = block.threads;
}

void poison(size_t begin, size_t end) {
    for (size_t at = begin; at < end; at += sizeof kPoison) memcpy(arena + at, &kPoison, sizeof kPoison);
}

bool poisoned(size_t begin, size_t end) {
    for (size_t at = begin; at < end; at += sizeof kPoison)
        if (memcmp(arena + at, &kPoison, sizeof kPoison) != 0) return false;
    return true;
}

void check_guards() {
    for (const Piece& piece : block.pieces) {
        const size_t end = piece.begin + (piece.bytes + 3) / 4 * 4;
        if (!poisoned(piece.begin - kGuardBytes, piece.begin) || !poisoned(end, end + kGuardBytes))
            fail("block %u wrote beside its shared memory '%s'", blockIdx.x, piece.name);
    }
}

void run_block(unsigned number) {
    blockIdx = {number, 0, 0};
    block.ended = 0, block.meeting.arrived = 0;
    block.pieces.clear(), block.used = 0;
    for (int w = 0; w < block.warps; ++w) {
        const int lanes = std::min(kLanes, block.threads - w * kLanes);
        block.warp[w].ready = lanes == kLanes ? ~0u : (1u << lanes) - 1;
        block.warp[w].waiting = block.warp[w].at_barrier = block.warp[w].ended = 0;
    }
    const int first = choose_warp(-1) * kLanes;
    const int thread = first + choose(block.warp[first / kLanes].ready);
    enter(thread);
    host.go_to(fibers[thread]);
    if (!block.failed) check_guards();
}

// A permutation of 0..count-1: a step coprime to the count.
struct Permutation {
    uint64_t count, begin, step;
    explicit Permutation(uint64_t n) : count(n), begin(0), step(1) {
        if (settings.order == reverse) begin = n - 1, step = n - 1;
        if (settings.order != shuffled_by_seed) return;
        begin = random_number() % n, step = random_number() % n | 1u;
        while (std::__gcd(step, n) != 1) ++step;
    }
    uint64_t at(uint64_t i) const { return (begin + i * (step % count)) % count; }
};

// Whether all lanes of a request's mask agree; reports an error if not.
bool agree(const Warp& warp, const Request& request) {
    const Request* other = differing(warp, request);
    if (!other) return true;
    fail("warp %u of block %u: threads meet in different places, %s at %s:%d (mask %08x) and %s at %s:%d (mask %08x)",
         threadIdx.x / kLanes, blockIdx.x, name_of(request.operation), base_name(request.place.file),
         request.place.line, request.mask, name_of(other->operation), base_name(other->place.file), other->place.line,
         other->mask);
    return false;
}

}  // namespace

uint64_t at_warp(const Request& request, uint64_t value, int argument) {
    Warp& warp = block.warp[threadIdx.x / kLanes];
    const int lane = threadIdx.x % kLanes;
    const uint32_t bit = 1u << lane;
    if (!(request.mask & bit) || request.mask & warp.ended) {
        fail("thread %u of block %u at %s:%d: the mask %08x of %s %s", threadIdx.x, blockIdx.x,
             base_name(request.place.file), request.place.line, request.mask, name_of(request.operation),
             request.mask & bit ? "names threads that have returned" : "does not name the thread itself");
        abandon();
    }
    ask(&warp, lane, request);
    warp.values[lane] = value, warp.arguments[lane] = argument;
    warp.ready &= ~bit, warp.waiting |= bit;
    if ((warp.waiting & request.mask) == request.mask) {
        if (!agree(warp, request)) abandon();
        complete(&warp, request);
        warp.waiting &= ~request.mask, warp.ready |= request.mask;
    }
    go_on();
    return warp.results[lane];
}

int at_barrier(Barrier barrier, int predicate, Place place) {
    Meeting& meeting = block.meeting;
    if (meeting.arrived == 0) {
        meeting = {barrier, place, 0, 0};
    } else if (meeting.barrier != barrier || meeting.place.line != place.line) {
        fail("block %u: threads meet at different barriers, %s at %s:%d and %s at %s:%d", blockIdx.x,
             name_of(meeting.barrier), base_name(meeting.place.file), meeting.place.line, name_of(barrier),
             base_name(place.file), place.line);
        abandon();
    }
    ++meeting.arrived, meeting.predicates += predicate != 0;
    Warp& warp = block.warp[threadIdx.x / kLanes];
    const uint32_t bit = 1u << threadIdx.x % kLanes;
    warp.ready &= ~bit, warp.at_barrier |= bit;
    go_on();
    return block.result;
}

void* shared(const void* site, size_t bytes, const char* name) {
    for (const Piece& piece : block.pieces)
        if (piece.site == site) return arena + piece.begin;
    const size_t begin = (block.used + kGuardBytes + 127) / 128 * 128, end = begin + (bytes + 3) / 4 * 4 + kGuardBytes;
    size_t total = bytes;
    for (const Piece& piece : block.pieces) total += piece.bytes;
    if (total > kSharedBytes || end > kArenaBytes) {
        fail("%zu bytes of shared memory with '%s': a block has %zu", total, name, kSharedBytes);
        abandon();
    }
    poison(block.used, end);
    block.used = end;
    block.pieces.push_back({site, name, begin, bytes});
    return arena + begin;
}

void run(const char* kernel, int64_t blocks, int threads, void (*body)(const void*), const void* context) {
    static std::mutex one_at_a_time;  // autograd calls from threads of its own
    const std::lock_guard<std::mutex> lock(one_at_a_time);
    block.kernel = kernel, block.body = body, block.context = context;
    block.threads = threads, block.warps = (threads + kLanes - 1) / kLanes;
    if (last_error != cudaSuccess) return;  // as after a real error, nothing runs until the error is queried
    if (blocks < 1 || blocks > INT32_MAX || threads < 1 || threads > kMaxThreads) {
        record(cudaErrorInvalidConfiguration, "launched with %lld blocks of %d threads", static_cast<long long>(blocks),
               threads);
        return;
    }
    ++launches;
    random_state = settings.seed ^ static_cast<uint64_t>(launches);
    if (started != threads || block.failed) start_fibers();
    block.failed = false;
    blockDim = {static_cast<unsigned>(threads), 1, 1}, gridDim = {static_cast<unsigned>(blocks), 1, 1};
    const Permutation order(static_cast<uint64_t>(blocks));
    for (int64_t i = 0; i < blocks && !block.failed; ++i)
        run_block(static_cast<unsigned>(order.at(static_cast<uint64_t>(i))));
}

int fault() { return settings.fault; }

}  // namespace harness

cudaError_t cudaPeekAtLastError() { return harness::last_error; }
cudaError_t cudaGetLastError() { return std::exchange(harness::last_error, cudaSuccess); }
const char* cudaGetErrorString(cudaError_t error) { return error == cudaSuccess ? "no error" : harness::message; }
const char* cudaGetErrorName(cudaError_t error) { return cudaGetErrorString(error); }
cudaError_t cudaGetDevice(int* device) { return *device = 0, cudaSuccess; }
cudaError_t cudaGetDeviceCount(int* count) { return *count = 1, cudaSuccess; }
cudaError_t cudaGetDeviceProperties(cudaDeviceProp* properties, int device) {
    *properties = {"CPU (the tests' harness)", size_t{8} << 30, harness::settings.multiprocessors, 8, 0};
    return cudaSetDevice(device);
}
cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr attribute, int device) {
    *value = attribute == cudaDevAttrMultiProcessorCount      ? harness::settings.multiprocessors
             : attribute == cudaDevAttrComputeCapabilityMajor ? 8
                                                              : 0;
    return cudaSetDevice(device);
}
cudaError_t cudaMemGetInfo(size_t* unused, size_t* total) {
    return *unused = size_t{6} << 30, *total = size_t{8} << 30, cudaSuccess;
}
cudaError_t cudaDriverGetVersion(int* version) { return *version = harness::kCudaVersion, cudaSuccess; }
cudaError_t cudaRuntimeGetVersion(int* version) { return *version = harness::kCudaVersion, cudaSuccess; }

// For the tests.
#define HARNESS_API extern "C" __attribute__((visibility("default")))
HARNESS_API void harness_order(int order, uint64_t seed) {
    harness::settings.order = order, harness::settings.seed = seed;
}
HARNESS_API void harness_multiprocessors(int count) { harness::settings.multiprocessors = count; }
HARNESS_API void harness_fault(int fault) { harness::settings.fault = fault; }
HARNESS_API const char* harness_message() { return harness::message; }
HARNESS_API int64_t harness_launches() { return harness::launches; }
HARNESS_API int64_t harness_switches() { return harness::switches; }
