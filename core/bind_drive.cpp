// What is remembered of a drive: where the robot looked from and stood, what its sonars heard last.
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <optional>
#include <string>
#include <tuple>
#include <unordered_map>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "set_network.hpp"

namespace nb = nanobind;

namespace echogrid {
namespace {

constexpr double TURN = 6.28318530717958648;
constexpr double MOST_CELLS = 1e15;  // of the lattice, as far as whole numbers are told apart

using Array3 = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

double not_negative(double angle) {
    const double rest = std::fmod(angle, TURN);
    return rest < 0 ? rest + TURN : rest;
}

double wrapped(double angle) { return not_negative(angle + TURN / 2) - TURN / 2; }

struct Pose {
    double x, y, heading;

    Pose after(const Pose& b) const {
        const double c = std::cos(heading), s = std::sin(heading);
        return {x + c * b.x - s * b.y, y + s * b.x + c * b.y, wrapped(heading + b.heading)};
    }
    Pose inverse() const {
        const double c = std::cos(heading), s = std::sin(heading);
        return {-c * x - s * y, s * x - c * y, wrapped(-heading)};
    }
};

Pose pose_at(const double* values) { return {values[0], values[1], values[2]}; }

using Place = std::array<int64_t, 3>;

struct PlaceHash {
    size_t operator()(const Place& place) const noexcept {
        uint64_t mixed = 0;
        for (const int64_t part : place) {
            mixed = (mixed ^ static_cast<uint64_t>(part)) * 0x9e3779b97f4a7c15U;
            mixed ^= mixed >> 29;
        }
        return static_cast<size_t>(mixed);
    }
};

void expect_positive(const char* what, double value) {
    if (!(value > 0)) refuse(std::string(what) + ": found " + text(value) + ", expected more than 0");
}

class Memory {
   public:
    Memory(const Array2<int32_t>& pairs, const Array1<double>& near, int sonars, double place, double turn,
           double far, double same, double fade, double prior, std::optional<double> half_life)
        : near_(near.data(), near.data() + near.size()),
          sonars_(std::max(sonars, 1)),
          place_(place),
          turn_(turn),
          far_(far),
          same_(same),
          fade_(fade),
          prior_(prior),
          half_life_(half_life) {
        expect("pairs", pairs, {near.shape(0), 2});
        expect_positive("place", place), expect_positive("turn", turn), expect_positive("far", far);
        expect_positive("same", same), expect_positive("fade", fade), expect_positive("prior", prior);
        if (half_life && !(*half_life > 0)) refuse("half_life: found " + text(*half_life) + ", expected s > 0");
        for (size_t i = 0; i < near.shape(0); ++i) {
            const int32_t first = pairs.data()[2 * i], second = pairs.data()[2 * i + 1];
            if (first < 0 || second < 0) refuse("pairs: found a negative sonar, expected 0 or more");
            pairs_.push_back({static_cast<size_t>(first), static_cast<size_t>(second)});
            least_sonars_ = std::max(least_sonars_, static_cast<size_t>(std::max(first, second)) + 1);
        }
    }

    // See _core.pyi.
    std::pair<NewArray<float>, NewArray<float>> take(const Array2<double>& poses, const Array2<double>& ranges,
                                                     const Array1<double>& stamps, const Array1<double>& fresh) {
        const size_t scans = ranges.shape(0), sonars = ranges.shape(1);
        expect("poses", poses, {scans, 3});
        expect("stamps", stamps, {scans});
        expect("new", fresh, {scans});
        if (sonars < least_sonars_)
            refuse("ranges: found " + std::to_string(sonars) + " sonars, expected " + std::to_string(least_sonars_));
        auto weight = std::make_unique<float[]>(scans);
        auto traits = std::make_unique<float[]>(scans * TRAITS);
        for (size_t i = 0; i < scans; ++i) {
            const double fired = hear(ranges.data() + i * sonars, sonars, traits.get() + i * TRAITS);
            const double share = fresh.data()[i] * fired / sonars_;
            const double looks = look(poses.data() + 3 * i, stamps.data()[i], share);
            weight[i] = static_cast<float>(fresh.data()[i] / std::max(looks, 1.0));
        }
        return {new_array(std::move(weight), {scans}), new_array(std::move(traits), {scans, size_t{TRAITS}})};
    }

