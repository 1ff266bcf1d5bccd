// Runs of many short parts: each must be done once, and all of them before the run ends. 0 if they were.
#include "pool.hpp"

#include <cstdio>
#include <vector>

int main() {
    constexpr size_t parts = 200000, runs = 20;
    for (size_t run = 0; run < runs; ++run) {
        echogrid::set_threads(1 + run % 5);
        std::vector<unsigned char> done(parts);
        echogrid::run_parts(parts, [&](size_t part) { ++done[part]; });
        for (size_t part = 0; part < parts; ++part) {
            if (done[part] != 1) return std::printf("run %zu: part %zu done %d times\n", run, part, done[part]), 1;
        }
        // So few that some threads come when nothing is left.
        for (size_t few = 0; few < 2000; ++few) {
            size_t found[3] = {};
            echogrid::run_parts(3, [&](size_t part) { ++found[part]; });
            if (found[0] != 1 || found[1] != 1 || found[2] != 1) return std::printf("run %zu: a part of 3\n", run), 1;
        }
    }
    return 0;
}
