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

inline Floats load(const float* from) {
    Floats value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
}

inline Floats as_floats(Ints value) { return __builtin_convertvector(value, Floats); }

inline Floats clamp(Floats value, float low, float high) {
    const Floats least = Floats{} + low, most = Floats{} + high;
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