   private:
    struct Looks {
        double count, time;
    };

    // How often the robot has looked from a pose, this time included.
    double look(const double* pose, double stamp, double share) {
        const double cells[3] = {pose[0] / place_, pose[1] / place_, not_negative(pose[2]) / turn_};
        Place place;
        for (size_t k = 0; k < 3; ++k) {
            if (!(std::abs(cells[k]) < MOST_CELLS)) refuse("poses: found " + text(pose[k]) + ", expected m and rad");
            place[k] = static_cast<int64_t>(std::floor(cells[k]));
        }
        const double time = half_life_ ? stamp / *half_life_ : 0.0;
        Looks& looks = looks_.try_emplace(place, Looks{0.0, time}).first->second;
        looks.count = share + looks.count * std::exp2(std::min(looks.time - time, 0.0));
        looks.time = time;
        return looks.count;
    }

    // How many sonars fired, and what the surroundings are like.
    double hear(const double* ranges, size_t sonars, float* traits) {
        double sums[TRAITS] = {}, counts[TRAITS] = {};
        reading_.resize(sonars);
        for (size_t s = 0; s < sonars; ++s) {
            const bool fired = !std::isnan(ranges[s]);
            reading_[s] = fired ? std::min(ranges[s], far_) : 0.0;
            counts[0] += fired;
            sums[0] += fired && std::isinf(ranges[s]);
            sums[3] += reading_[s];
        }
        counts[3] = counts[0], sums[3] /= far_;
        for (size_t i = 0; i < pairs_.size(); ++i) {
            const auto [first, second] = pairs_[i];
            if (std::isnan(ranges[first]) || std::isnan(ranges[second])) continue;
            const double apart = std::abs(reading_[first] - reading_[second]);
            counts[2] += near_[i], sums[2] += near_[i] * std::min(apart, 1.0);
            if (std::isinf(ranges[first]) || std::isinf(ranges[second])) continue;
            counts[1] += near_[i], sums[1] += near_[i] * std::max(1 - apart / same_, 0.0);
        }
        for (size_t k = 0; k < TRAITS; ++k) {
            sums_[k] = fade_ * sums_[k] + sums[k], counts_[k] = fade_ * counts_[k] + counts[k];
            traits[k] = static_cast<float>((sums_[k] + 0.5 * prior_) / (counts_[k] + prior_));
        }
        return counts[0];
    }

    std::vector<std::pair<size_t, size_t>> pairs_;
    std::vector<double> near_, reading_;
    double sonars_, place_, turn_, far_, same_, fade_, prior_;
    std::optional<double> half_life_;
    size_t least_sonars_ = 0;
    std::unordered_map<Place, Looks, PlaceHash> looks_;
    double sums_[TRAITS] = {}, counts_[TRAITS] = {};
};

class Recent {
   public:
    Recent(const Array2<double>& mounts, double way, double turn, double time, int scans)
        : mounts_(mounts.data(), mounts.data() + mounts.size()), way_(way), turn_(turn), time_(time) {
        expect("mounts", mounts, {mounts.shape(0), 3});
        expect_positive("scans", scans);
        most_ = static_cast<size_t>(scans);
    }

