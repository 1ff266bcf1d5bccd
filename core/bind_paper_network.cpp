// The paper's network: scans into local maps, and these into the global one.
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <memory>
#include <optional>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "paper_network.hpp"
#include "pool.hpp"

namespace nb = nanobind;

namespace echogrid {
namespace {

constexpr size_t rows_of_a_part = 16;
constexpr size_t scans_of_a_part = 4;

// The perceptron, bound to points of a robot's frame.
class PaperNetwork {
   public:
    // Weights: w0 of readings and of what lies beyond, w1, b1, w2, b2. See _core.pyi.
    PaperNetwork(const std::vector<Array1<float>>& weights, int sonars, const Array2<int32_t>& sonar,
                 const Array2<float>& distance, const Array2<int32_t>& looks, const Array2<float>& place, float prior)
        : points_of_(sonar.shape(1)) {
        const size_t zone = sonar.shape(0), first = place.shape(0), count = sonar.shape(1);
        if (weights.size() != 5) refuse("weights: found " + std::to_string(weights.size()) + " arrays, expected 5");
        const size_t second = weights[2].shape(0);
        const size_t sizes[] = {5 * zone * first, first * second, second, second, 1};
        for (size_t i = 0; i < 5; ++i) {
            expect("weights", weights[i], {sizes[i]});
            weights_held_.emplace_back(weights[i].data(), weights[i].data() + sizes[i]);
        }
        expect("distance", distance, {zone, count});
        expect("looks", looks, {zone, count});
        expect("place", place, {first, count});
        weights_ = {static_cast<int>(zone),  static_cast<int>(first), static_cast<int>(second),
                    weights_held_[0].data(), weights_held_[1].data(), weights_held_[2].data(),
                    weights_held_[3].data(), weights_held_[4][0]};
        const size_t padded = parts_of(count, POINTS_AT_ONCE) * POINTS_AT_ONCE;
        for (size_t i = 0; i < zone * count; ++i)
            if (sonar.data()[i] < 0 || sonar.data()[i] > sonars)
                refuse("sonar: found " + std::to_string(sonar.data()[i]) + ", expected 0 to " +
                       std::to_string(sonars));
        sonar_ = filled(sonar, padded, sonars);
        looks_ = filled(looks, padded, 0);
        distance_ = filled(distance, padded, 1.0F);
        place_ = filled(place, padded, 0.0F);
        points_ = {sonars, static_cast<int>(padded), sonar_.data(), distance_.data(), looks_.data(), place_.data(),
                   prior};
    }

    NewArray<float> look(const Array2<float>& ranges) const {
        const size_t scans = ranges.shape(0), sonars = static_cast<size_t>(points_.sonars);
        expect("ranges", ranges, {scans, sonars});
        const auto padded = static_cast<size_t>(points_.count);
        auto told = std::make_unique_for_overwrite<float[]>(scans * points_of_);
        const Kernels& kernel = kernels();
        {
            const nb::gil_scoped_release others_run;
            const auto room_size = static_cast<size_t>(paper_room(weights_.zone, weights_.first, weights_.second));
            const size_t parts = parts_of(scans, scans_of_a_part);
            const auto room = std::make_unique_for_overwrite<float[]>(parts * (room_size + padded));
            run_parts(parts, [&](size_t part) {
                float* const own = room.get() + part * (room_size + padded);
                for (size_t i = part * scans_of_a_part; i < std::min(scans, (part + 1) * scans_of_a_part); ++i) {
                    kernel.look_at_points(weights_, points_, ranges.data() + i * sonars, own + padded, own);
                    std::copy_n(own, points_of_, told.get() + i * points_of_);
                }
            });
        }
        return new_array(std::move(told), {scans, points_of_});
    }

   private:
    template <class T>
    static std::vector<T> filled(const Array2<T>& values, size_t padded, T fill) {
        const size_t rows = values.shape(0), count = values.shape(1);
        std::vector<T> wide(rows * padded, fill);
        for (size_t row = 0; row < rows; ++row)
            std::copy_n(values.data() + row * count, count, wide.data() + row * padded);
        return wide;
    }

