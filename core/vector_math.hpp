// Functions of vectors: what the kernels of the networks reckon with. For kernels.cpp alone, as vectors.hpp.
#pragma once

#include "vectors.hpp"

// What vector types cannot say. Of AVX-512 in the forms that name the lanes left out: the others read, by name only,
// what was never set, which compilers warn of.
#if defined(__SSE__)
#include <immintrin.h>
#endif

namespace {

using Doubles = double __attribute__((vector_size(lanes * sizeof(double))));
using Longs = int64_t __attribute__((vector_size(lanes * sizeof(int64_t))));

// While it lives, numbers too small to be normal count as zero: they cost a hundred times what others do.
class Flushing {
   public:
#if defined(__SSE__)
    Flushing() : before_(_mm_getcsr()) { _mm_setcsr(before_ | 0x8040U); }
    ~Flushing() { _mm_setcsr(before_); }

   private:
    unsigned before_;
#elif defined(__aarch64__)
    Flushing() {
        __asm__ volatile("mrs %0, fpcr" : "=r"(before_));
        const uint64_t flushed = before_ | (uint64_t{1} << 24);
        __asm__ volatile("msr fpcr, %0" : : "r"(flushed));
    }
    ~Flushing() { __asm__ volatile("msr fpcr, %0" : : "r"(before_)); }

   private:
    uint64_t before_;
#else
    Flushing() {}
    ~Flushing() {}
#endif
   public:
    Flushing(const Flushing&) = delete;
    Flushing& operator=(const Flushing&) = delete;
};

template <typename V, typename T>
inline V loaded(const T* from) {
    V value;
    __builtin_memcpy(&value, from, sizeof value);
    return value;
}

template <typename V, typename T>
inline void store(T* to, V value) {
    __builtin_memcpy(to, &value, sizeof value);
}

inline Floats all(float value) { return value - Floats{}; }
inline Ints all_ints(int32_t value) { return value - Ints{}; }

template <typename V>
inline V larger(V a, V b) {
    return a > b ? a : b;
}

template <typename V>
inline V smaller(V a, V b) {
    return a < b ? a : b;
}

#if defined(__AVX512F__)
// GCC makes two instructions of what is one.
inline Floats larger(Floats a, Floats b) { return (Floats)_mm512_maskz_max_ps(0xffff, (__m512)a, (__m512)b); }
inline Floats smaller(Floats a, Floats b) { return (Floats)_mm512_maskz_min_ps(0xffff, (__m512)a, (__m512)b); }
#endif

inline Floats larger(Floats a, float b) { return larger(a, all(b)); }
inline Floats smaller(Floats a, float b) { return smaller(a, all(b)); }
inline Floats within(Floats a, float low, float high) { return smaller(larger(a, low), high); }

inline Floats absolute(Floats a) { return (Floats)((Ints)a & 0x7fffffff); }

template <typename M>
inline bool any(M mask) {
    M folded = mask;
    bool found = false;
    for (int k = 0; k < lanes; ++k) found |= folded[k] != 0;
    return found;
}

inline Ints whole(Floats a) { return __builtin_convertvector(a, Ints); }
inline Floats narrowed(Doubles a) { return __builtin_convertvector(a, Floats); }

// 0, 1, 2, ...
inline Ints counted() {
    Ints value;
    for (int k = 0; k < lanes; ++k) value[k] = k;
    return value;
}

inline Floats root(Floats a) {
#if defined(__AVX512F__)
    return (Floats)_mm512_maskz_sqrt_ps(0xffff, (__m512)a);
#elif defined(__AVX2__)
    return (Floats)_mm256_sqrt_ps((__m256)a);
#elif defined(__SSE2__)
    return (Floats)_mm_sqrt_ps((__m128)a);
#else
    Floats value;
    for (int k = 0; k < lanes; ++k) value[k] = __builtin_sqrtf(a[k]);
    return value;
#endif
}

inline Doubles root(Doubles a) {
    Doubles value;
    for (int k = 0; k < lanes; ++k) value[k] = __builtin_sqrt(a[k]);
    return value;
}

// Of two vectors, one behind the other: all at even places, and all at odd ones; and back again, one from each in
// turn.
#if defined(__AVX512F__)
inline Floats evens(Floats a, Floats b) {
    return __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 26, 28, 30);
}
inline Floats odds(Floats a, Floats b) {
    return __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15, 17, 19, 21, 23, 25, 27, 29, 31);
}
inline Floats firsts(Floats a, Floats b) {
    return __builtin_shufflevector(a, b, 0, 16, 1, 17, 2, 18, 3, 19, 4, 20, 5, 21, 6, 22, 7, 23);
}
inline Floats lasts(Floats a, Floats b) {
    return __builtin_shufflevector(a, b, 8, 24, 9, 25, 10, 26, 11, 27, 12, 28, 13, 29, 14, 30, 15, 31);
}
#elif defined(__AVX2__)
inline Floats evens(Floats a, Floats b) { return __builtin_shufflevector(a, b, 0, 2, 4, 6, 8, 10, 12, 14); }
inline Floats odds(Floats a, Floats b) { return __builtin_shufflevector(a, b, 1, 3, 5, 7, 9, 11, 13, 15); }
inline Floats firsts(Floats a, Floats b) { return __builtin_shufflevector(a, b, 0, 8, 1, 9, 2, 10, 3, 11); }
inline Floats lasts(Floats a, Floats b) { return __builtin_shufflevector(a, b, 4, 12, 5, 13, 6, 14, 7, 15); }
#else
inline Floats evens(Floats a, Floats b) { return __builtin_shufflevector(a, b, 0, 2, 4, 6); }
inline Floats odds(Floats a, Floats b) { return __builtin_shufflevector(a, b, 1, 3, 5, 7); }
inline Floats firsts(Floats a, Floats b) { return __builtin_shufflevector(a, b, 0, 4, 1, 5); }
inline Floats lasts(Floats a, Floats b) { return __builtin_shufflevector(a, b, 2, 6, 3, 7); }
#endif