    // See _core.pyi.
    std::optional<std::tuple<NewArray<double>, NewArray<double>, double>> complete(
        double stamp, const Array1<double>& pose, const Array1<double>& ranges,
        const std::optional<Array2<double>>& mounts) {
        const size_t sonars = mounts_.size() / 3;
        expect("pose", pose, {3});
        expect("ranges", ranges, {sonars});
        if (mounts) expect("mounts", *mounts, {sonars, 3});
        const double* looked = mounts ? mounts->data() : mounts_.data();
        heard_.assign(ranges.data(), ranges.data() + sonars);
        size_t silent = 0, there = 0;
        for (size_t s = 0; s < sonars; ++s) {
            there += sonar_is_there(s);
            silent += sonar_is_there(s) && std::isnan(heard_[s]);
        }
        size_t missing = silent;
        if (silent) {
            looked_.assign(looked, looked + 3 * sonars);
            const Pose here = pose_at(pose.data()).inverse();
            for (auto before = scans_.rbegin(); missing && before != scans_.rend(); ++before) {
                const Pose moved = here.after(before->pose);
                if (std::hypot(moved.x, moved.y) <= way_ && std::abs(moved.heading) <= turn_ &&
                    std::abs(stamp - before->stamp) <= time_)
                    missing -= fill_from(*before, moved);
            }
        }
        remember(stamp, pose.data(), ranges.data(), mounts ? looked : nullptr, sonars);
        if (missing == silent) return std::nullopt;
        auto values = std::make_unique_for_overwrite<double[]>(sonars);
        auto places = std::make_unique_for_overwrite<double[]>(3 * sonars);
        std::copy_n(heard_.data(), sonars, values.get());
        std::copy_n(looked_.data(), 3 * sonars, places.get());
        const auto fired = static_cast<double>(there - silent), taken = static_cast<double>(silent - missing);
        return std::tuple{new_array(std::move(values), {sonars}), new_array(std::move(places), {sonars, size_t{3}}),
                          fired / (fired + taken)};
    }

   private:
    struct Scan {
        double stamp = 0;
        Pose pose{};
        std::vector<double> ranges, mounts;  // no mounts: those of the robot
    };

    bool sonar_is_there(size_t sonar) const { return !std::isnan(mounts_[3 * sonar + 2]); }

    // How many silent sonars heard something in an earlier scan, from which the robot has moved so.
    size_t fill_from(const Scan& before, const Pose& moved) {
        const double* looked = before.mounts.empty() ? mounts_.data() : before.mounts.data();
        size_t filled = 0;
        for (size_t s = 0; s < heard_.size(); ++s) {
            if (!sonar_is_there(s) || !std::isnan(heard_[s]) || std::isnan(before.ranges[s])) continue;
            heard_[s] = before.ranges[s];
            const Pose from = moved.after(pose_at(looked + 3 * s));
            looked_[3 * s] = from.x, looked_[3 * s + 1] = from.y, looked_[3 * s + 2] = from.heading;
            ++filled;
        }
        return filled;
    }

    void remember(double stamp, const double* pose, const double* ranges, const double* mounts, size_t sonars) {
        Scan scan;
        if (scans_.size() == most_) scan = std::move(scans_.front()), scans_.pop_front();
        scan.stamp = stamp, scan.pose = pose_at(pose);
        scan.ranges.assign(ranges, ranges + sonars);
        scan.mounts.assign(mounts, mounts ? mounts + 3 * sonars : mounts);
        scans_.push_back(std::move(scan));
    }

    std::vector<double> mounts_, heard_, looked_;
    double way_, turn_, time_;
    size_t most_;
    std::deque<Scan> scans_;
};

// The floor over which a robot came: into a layer of the map whose first cell is `begin`.
class Standing {
   public:
    Standing(const Layer<float>& layer, std::pair<int64_t, int64_t> begin, double radius, double cell, float weight)
        : data_(layer.data()),
          stride_(layer.stride(0)),
          rows_(static_cast<int64_t>(layer.shape(0))),
          cols_(static_cast<int64_t>(layer.shape(1))),
          row_(begin.first),
          col_(begin.second),
          radius_(radius),
          cell_(cell),
          half_(static_cast<int64_t>(std::ceil(radius / cell))),
          weight_(weight) {}

    // Every cell whose middle a disc round a point covers.
    void at(double x, double y) {
        const auto col = static_cast<int64_t>(std::floor(x / cell_)),
                   row = static_cast<int64_t>(std::floor(y / cell_));
        for (int64_t r = std::max(row - half_, row_); r <= std::min(row + half_, row_ + rows_ - 1); ++r) {
            const double dy = (static_cast<double>(r) + 0.5) * cell_ - y;
            for (int64_t c = std::max(col - half_, col_); c <= std::min(col + half_, col_ + cols_ - 1); ++c) {
                const double dx = (static_cast<double>(c) + 0.5) * cell_ - x;
                if (dx * dx + dy * dy < radius_ * radius_) mark(r, c);
            }
        }
    }

