// Threads that stay: starting them for each batch costs up to a third more time.
#pragma once

#include <cstddef>

namespace echogrid {

// Calls work(context, part) once for each part in [0, parts), on the calling thread and those of the pool, and
// returns when all are done. Parts are handed out as threads come free, so a part must neither depend on another nor
// on the thread that does it: then the number of threads changes no bit of the result.
//
// Work must not throw and must not touch Python (release the GIL round a run that takes long). A run inside of a
// part, and one while another thread's run goes on, is done by its own thread alone. A forked child starts threads of
// its own.
void run_parts(size_t parts, void (*work)(void* context, size_t part), void* context) noexcept;

// The same for whatever can be called with the number of a part.
template <class Work>
void run_parts(size_t parts, const Work& work) noexcept {
    run_parts(
        parts, [](void* context, size_t part) { (*static_cast<const Work*>(context))(part); },
        const_cast<void*>(static_cast<const void*>(&work)));
}

// How many threads, the calling one among them, a run uses; from the start as many as the process may run on.
size_t threads() noexcept;

// Sets it; at least 1 and at most max_threads. Waits for a run that goes on.
void set_threads(size_t count) noexcept;

inline constexpr size_t max_threads = 256;

}  // namespace echogrid
