// Poses against a map.
#include <nanobind/ndarray.h>
#include <nanobind/stl/pair.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "pool.hpp"
#include "score.hpp"

namespace nb = nanobind;

namespace echogrid {
namespace {

constexpr size_t poses_of_a_part = 32;

// Up to there a float32 tells where in a cell a point is, to a hundredth of it; nobody sees as far.
constexpr double farthest_point_cells = 0x1p16;

class PoseScorer {
   public:
    PoseScorer(const Array2<float>& b, std::pair<double, double> origin, double resolution) {
        if (!(resolution > 0) || !std::isfinite(resolution))
            refuse("resolution: found " + text(resolution) + ", expected m > 0");
        if (!std::isfinite(origin.first) || !std::isfinite(origin.second))
            refuse("origin: found (" + text(origin.first) + ", " + text(origin.second) + "), expected m");
        const size_t rows = b.shape(0), cols = b.shape(1);
        const size_t stride = cols + ScoreMap::cols_around;
        if (rows > INT32_MAX || cols > INT32_MAX || (rows + ScoreMap::rows_around) * stride > INT32_MAX)
            refuse("b: found " + std::to_string(rows) + " x " + std::to_string(cols) +
                   " cells, expected less than 2^31");
        check_sureness("b", b.data(), rows * cols);
        pairs_.resize(2 * (rows + ScoreMap::rows_around) * stride);
        for (size_t row = 0; row < rows; ++row) {
            const float* values = b.data() + row * cols;
            float* pair = pairs_.data() + 2 * ((row + ScoreMap::before) * stride + ScoreMap::before);
            float* pair_below = pair - 2 * stride;
            for (size_t col = 0; col < cols; ++col) pair[2 * col] = pair_below[2 * col + 1] = values[col];
        }
        map_ = {pairs_.data(), static_cast<int32_t>(rows), static_cast<int32_t>(cols), origin.first, origin.second,
                1 / resolution};
    }

    NewArray<float> score(const Array2<float>& points, const Array1<float>& a, const Array2<double>& poses) const {
        const std::vector<float> padded = padded_points(points, a);
        const size_t count = padded.size() / 3;
        const ScorePoints seen{padded.data(), padded.data() + count, padded.data() + 2 * count, count,
                               reach_cells(padded)};
        const std::vector<double> asked = checked_poses(poses);
        const size_t n = poses.shape(0);

        auto scores = std::make_unique<float[]>(n);
        const Kernels& kernel = kernels();
        {
            const nb::gil_scoped_release others_run;
            run_parts((n + poses_of_a_part - 1) / poses_of_a_part, [&](size_t part) {
                const size_t first = part * poses_of_a_part;
                kernel.score(map_, seen, asked.data() + 3 * first, std::min(poses_of_a_part, n - first),
                             scores.get() + first);
            });
        }
        return new_array(std::move(scores), {n});
    }

   private:
    static void check_sureness(const char* name, const float* values, size_t count) {
        for (size_t i = 0; i < count; ++i)
            if (!(values[i] >= -1 && values[i] <= 1))
                refuse(std::string(name) + ": found " + text(values[i]) + ", expected 2 p - 1 in -1 to 1");
    }

    // A copy: while others run, somebody may write to the array, and no pose that is not finite may reach a kernel.
    static std::vector<double> checked_poses(const Array2<double>& poses) {
        if (poses.shape(1) != 3) refuse("poses: found " + shape_text(poses) + ", expected n x 3");
        std::vector<double> copied(poses.data(), poses.data() + 3 * poses.shape(0));
        for (size_t i = 0; i < copied.size(); ++i)
            if (!std::isfinite(copied[i]))
                refuse("poses[" + std::to_string(i / 3) + "]: found " + text(copied[i]) + ", expected m, m, rad");
        return copied;
    }

    // x of all points, then y, then a.
    std::vector<float> padded_points(const Array2<float>& points, const Array1<float>& a) const {
        if (points.shape(1) != 2) refuse("points: found " + shape_text(points) + ", expected n x 2");
        const size_t n = points.shape(0);
        if (a.shape(0) != n)
            refuse("a: found " + std::to_string(a.shape(0)) + " values for " + std::to_string(n) +
                   " points, expected one each");
        check_sureness("a", a.data(), n);
        const size_t count = (n + ScorePoints::multiple - 1) / ScorePoints::multiple * ScorePoints::multiple;
        std::vector<float> padded(3 * count);
        for (size_t i = 0; i < n; ++i) {
            for (size_t axis = 0; axis < 2; ++axis) {
                const float value = points.data()[2 * i + axis];
                if (!(std::abs(value) * map_.cells_per_m < farthest_point_cells))
                    refuse("points[" + std::to_string(i) + "]: found " + text(value) +
                           ", expected m, at most 2^16 cells away");
                padded[axis * count + i] = value;
            }
            padded[2 * count + i] = a.data()[i];
        }
        return padded;
    }

    // A whole number of cells that no point lies as far away as, however it is turned.
    int32_t reach_cells(const std::vector<float>& padded) const {
        const size_t count = padded.size() / 3;
        double farthest = 0;
        for (size_t i = 0; i < count; ++i)
            farthest = std::max(farthest, static_cast<double>(std::hypot(padded[i], padded[count + i])));
        return static_cast<int32_t>(farthest * map_.cells_per_m) + 2;
    }

    std::vector<float> pairs_;
    ScoreMap map_{};
};

}  // namespace

void bind_score(nb::module_& module) {
    nb::class_<PoseScorer>(module, "PoseScorer")
        .def(nb::init<const Array2<float>&, std::pair<double, double>, double>(), nb::arg("b"), nb::arg("origin"),
             nb::arg("resolution"))
        .def("score", &PoseScorer::score, nb::arg("points"), nb::arg("a"), nb::arg("poses"));
}

}  // namespace echogrid
