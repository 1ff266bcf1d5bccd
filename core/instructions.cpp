#include "instructions.hpp"

#include <cstdlib>
#include <span>

#if defined(__x86_64__)
#include <cpuid.h>
#endif

namespace echogrid {
namespace {

#if defined(__x86_64__)

// What the processor says of itself. (__builtin_cpu_supports would tell, but says no to everything when built by
// zig.)
struct Cpu {
    unsigned basic = 0, extended = 0, structured = 0;  // ECX of leaf 1, ECX of 0x80000001, EBX of leaf 7
    unsigned long long saved = 0;                      // registers that the system saves: XCR0
};

Cpu ask_cpu() {
    Cpu cpu;
    unsigned a = 0, b = 0, c = 0, d = 0;
    if (__get_cpuid(1, &a, &b, &c, &d)) cpu.basic = c;
    if (__get_cpuid(0x80000001, &a, &b, &c, &d)) cpu.extended = c;
    if (__get_cpuid_count(7, 0, &a, &b, &c, &d)) cpu.structured = b;
    if (cpu.basic & bit_OSXSAVE) {
        unsigned low = 0, high = 0;
        __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
        cpu.saved = (static_cast<unsigned long long>(high) << 32) | low;
    }
    return cpu;
}

constexpr bool all(unsigned long long held, unsigned long long wanted) { return (held & wanted) == wanted; }

// The levels of the psABI of x86-64: https://gitlab.com/x86-psABIs/x86-64-ABI
int level_of_this_machine() {
    constexpr unsigned long long ymm = 0x6, zmm = 0xe6;
    const Cpu cpu = ask_cpu();
    if (!all(cpu.basic, bit_CMPXCHG16B | bit_POPCNT | bit_SSE3 | bit_SSE4_1 | bit_SSE4_2 | bit_SSSE3)) return 1;
    if (!all(cpu.basic, bit_AVX | bit_F16C | bit_FMA | bit_MOVBE | bit_OSXSAVE) ||
        !all(cpu.structured, bit_AVX2 | bit_BMI | bit_BMI2) || !all(cpu.extended, bit_LZCNT) || !all(cpu.saved, ymm))
        return 2;
    if (!all(cpu.structured, bit_AVX512F | bit_AVX512BW | bit_AVX512CD | bit_AVX512DQ | bit_AVX512VL) ||
        !all(cpu.saved, zmm))
        return 3;
    return 4;
}

// Those that this machine can run, the best last.
std::span<const Kernels* const> kernels_that_run() {
    static const Kernels* const all_kernels[] = {&echogrid_kernels_v2, &echogrid_kernels_v3, &echogrid_kernels_v4};
    return std::span(all_kernels).first(static_cast<size_t>(level_of_this_machine() - 1));
}

#else

std::span<const Kernels* const> kernels_that_run() {
#if defined(__aarch64__)
    static const Kernels* const all_kernels[] = {&echogrid_kernels_neon};
#else
    static const Kernels* const all_kernels[] = {&echogrid_kernels_baseline};
#endif
    return all_kernels;
}

#endif

}  // namespace

const Kernels* choose_kernels(std::string& why_not) {
    const auto able = kernels_that_run();
    if (able.empty()) {
        why_not = "echogrid: found a processor without SSE 4.2, expected x86-64-v2 or newer";
        return nullptr;
    }
    const char* wanted = std::getenv("ECHOGRID_INSTRUCTIONS");
    if (!wanted || !*wanted) return able.back();
    std::string names;
    for (const Kernels* kernels : able) {
        if (kernels->variant == std::string(wanted)) return kernels;
        names += (names.empty() ? "" : ", ") + std::string(kernels->variant);
    }
    why_not = "ECHOGRID_INSTRUCTIONS: found " + std::string(wanted) + ", expected what this machine has: " + names;
    return nullptr;
}

}  // namespace echogrid
