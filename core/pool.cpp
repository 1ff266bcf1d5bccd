#include "pool.hpp"

#include <pthread.h>
#if defined(__linux__)
#include <sched.h>
#endif

#include <algorithm>
#include <atomic>
#include <chrono>
#include <condition_variable>
#include <mutex>
#include <system_error>
#include <thread>
#include <vector>

namespace echogrid {
namespace {

// Whether this thread does a part of a run: what it runs then is done by itself.
thread_local bool inside = false;

// One run often follows the other at once, and to sleep and be woken takes longer than many a run.
constexpr std::chrono::microseconds a_little{50};

template <typename Condition>
void wait_a_little(const Condition& met) noexcept {
    const auto end = std::chrono::steady_clock::now() + a_little;
    while (!met() && std::chrono::steady_clock::now() < end) {
    }
}

struct Run {
    size_t parts;
    void (*work)(void* context, size_t part);
    void* context;
    std::atomic<size_t> next{0};

    void help() noexcept {
        for (size_t part; (part = next.fetch_add(1, std::memory_order_relaxed)) < parts;) work(context, part);
    }
};

class Pool {
   public:
    explicit Pool(size_t count) : wanted_(count) {}

    // Takes no lock: a forked child asks, and nobody would let go of a lock there.
    size_t threads() const noexcept { return wanted_; }

    void set_threads(size_t count) noexcept {
        const std::lock_guard one_run(running_);
        stop();
        wanted_ = count;
    }

    void run(Run& run) noexcept {
        const std::unique_lock one_run(running_, std::try_to_lock);
        if (run.parts < 2 || !one_run.owns_lock()) return run.help();
        start();
        {
            const std::lock_guard lock(mutex_);
            run_ = &run;
            calls_ = std::min(helpers_.size(), run.parts - 1);
        }
        called_.notify_all();
        inside = true;
        run.help();
        inside = false;
        wait_a_little([this] { return helping_ == 0; });
        std::unique_lock lock(mutex_);
        calls_ = 0;  // who has not come yet need not
        left_.wait(lock, [this] { return helping_ == 0; });
        run_ = nullptr;
    }

   private:
    void start() noexcept {
        try {
            while (helpers_.size() + 1 < wanted_) helpers_.emplace_back([this] { help(); });
        } catch (const std::system_error&) {
            // A system that gives no more threads gets its result from those there are.
        }
    }

    void stop() noexcept {
        {
            const std::lock_guard lock(mutex_);
            stopping_ = true;
        }
        called_.notify_all();
        for (auto& helper : helpers_) helper.join();
        helpers_.clear();
        stopping_ = false;
    }

    void help() noexcept {
        inside = true;
        for (;;) {
            wait_a_little([this] { return calls_ > 0 || stopping_; });
            std::unique_lock lock(mutex_);
            called_.wait(lock, [this] { return calls_ > 0 || stopping_; });
            if (stopping_) return;
            --calls_;
            ++helping_;
            Run* run = run_;
            lock.unlock();
            run->help();
            lock.lock();
            if (--helping_ == 0) left_.notify_one();
        }
    }

    std::mutex running_;  // held by the one run
    std::atomic<size_t> wanted_;
    std::mutex mutex_;  // of all below
    std::condition_variable called_, left_;
    std::vector<std::thread> helpers_;  // changed by the one run alone
    Run* run_ = nullptr;
    std::atomic<size_t> calls_ = 0, helping_ = 0;  // changed with the mutex alone, but looked at without
    std::atomic<bool> stopping_ = false;
};

// Never deleted: threads that wait at the end of the process end with it.
std::atomic<Pool*> the_pool{nullptr};

size_t processors() noexcept {
    size_t count = std::thread::hardware_concurrency();
#if defined(__linux__)
    cpu_set_t set;
    if (sched_getaffinity(0, sizeof set, &set) == 0) count = static_cast<size_t>(CPU_COUNT(&set));
#endif
    return std::clamp(count, size_t{1}, max_threads);
}

// A child has the memory of its parent but none of its threads, and maybe a lock that one of them held.
void forget_threads() noexcept {
    inside = false;
    the_pool = new Pool(the_pool.load()->threads());
}

Pool& pool() noexcept {
    static const bool made = [] {
        the_pool = new Pool(processors());
        return pthread_atfork(nullptr, nullptr, forget_threads) == 0;
    }();
    static_cast<void>(made);
    return *the_pool.load();
}

}  // namespace

void run_parts(size_t parts, void (*work)(void* context, size_t part), void* context) noexcept {
    Run run{parts, work, context};
    if (inside) return run.help();
    pool().run(run);
}

size_t threads() noexcept { return pool().threads(); }

void set_threads(size_t count) noexcept { pool().set_threads(std::clamp(count, size_t{1}, max_threads)); }

}  // namespace echogrid
