// What echoes say of the cells along rays.
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>

#include <cmath>
#include <cstdint>
#include <utility>

#include "arrays.hpp"
#include "bindings.hpp"

namespace nb = nanobind;

namespace echogrid {
namespace {

// What a ray begins at and where it leads, in cells of the map.
struct Ray {
    double x, y, along_x, along_y;

    // Adds to the cells of its points.
    void add(double first, double step, int64_t count, double change, const Layer<double>& cells) const {
        const auto rows = static_cast<double>(cells.shape(0)), cols = static_cast<double>(cells.shape(1));
        const int64_t row_stride = cells.stride(0), col_stride = cells.stride(1);
        for (int64_t i = 0; i < count; ++i) {
            const double radius = first + static_cast<double>(i) * step;
            const double col = x + radius * along_x, row = y + radius * along_y;
            if (col >= 0 && row >= 0 && col < cols && row < rows)
                cells.data()[static_cast<int64_t>(row) * row_stride + static_cast<int64_t>(col) * col_stride] +=
                    change;
        }
    }
};

// See _core.pyi.
void add_rays(const Array2<double>& from, const Array2<double>& angles, const Array1<double>& first, double step,
              const Array1<int64_t>& counts, double change, std::pair<double, double> corner, double cell,
              const Layer<double>& cells) {
    const size_t n = from.shape(0), bearings = angles.shape(1);
    expect("from", from, {n, 2});
    expect("angles", angles, {n, bearings});
    expect("first", first, {n});
    expect("counts", counts, {n});
    if (!(cell > 0 && std::isfinite(cell))) refuse("cell: found " + text(cell) + ", expected m > 0");
    const nb::gil_scoped_release others_run;
    for (size_t i = 0; i < n; ++i) {
        const double x = (from.data()[2 * i] - corner.first) / cell,
                     y = (from.data()[2 * i + 1] - corner.second) / cell;
        for (size_t j = 0; j < bearings; ++j) {
            const double angle = angles.data()[i * bearings + j];
            const Ray ray{x, y, std::cos(angle) / cell, std::sin(angle) / cell};
            ray.add(first.data()[i], step, counts.data()[i], change, cells);
        }
    }
}

}  // namespace

void bind_rays(nb::module_& module) {
    module.def("add_rays", &add_rays, nb::arg("from_"), nb::arg("angles"), nb::arg("first"), nb::arg("step"),
               nb::arg("counts"), nb::arg("change"), nb::arg("corner"), nb::arg("cell"), nb::arg("cells"));
}

}  // namespace echogrid
