#include "base/threads.h"

#include <pthread.h>

#include <algorithm>
#include <atomic>
#include <condition_variable>
#include <exception>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

#if defined(__x86_64__)
#include <xmmintrin.h>
#endif

namespace splat {

#if defined(__x86_64__)
FlushDenormals::FlushDenormals() : saved_(_mm_getcsr()) {
    _mm_setcsr(static_cast<unsigned>(saved_) | 0x8040u);  // FTZ, DAZ
}
FlushDenormals::~FlushDenormals() { _mm_setcsr(static_cast<unsigned>(saved_)); }
#elif defined(__aarch64__)
FlushDenormals::FlushDenormals() {
    __asm__ volatile("mrs %0, fpcr" : "=r"(saved_));
    __asm__ volatile("msr fpcr, %0" : : "r"(saved_ | (uint64_t{1} << 24)));  // FZ
}
FlushDenormals::~FlushDenormals() { __asm__ volatile("msr fpcr, %0" : : "r"(saved_)); }
#else
FlushDenormals::FlushDenormals() : saved_(0) {}
FlushDenormals::~FlushDenormals() = default;
#endif

namespace {

constexpr int kMaxThreads = 256;

// Work that is being handed out. Each thread takes part until no index is left.
struct Job {
    TaskFunction task;
    void* context;
    int64_t count;
    std::atomic<int64_t> next{0};
    std::mutex error_mutex;
    std::exception_ptr error;

    void take_part() {
        try {
            for (int64_t i; (i = next.fetch_add(1, std::memory_order_relaxed)) < count;) task(context, i);
        } catch (...) {
            next = count;
            std::lock_guard<std::mutex> lock(error_mutex);
            if (!error) error = std::current_exception();
        }
    }
};

thread_local bool inside_job = false;

class Pool {
  public:
    explicit Pool(int workers) {
        try {
            for (int i = 0; i < workers; ++i) workers_.emplace_back([this] { work(); });
        } catch (...) {  // no more threads available
            end();
            throw;
        }
    }

    ~Pool() { end(); }

    int workers() const { return static_cast<int>(workers_.size()); }

    void run(Job& job) {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            job_ = &job;
            ++generation_;
        }
        wake_.notify_all();
        job.take_part();
        std::unique_lock<std::mutex> lock(mutex_);
        job_ = nullptr;  // workers that have not woken by now are no longer needed
        done_.wait(lock, [this] { return busy_ == 0; });
    }

  private:
    void work() {
        FlushDenormals flush;
        inside_job = true;  // nested calls run on this thread
        uint64_t seen = 0;
        std::unique_lock<std::mutex> lock(mutex_);
        while (true) {
            wake_.wait(lock, [&] { return stop_ || (job_ && generation_ != seen); });
            if (stop_) return;
            seen = generation_;
            Job* job = job_;
            ++busy_;
            lock.unlock();
            job->take_part();
            lock.lock();
            if (--busy_ == 0) done_.notify_one();
        }
    }

    void end() {
        {
            std::lock_guard<std::mutex> lock(mutex_);
            stop_ = true;
        }
        wake_.notify_all();
        for (auto& worker : workers_) worker.join();
    }

    std::mutex mutex_;
    std::condition_variable wake_, done_;
    std::vector<std::thread> workers_;
    Job* job_ = nullptr;
    uint64_t generation_ = 0;
    int busy_ = 0;
    bool stop_ = false;
};

std::atomic<int> wanted_threads{0};  // 0: all that the machine has
// Held while a job runs. Both are pointers and never destroyed: a forked child replaces them (it has copies of threads
// that do not exist), and no destructor joins threads while the process ends.
std::mutex* pool_mutex = new std::mutex;
Pool* pool = nullptr;

void forget_pool_in_child() {
    pool_mutex = new std::mutex;
    pool = nullptr;
    inside_job = false;
}

// A pool of the given number of workers, or null if no threads are available. Call with pool_mutex held.
Pool* pool_of(int workers) {
    if (pool && pool->workers() == workers) return pool;
    delete pool;
    pool = nullptr;
    try {
        pool = new Pool(workers);
    } catch (const std::system_error&) {
    }
    return pool;
}

void run_job(Job& job) {
    const bool before = inside_job;
    inside_job = true;
    const int workers = thread_count() - 1;
    if (!before && workers > 0 && job.count > 1 && pool_mutex->try_lock()) {
        std::lock_guard<std::mutex> lock(*pool_mutex, std::adopt_lock);
        if (Pool* helpers = pool_of(workers)) helpers->run(job);
    }
    job.take_part();  // whatever is left
    inside_job = before;
}

}  // namespace

void set_threads(int threads) { wanted_threads = std::clamp(threads, 1, kMaxThreads); }

int thread_count() {
    const int wanted = wanted_threads;
    return wanted ? wanted : std::clamp(static_cast<int>(std::thread::hardware_concurrency()), 1, kMaxThreads);
}

void run_parallel(int64_t count, TaskFunction task, void* context) {
    static const int registered = pthread_atfork(nullptr, nullptr, forget_pool_in_child);
    (void)registered;
    FlushDenormals flush;
    Job job{task, context, count, {}, {}, {}};
    run_job(job);
    if (job.error) std::rethrow_exception(job.error);
}

}  // namespace splat
