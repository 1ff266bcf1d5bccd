// Arrays of numpy, in and out.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <cstdio>
#include <initializer_list>
#include <memory>
#include <string>

#include "bindings.hpp"

namespace echogrid {

template <class T>
using Array1 = nanobind::ndarray<const T, nanobind::ndim<1>, nanobind::c_contig, nanobind::device::cpu>;
template <class T>
using Array2 = nanobind::ndarray<const T, nanobind::ndim<2>, nanobind::c_contig, nanobind::device::cpu>;
// Of a part of an array, to read or to write.
template <class T>
using Layer = nanobind::ndarray<T, nanobind::ndim<2>, nanobind::device::cpu>;
template <class T>
using NewArray = nanobind::ndarray<nanobind::numpy, T>;

// An array of numpy that owns the memory.
template <class T>
NewArray<T> new_array(std::unique_ptr<T[]> values, std::initializer_list<size_t> shape) {
    T* const data = values.get();
    const nanobind::capsule owner(data, [](void* held) noexcept { delete[] static_cast<T*>(held); });
    static_cast<void>(values.release());
    return NewArray<T>(data, shape, owner);
}

// A number as Python's %g writes it.
inline std::string text(double value) {
    char buffer[32];
    std::snprintf(buffer, sizeof buffer, "%.6g", value);
    return buffer;
}

template <class Array>
std::string shape_text(const Array& array) {
    std::string shape;
    for (size_t i = 0; i < array.ndim(); ++i) shape += (i ? " x " : "") + std::to_string(array.shape(i));
    return shape;
}

// How many parts of so many each hold a number of things.
inline size_t parts_of(size_t count, size_t each) { return (count + each - 1) / each; }

template <class Array>
void expect(const char* what, const Array& array, std::initializer_list<size_t> shape) {
    std::string wanted;
    bool same = true;
    size_t i = 0;
    for (const size_t n : shape) {
        wanted += (i ? " x " : "") + std::to_string(n);
        same = same && array.shape(i++) == n;
    }
    if (!same) refuse(std::string(what) + ": found " + shape_text(array) + ", expected " + wanted);
}

}  // namespace echogrid