// Two vectors in one; both are as wide as half the other.
template <typename V>
inline auto joined(V a, V b) {
    constexpr int N = sizeof(V) / sizeof(double);
    if constexpr (N == 2)
        return __builtin_shufflevector(a, b, 0, 1, 2, 3);
    else
        return __builtin_shufflevector(a, b, 0, 1, 2, 3, 4, 5, 6, 7);
}

using Pair = double __attribute__((vector_size(2 * sizeof(double))));  // each of two floats

template <int N>
inline auto gathered(const float* table, const uint32_t* at) {
    if constexpr (N == 2)
        return Pair{loaded<double>(table + at[0]), loaded<double>(table + at[1])};
    else
        return joined(gathered<N / 2>(table, at), gathered<N / 2>(table, at + N / 2));
}

// Of pairs of neighbours that begin at places of a table, all the first and all the second. A pair is loaded at once,
// as if it were a double: faster than what gathers, and not slower where there is no such instruction.
inline void pairs_at(const float* table, const uint32_t* places, Floats& first, Floats& second) {
    const Floats a = (Floats)gathered<lanes / 2>(table, places);
    const Floats b = (Floats)gathered<lanes / 2>(table, places + lanes / 2);
    first = evens(a, b), second = odds(a, b);
}

inline Floats at_each(const float* table, const uint32_t* places) {
    Floats value;
    for (int k = 0; k < lanes; ++k) value[k] = table[places[k]];
    return value;
}

// e^a to 1e-7 of it, for a up to 88; what is below 1e-37 may be any number up to that.
inline Floats exponential(Floats a) {
    constexpr float ROUND = 12582912.0F;
    a = within(a, -87.0F, 88.0F);
    const Floats shifted = a * 1.44269504F + ROUND;
    const Floats n = shifted - ROUND;
    const Floats r = (a - n * 0.693145752F) - n * 1.42860677e-6F;
    const Floats q =
        (((0.00139336435F * r + 0.00836317557F) * r + 0.0416664650F) * r + 0.166665770F) * r + 0.500000001F;
    const Floats e = (q * r + 1.0F) * r + 1.0F;
    return (Floats)((Ints)e + ((Ints)shifted << 23));
}

// ln a to 1e-7, or 1e-7 of it; a is positive and normal.
inline Floats logarithm(Floats a) {
    const Ints rise = (bits(a) - 0x3f3504f3) >> 23;
    const Floats t = (Floats)(bits(a) - (rise << 23)) - 1.0F;
    Floats q = 0.0927221429F * t - 0.141184249F;
    q = q * t + 0.146763966F;
    q = q * t - 0.165928563F;
    q = q * t + 0.199851278F;
    q = q * t - 0.250009217F;
    q = q * t + 0.333334103F;
    const Floats n = as_floats(rise);
    return n * 0.693145752F + ((q * t - 0.5F) * t * t + (t + n * 1.42860677e-6F));
}

inline Floats hyperbolic_tangent(Floats a) {
    return 1.0F - 2.0F / (exponential(2.0F * within(a, -9.0F, 9.0F)) + 1.0F);
}

// Angle of points, rad, to 1e-15; 0 of the origin.
inline Doubles angle_of(Doubles y, Doubles x) {
    constexpr double HALF_TURN = 3.14159265358979324;
    const Doubles across = y < 0.0 ? -y : y;
    const Doubles along = x < 0.0 ? -x : x;
    const Doubles high = larger(across, along);
    const Doubles tangent = smaller(across, along) / (high > 0.0 ? high : Doubles{} + 1.0);
    const Longs steep = tangent > 0.41421356237309505;
    const Doubles t = steep ? (tangent - 1.0) / (tangent + 1.0) : tangent;
    const Doubles z = t * t;
    Doubles q = -0.025312105714875049 * z + 0.050245721855782126;
    q = q * z - 0.065059707576092654;
    q = q * z + 0.076735420936666590;
    q = q * z - 0.090895315559759882;
    q = q * z + 0.11111049006149415;
    q = q * z - 0.14285712668743028;
    q = q * z + 0.19999999978542193;
    q = q * z - 0.33333333333222515;
    Doubles a = q * z * t + t;
    a = steep ? a + HALF_TURN / 4 : a;
    a = across > along ? HALF_TURN / 2 - a : a;
    a = x < 0.0 ? HALF_TURN - a : a;
    return y < 0.0 ? -a : a;
}

// The nearest whole number.
inline Doubles rounded(Doubles a) {
    constexpr double ROUND = 6755399441055744.0;
    return (a + ROUND) - ROUND;
}

}  // namespace