    // First cell that was written to, and that behind the last.
    std::optional<std::tuple<int64_t, int64_t, int64_t, int64_t>> cells() const {
        if (high_row_ <= low_row_) return std::nullopt;
        return std::tuple{low_row_, low_col_, high_row_, high_col_};
    }

   private:
    void mark(int64_t r, int64_t c) {
        float& held = data_[(r - row_) * stride_ + (c - col_)];
        held = std::max(held, weight_);
        low_row_ = std::min(low_row_, r), low_col_ = std::min(low_col_, c);
        high_row_ = std::max(high_row_, r + 1), high_col_ = std::max(high_col_, c + 1);
    }

    float* data_;
    int64_t stride_, rows_, cols_, row_, col_;
    double radius_, cell_;
    int64_t half_;
    float weight_;
    int64_t low_row_ = INT64_MAX, low_col_ = INT64_MAX, high_row_ = INT64_MIN, high_col_ = INT64_MIN;
};

// See _core.pyi.
std::optional<std::tuple<int64_t, int64_t, int64_t, int64_t>> stand(const Array2<double>& way, bool came,
                                                                    double radius, double cell, double step,
                                                                    double gap, float weight,
                                                                    const Layer<float>& stood,
                                                                    std::pair<int64_t, int64_t> begin) {
    expect("way", way, {way.shape(0), 2});
    if (!(radius > 0 && cell > 0 && step > 0 && radius < 1e6 * cell))
        refuse("stand: found a radius of " + text(radius) + " m, cells of " + text(cell) + " m and steps of " +
               text(step) + " m, expected m > 0");
    for (size_t i = 0; i < way.size(); ++i)
        if (!(std::abs(way.data()[i] / cell) < MOST_CELLS))
            refuse("way: found " + text(way.data()[i]) + ", expected m");
    if (stood.shape(0) && stood.stride(1) != 1) refuse("stood: found other strides, expected rows in one piece");
    Standing standing(stood, begin, radius, cell, weight);
    const nb::gil_scoped_release others_run;
    for (size_t i = 0; i < way.shape(0); ++i) {
        const double x = way.data()[2 * i], y = way.data()[2 * i + 1];
        if (i == (came ? 1 : 0)) standing.at(x, y);
        if (i == 0) continue;
        const double x0 = way.data()[2 * i - 2], y0 = way.data()[2 * i - 1];
        const double far = std::hypot(x - x0, y - y0);
        const auto parts = far <= gap ? static_cast<int64_t>(std::ceil(far / step)) : 1;
        for (int64_t part = 1; part <= parts; ++part) {
            const double share = static_cast<double>(part) / static_cast<double>(parts);
            standing.at(x0 + (x - x0) * share, y0 + (y - y0) * share);
        }
    }
    return standing.cells();
}

}  // namespace

void bind_drive(nb::module_& module) {
    nb::class_<Memory>(module, "Memory")
        .def(nb::init<const Array2<int32_t>&, const Array1<double>&, int, double, double, double, double, double,
                      double, std::optional<double>>(),
             nb::arg("pairs"), nb::arg("near"), nb::arg("sonars"), nb::arg("place"), nb::arg("turn"), nb::arg("far"),
             nb::arg("same"), nb::arg("fade"), nb::arg("prior"), nb::arg("half_life") = nb::none())
        .def("take", &Memory::take, nb::arg("poses"), nb::arg("ranges"), nb::arg("stamps"), nb::arg("new"));
    nb::class_<Recent>(module, "Recent")
        .def(nb::init<const Array2<double>&, double, double, double, int>(), nb::arg("mounts"), nb::arg("way"),
             nb::arg("turn"), nb::arg("time"), nb::arg("scans"))
        .def("complete", &Recent::complete, nb::arg("stamp"), nb::arg("pose"), nb::arg("ranges"),
             nb::arg("mounts") = nb::none());
    module.def("stand", &stand, nb::arg("way"), nb::arg("came"), nb::arg("radius"), nb::arg("cell"), nb::arg("step"),
               nb::arg("gap"), nb::arg("weight"), nb::arg("stood"), nb::arg("begin"));
}

}  // namespace echogrid
