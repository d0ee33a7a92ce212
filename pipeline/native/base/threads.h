// One pool of worker threads for every kernel. Workers sleep when idle.
//
// Kernel files (compiled per ISA) may include this: no std templates, and the wrapper below has internal linkage.
#pragma once

#include <cstdint>

namespace splat {

// A task: called with each index of 0..count-1 exactly once, on any thread.
using TaskFunction = void (*)(void* context, int64_t index);

// Threads that take part in parallel_for, the caller included; clamped to 1..256. Takes effect at the next
// parallel_for.
void set_threads(int threads);
int thread_count();

// Run task(context, i) for i in 0..count-1 and return when all are done. Indices are handed out one by one, so make
// each worth about 10 µs. During the call denormals are flushed to zero on every thread; the caller's mode is restored.
// A nested call, and a call while another thread is inside, runs on the calling thread alone. The first exception is
// rethrown here once no thread is inside any more.
void run_parallel(int64_t count, TaskFunction task, void* context);

// The same for a callable: parallel_for(n, [&](int64_t i) {...}).
template <class Callable>
static inline void parallel_for(int64_t count, const Callable& body) {
    struct Call {
        static void run(void* context, int64_t index) { (*static_cast<const Callable*>(context))(index); }
    };
    run_parallel(count, &Call::run, const_cast<Callable*>(&body));
}

// Flushes denormals to zero on this thread during its lifetime: they cost a factor of seven in narrow Gaussians' tails.
class FlushDenormals {
  public:
    FlushDenormals();
    ~FlushDenormals();
    FlushDenormals(const FlushDenormals&) = delete;
    FlushDenormals& operator=(const FlushDenormals&) = delete;

  private:
    uint64_t saved_;
};

}  // namespace splat
