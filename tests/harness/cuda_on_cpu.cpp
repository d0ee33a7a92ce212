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
constexpr int kMaxTogether = 40;  // blocks of a cooperative launch
constexpr int kMaxFibers = kMaxTogether * kMaxThreads / 4;
constexpr int kDevices = 2;
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

// The block that runs.
struct Block {
    const char* kernel;
    void (*body)(const void*);
    const void* context;
    int threads, warps, ended;
    bool together;  // with all others of its launch, which may wait for each other
    bool failed;
    Warp warp[kMaxWarps];
    Meeting meeting;
    int result;  // of the last barrier
    std::vector<Piece> pieces;
    size_t used;
};

Settings settings;
Block block;
Fiber host, all_fibers[kMaxFibers];
Fiber* fibers = all_fibers;  // the block's
int started = 0;             // fibers that have a stack
char* stacks = nullptr;
alignas(256) char arenas[kMaxTogether][kArenaBytes];
char* arena = arenas[0];  // the block's
cudaError_t last_error = cudaSuccess;
char message[1024] = "";
int64_t launches = 0, switches = 0, switches_alone = 0;
int64_t used[kDevices] = {};  // launches and other work
thread_local int current_device = 0;
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
    static const char* const names[] = {"__syncthreads", "__syncthreads_count", "__syncthreads_or", "__syncthreads_and",
                                        "sync_grid"};
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

bool all_have_met() { return block.meeting.arrived == block.threads; }
bool waits_for_grid() { return all_have_met() && block.meeting.barrier == Barrier::grid; }

// The warp that runs first after a barrier.
int pass_barrier() {
    finish_barrier();
    return choose_warp(settings.order == shuffled_by_seed ? -1 : settings.order == forward ? 0 : block.warps - 1);
}

