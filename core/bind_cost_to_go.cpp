// Fields of a whole map: the costs to the nearest of some goals, the distance from some cells.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "cost_to_go.hpp"
#include "distance.hpp"

namespace nb = nanobind;

namespace echogrid {
namespace {

std::string cell_text(int64_t row, int64_t col) {
    return "[" + std::to_string(row) + ", " + std::to_string(col) + "]";
}

// The costs with a rim of closed cells.
std::vector<float> rimmed(const Array2<float>& costs) {
    const size_t rows = costs.shape(0), cols = costs.shape(1);
    if (rows > INT32_MAX || cols > INT32_MAX || (rows + 2) * (cols + 2) >= INT32_MAX)
        refuse("costs: found " + shape_text(costs) + " cells, expected less than 2^31");
    std::vector<float> with_rim((rows + 2) * (cols + 2), std::numeric_limits<float>::infinity());
    for (size_t row = 0; row < rows; ++row)
        for (size_t col = 0; col < cols; ++col) {
            const float cost = costs.data()[row * cols + col];
            if (!(cost >= 0))
                refuse("costs" + cell_text(static_cast<int64_t>(row), static_cast<int64_t>(col)) + ": found " +
                       text(cost) + ", expected a cost of a metre >= 0, or inf for a closed cell");
            // Minus nought would not be in the order of its bits.
            with_rim[(row + 1) * (cols + 2) + col + 1] = std::abs(cost);
        }
    return with_rim;
}

std::vector<int32_t> goals_in_rim(const Array2<int64_t>& goals, int64_t rows, int64_t cols) {
    if (goals.shape(1) != 2) refuse("goals: found " + shape_text(goals) + ", expected n x 2");
    std::vector<int32_t> cells;
    cells.reserve(goals.shape(0));
    for (size_t i = 0; i < goals.shape(0); ++i) {
        const int64_t row = goals.data()[2 * i], col = goals.data()[2 * i + 1];
        if (row < 0 || row >= rows || col < 0 || col >= cols)
            refuse("goals[" + std::to_string(i) + "]: found " + cell_text(row, col) + ", expected a cell of the " +
                   std::to_string(rows) + " x " + std::to_string(cols));
        cells.push_back(static_cast<int32_t>((row + 1) * (cols + 2) + col + 1));
    }
    return cells;
}

NewArray<double> cost_to_go(const Array2<float>& costs, const Array2<int64_t>& goals, double resolution) {
    if (!(resolution > 0) || !std::isfinite(resolution))
        refuse("resolution: found " + text(resolution) + ", expected m > 0");
    const size_t rows = costs.shape(0), cols = costs.shape(1);
    const std::vector<float> with_rim = rimmed(costs);
    const std::vector<int32_t> cells = goals_in_rim(goals, static_cast<int64_t>(rows), static_cast<int64_t>(cols));
    auto inner = std::make_unique_for_overwrite<double[]>(rows * cols);
    {
        const nb::gil_scoped_release others_run;
        std::vector<double> to_go(with_rim.size());
        std::vector<int32_t> next(with_rim.size()), previous(with_rim.size());
        const CostField field{
            static_cast<int32_t>(rows + 2), static_cast<int32_t>(cols + 2), with_rim, to_go, next, previous};
        find_cost_to_go(field, cells, resolution);
        for (size_t row = 0; row < rows; ++row)
            std::copy_n(to_go.data() + (row + 1) * (cols + 2) + 1, cols, inner.get() + row * cols);
    }
    return new_array(std::move(inner), {rows, cols});
}

NewArray<float> distance(const Array2<bool>& marked) {
    const size_t rows = marked.shape(0), cols = marked.shape(1);
    if (rows >= INT32_MAX || cols >= INT32_MAX || rows * cols >= INT32_MAX)
        refuse("marked: found " + shape_text(marked) + " cells, expected less than 2^31");
    auto found = std::make_unique_for_overwrite<float[]>(rows * cols);
    {
        const nb::gil_scoped_release others_run;
        std::vector<int32_t> along(rows * cols), first(cols), apex(cols);
        find_distance({static_cast<int32_t>(rows),
                       static_cast<int32_t>(cols),
                       {marked.data(), rows * cols},
                       {found.get(), rows * cols},
                       along,
                       first,
                       apex});
    }
    return new_array(std::move(found), {rows, cols});
}

}  // namespace

void bind_cost_to_go(nb::module_& module) {
    module.def("cost_to_go", &cost_to_go, nb::arg("costs"), nb::arg("goals").noconvert(), nb::arg("resolution"));
    module.def("distance", &distance, nb::arg("marked").noconvert());
}

}  // namespace echogrid
