// Vectors as wide as the registers of the instructions that the file is compiled for. For kernels.cpp alone: the
// types differ from object to object, which an anonymous namespace allows.
#pragma once

#include <stdint.h>

namespace {

#if defined(__AVX512F__)
constexpr int lanes = 16;
#elif defined(__AVX__)
constexpr int lanes = 8;
#else
constexpr int lanes = 4;
#endif

using Floats = float __attribute__((vector_size(4 * lanes)));
using Ints = int32_t __attribute__((vector_size(4 * lanes)));
using Floats4 = float __attribute__((vector_size(16)));

inline Floats load(const float* from) {
    Floats value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
}

inline Floats4 load4(const float* from) {
    Floats4 value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
}

inline Floats as_floats(Ints value) { return __builtin_convertvector(value, Floats); }

// Whole numbers at or below; only for what an int32 holds.
inline Ints floor(Floats value) {
    const Ints cut = __builtin_convertvector(value, Ints);
    return cut + (as_floats(cut) > value);  // true is -1
}

inline Ints clamp(Ints value, int32_t low, int32_t high) {
    const Ints least = Ints{} + low, most = Ints{} + high;
    value = value < least ? least : value;
    return value > most ? most : value;
}

inline Ints bits(Floats value) {
    Ints same;
    __builtin_memcpy(&same, &value, sizeof same);
    return same;
}

inline Floats floats_of_bits(Ints value) {
    Floats same;
    __builtin_memcpy(&same, &value, sizeof same);
    return same;
}

}  // namespace