// Switches to the next runnable thread; to the host if there is none.
void go_on() {
    const int here = static_cast<int>(threadIdx.x);
    int warp = choose_warp(here / kLanes);
    if (warp < 0 && all_have_met() && !waits_for_grid()) warp = pass_barrier();
    if (warp < 0) {
        if (block.ended < block.threads && !waits_for_grid()) explain_deadlock();
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

void start_fibers(int count) {
    if (!stacks) {
        void* memory = mmap(nullptr, kStackBytes * kMaxFibers, PROT_READ | PROT_WRITE,
                            MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
        stacks = static_cast<char*>(memory);
    }
    for (int thread = 0; thread < count; ++thread) {
        char* stack = stacks + thread * kStackBytes;
        mprotect(stack, kPage, PROT_NONE);  // an overflow ends the process
        // Stacks begin in different sets of the cache, or the threads of a block would drive each other out.
        all_fibers[thread].start(stack, kStackBytes - thread * 5 % 64 * 64, live);
    }
    started = count;
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

// Runs the block from a warp on, to its end or to the grid's barrier.
void run_from(int warp) {
    const int thread = warp * kLanes + choose(block.warp[warp].ready);
    enter(thread);
    host.go_to(fibers[thread]);
    if (!block.failed && block.ended == block.threads) check_guards();
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
    run_from(choose_warp(-1));
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

// The blocks of a cooperative launch, each with fibers and shared memory of its own: in turns, all of them up to the
// grid's next barrier, before the first goes on.
void run_together(int count) {
    std::vector<Block> blocks(static_cast<size_t>(count), block);
    for (bool begun = false;; begun = true) {
        const Permutation order(static_cast<uint64_t>(count));
        int ended = 0;
        const Meeting* met = nullptr;
        for (int i = 0; i < count; ++i) {
            const auto number = static_cast<unsigned>(order.at(static_cast<uint64_t>(i)));
            fibers = all_fibers + number * block.threads, arena = arenas[number];
            block = blocks[number], blockIdx = {number, 0, 0};
            if (begun)
                run_from(pass_barrier());
            else
                run_block(number);
            if (block.failed) return;
            blocks[number] = block;
            ended += block.ended == block.threads;
            const Meeting& meeting = blocks[number].meeting;
            if (block.ended < block.threads && met && met->place.line != meeting.place.line)
                return fail("blocks meet at different barriers of the grid, %s:%d and %s:%d",
                            base_name(met->place.file), met->place.line, base_name(meeting.place.file),
                            meeting.place.line);
            if (block.ended < block.threads) met = &meeting;
        }
        if (ended == count) return;
        if (ended > 0)
            return fail("%d of %d blocks have returned, and the others wait for the grid at %s:%d", ended, count,
                        base_name(met->place.file), met->place.line);
    }
}

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
    if (barrier == Barrier::grid && !block.together) {
        fail("block %u waits for the grid at %s:%d in a launch that is not cooperative", blockIdx.x,
             base_name(place.file), place.line);
        abandon();
    }
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

void run(const char* kernel, int64_t blocks, int threads, bool together, void (*body)(const void*),
         const void* context) {
    static std::mutex one_at_a_time;  // autograd calls from threads of its own
    const std::lock_guard<std::mutex> lock(one_at_a_time);
    block.kernel = kernel, block.body = body, block.context = context, block.together = together;
    block.threads = threads, block.warps = (threads + kLanes - 1) / kLanes;
    if (last_error != cudaSuccess) return;  // as after a real error, nothing runs until the error is queried
    if (blocks < 1 || blocks > INT32_MAX || threads < 1 || threads > kMaxThreads) {
        record(cudaErrorInvalidConfiguration, "launched with %lld blocks of %d threads", static_cast<long long>(blocks),
               threads);
        return;
    }
    if (together && (blocks > settings.multiprocessors * together_each() || blocks * threads > kMaxFibers)) {
        record(cudaErrorCooperativeLaunchTooLarge, "%lld blocks do not fit on the device together",
               static_cast<long long>(blocks));
        return;
    }
    ++launches, ++used[current_device];
    random_state = settings.seed * 0xd1342543de82ef95u + static_cast<uint64_t>(launches);
    const int needed = together ? static_cast<int>(blocks) * threads : threads;
    if (started < needed || block.failed) start_fibers(needed);
    block.failed = false;
    blockDim = {static_cast<unsigned>(threads), 1, 1}, gridDim = {static_cast<unsigned>(blocks), 1, 1};
    const int64_t before = switches;
    if (together) {
        run_together(static_cast<int>(blocks));
        fibers = all_fibers, arena = arenas[0];
    } else {
        const Permutation order(static_cast<uint64_t>(blocks));
        for (int64_t i = 0; i < blocks && !block.failed; ++i)
            run_block(static_cast<unsigned>(order.at(static_cast<uint64_t>(i))));
    }
    if (blocks == 1) switches_alone += switches - before;
}

int fault() { return settings.fault; }
int together_each() { return 2 * settings.multiprocessors <= kMaxTogether ? 2 : 1; }

}  // namespace harness

cudaError_t cudaPeekAtLastError() { return harness::last_error; }
cudaError_t cudaGetLastError() { return std::exchange(harness::last_error, cudaSuccess); }
const char* cudaGetErrorString(cudaError_t error) { return error == cudaSuccess ? "no error" : harness::message; }
const char* cudaGetErrorName(cudaError_t error) { return cudaGetErrorString(error); }
cudaError_t cudaGetDevice(int* device) { return *device = harness::current_device, cudaSuccess; }
cudaError_t cudaGetDeviceCount(int* count) { return *count = harness::kDevices, cudaSuccess; }
static cudaError_t is_device(int device) {
    return device >= 0 && device < harness::kDevices ? cudaSuccess : cudaErrorInvalidDevice;
}
cudaError_t cudaSetDevice(int device) {
    if (const cudaError_t error = is_device(device)) return error;
    return harness::current_device = device, cudaSuccess;
}
cudaError_t cudaMemsetAsync(void* at, int value, size_t bytes, cudaStream_t) {
    ++harness::used[harness::current_device];
    if (bytes > 0) memset(at, value, bytes);
    return cudaSuccess;
}
cudaError_t cudaGetDeviceProperties(cudaDeviceProp* properties, int device) {
    *properties = {"CPU (the tests' harness)", size_t{8} << 30, harness::settings.multiprocessors, 8, 0};
    return is_device(device);
}
cudaError_t cudaDeviceGetAttribute(int* value, cudaDeviceAttr attribute, int device) {
    *value = attribute == cudaDevAttrMultiProcessorCount      ? harness::settings.multiprocessors
             : attribute == cudaDevAttrComputeCapabilityMajor ? 8
                                                              : 0;
    return is_device(device);
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
HARNESS_API int64_t harness_switches_alone() { return harness::switches_alone; }  // in launches of one block
HARNESS_API int64_t harness_used(int device) { return harness::used[device]; }