    size_t points_of_;
    std::vector<std::vector<float>> weights_held_;
    std::vector<int32_t> sonar_, looks_;
    std::vector<float> distance_, place_;
    PaperWeights weights_{};
    PaperPoints points_{};
};

// How local maps are fused; see _core.pyi.
class LocalFusion {
   public:
    LocalFusion(float prior, float least, float most, bool on_log_odds, float footprint,
                const std::optional<Array2<float>>& beams, float cone) {
        rule_ = {prior, least, most, on_log_odds, footprint, nullptr, 0, cone};
        if (!(least > 0 && most < 1 && least <= most)) refuse("least: found none, expected 0 < least <= most < 1");
        if (!beams) return;
        expect("beams", *beams, {beams->shape(0), 4});
        for (size_t k = 0; k < beams->shape(0); ++k) {
            const float* beam = beams->data() + 4 * k;
            beams_.push_back({beam[0], beam[1], std::cos(beam[2]), std::sin(beam[2]), beam[3]});
        }
        rule_.beams = beams_.data(), rule_.count = static_cast<int>(beams_.size());
    }

    void add(const Array2<float>& told, const Array2<float>& ranges, const Array2<float>& corner,
             const Array1<double>& heading, const Array2<int32_t>& first, float cell, const Layer<float>& log_odds,
             const Layer<bool>& observed, const Layer<int32_t>& views) const {
        const size_t scans = told.shape(0), rows = views.shape(0), cols = views.shape(1);
        expect("told", told, {scans, size_t{LOCAL_CELLS} * LOCAL_CELLS});
        expect("corner", corner, {scans, 2});
        expect("heading", heading, {scans});
        expect("first", first, {scans, 2});
        if (!beams_.empty()) expect("ranges", ranges, {scans, beams_.size()});
        if (!(cell > 0)) refuse("cell: found " + text(cell) + ", expected m > 0");
        expect("log_odds", log_odds, {rows, cols});
        expect("observed", observed, {rows, cols});
        if (log_odds.stride(1) != 1 || observed.stride(1) != 1 || views.stride(1) != 1)
            refuse("layer: found rows in pieces, expected them in one");
        const LocalWindow window{log_odds.data(),
                                 reinterpret_cast<uint8_t*>(observed.data()),
                                 views.data(),
                                 log_odds.stride(0),
                                 observed.stride(0),
                                 views.stride(0),
                                 static_cast<int>(rows),
                                 static_cast<int>(cols),
                                 cell};
        std::vector<LocalScan> placed(scans);
        for (size_t i = 0; i < scans; ++i) {
            const float x = corner.data()[2 * i], y = corner.data()[2 * i + 1];
            if (!(std::abs(x) < 100 && std::abs(y) < 100 && std::isfinite(heading.data()[i])))
                refuse("corner: found (" + text(x) + ", " + text(y) + "), expected m from the robot, within reach");
            placed[i] = {told.data() + i * LOCAL_CELLS * LOCAL_CELLS,
                         beams_.empty() ? nullptr : ranges.data() + i * beams_.size(),
                         static_cast<float>(std::cos(heading.data()[i])),
                         static_cast<float>(std::sin(heading.data()[i])),
                         x,
                         y,
                         first.data()[2 * i],
                         first.data()[2 * i + 1]};
        }
        const Kernels& kernel = kernels();
        const nb::gil_scoped_release others_run;
        run_parts(parts_of(rows, rows_of_a_part), [&](size_t part) {
            const auto low = static_cast<int>(part * rows_of_a_part);
            kernel.add_local_maps(window, rule_, placed.data(), static_cast<int>(scans), low,
                                  std::min(window.rows, low + static_cast<int>(rows_of_a_part)));
        });
    }

   private:
    std::vector<Beam> beams_;
    LocalRule rule_{};
};

}  // namespace

void bind_paper_network(nb::module_& module) {
    nb::class_<PaperNetwork>(module, "PaperNetwork")
        .def(nb::init<const std::vector<Array1<float>>&, int, const Array2<int32_t>&, const Array2<float>&,
                      const Array2<int32_t>&, const Array2<float>&, float>(),
             nb::arg("weights"), nb::arg("sonars"), nb::arg("sonar"), nb::arg("distance"), nb::arg("looks"),
             nb::arg("place"), nb::arg("prior"))
        .def("look", &PaperNetwork::look, nb::arg("ranges"));
    nb::class_<LocalFusion>(module, "LocalFusion")
        .def(nb::init<float, float, float, bool, float, const std::optional<Array2<float>>&, float>(),
             nb::arg("prior"), nb::arg("least"), nb::arg("most"), nb::arg("on_log_odds"), nb::arg("footprint"),
             nb::arg("beams").none(), nb::arg("cone"))
        .def("add", &LocalFusion::add, nb::arg("told"), nb::arg("ranges"), nb::arg("corner"), nb::arg("heading"),
             nb::arg("first"), nb::arg("cell"), nb::arg("log_odds"), nb::arg("observed"), nb::arg("views"));
}

}  // namespace echogrid
