// The set network: scans into sums in the cells of a map, and the map out of the sums.
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <memory>
#include <mutex>
#include <optional>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "pool.hpp"
#include "set_network.hpp"
#include "surroundings_types.hpp"

namespace nb = nanobind;

namespace echogrid {
namespace {

constexpr size_t rows_of_a_part = 16;
constexpr size_t least_scans_of_parts = 6;  // to wake another thread for fewer takes longer than they do
constexpr size_t squares_of_a_part = 8;
constexpr size_t groups_of_a_part = 2;  // of 4 rows of squares each
constexpr size_t most_parts_of_a_batch = 16;

using Array3 = nb::ndarray<const double, nb::ndim<3>, nb::c_contig, nb::device::cpu>;

const Bearings& bearings() {
    static const Bearings all = [] {
        Bearings each{};
        for (int i = 0; i < BEARINGS; ++i) {
            each.cos[i] = std::cos(i * (6.28318530717958648 / BEARINGS));
            each.sin[i] = std::sin(i * (6.28318530717958648 / BEARINGS));
        }
        return each;
    }();
    return all;
}

// An array of sonars, and what it fixes of the polar table.
class SonarArray {
   public:
    SonarArray(const Array2<double>& mounts, const Array1<float>& max_range, float footprint, float half_beam,
               bool ends)
        : mounts_(mounts.data(), mounts.data() + mounts.size()),
          max_range_(max_range.data(), max_range.data() + max_range.size()),
          tables_(std::make_unique<SetArray>()) {
        expect("mounts", mounts, {mounts.shape(0), 3});
        expect("max_range", max_range, {mounts.shape(0)});
        if (!(half_beam > 0)) refuse("half_beam: found " + text(half_beam) + ", expected rad > 0");
        int under = 0;
        while (under < RINGS && (under + 0.5) * RING_M < static_cast<double>(footprint)) ++under;
        robot_ = {
            static_cast<int>(mounts.shape(0)), mounts_.data(), max_range_.data(), footprint, half_beam, under, ends};
        kernels().prepare_array(robot_, bearings(), *tables_);
    }

    const SetRobot& robot() const { return robot_; }
    const SetArray& tables() const { return *tables_; }
    size_t sonars() const { return max_range_.size(); }

   private:
    std::vector<double> mounts_;
    std::vector<float> max_range_;
    SetRobot robot_{};
    std::unique_ptr<SetArray> tables_;
};

// What scans tell of bearings and rings round the robot.
struct PolarTables {
    size_t scans;
    bool ends;
    std::unique_ptr<float[]> tables, until;

    NewArray<float> values() const {
        auto copy = std::make_unique<float[]>(scans * BEARINGS * RINGS);
        for (size_t scan = 0; scan < scans; ++scan)
            for (size_t ring = 0; ring < RINGS; ++ring)
                for (size_t b = 0; b < BEARINGS; ++b)
                    copy[(scan * BEARINGS + b) * RINGS + ring] = tables[scan * TABLE + ring * PITCH + b];
        return new_array(std::move(copy), {scans, BEARINGS, RINGS});
    }

    NewArray<float> told_until() const {
        auto copy = std::make_unique<float[]>(scans * BEARINGS);
        for (size_t i = 0; i < scans * BEARINGS; ++i) copy[i] = ends ? until[i] : REACH_M;
        return new_array(std::move(copy), {scans, BEARINGS});
    }
};

// Taps [3][3][in][out] as the products of convolution.hpp take them, [PRODUCTS][3][in][out].
std::vector<float> products_of(const Array1<float>& taps, size_t units) {
    constexpr double rows[PRODUCTS][3] = {{1.0 / 4, 0, 0},
                                          {-1.0 / 6, -1.0 / 6, -1.0 / 6},
                                          {-1.0 / 6, 1.0 / 6, -1.0 / 6},
                                          {1.0 / 24, 1.0 / 12, 1.0 / 6},
                                          {1.0 / 24, -1.0 / 12, 1.0 / 6},
                                          {0, 0, 1},
                                          {1, 0, 0},
                                          {0.5, 0.5, 0.5},
                                          {0.5, -0.5, 0.5},
                                          {0, 0, 1}};
    const size_t row = 3 * units * units;
    std::vector<float> found(PRODUCTS * row);
    for (size_t e = 0; e < PRODUCTS; ++e)
        for (size_t i = 0; i < row; ++i) {
            double sum = 0;
            for (size_t tap = 0; tap < 3; ++tap)
                sum += rows[e][tap] * static_cast<double>(taps.data()[tap * row + i]);
            found[e * row + i] = static_cast<float>(sum);
        }
    return found;
}

// Floats for what is worked out, kept from call to call; whoever uses them holds the lock.
class Room {
   public:
    float* of(size_t floats) {
        if (floats > size_) {
            held_.reset();
            held_ = std::make_unique_for_overwrite<float[]>(floats);
            size_ = floats;
        }
        return held_.get();
    }
    std::mutex lock;

   private:
    std::unique_ptr<float[]> held_;
    size_t size_ = 0;
};

class Network {
   public:
    Network(const Array1<float>& weights, int units) : held_(weights.data(), weights.data() + weights.size()) {
        if (units < 1) refuse("units: found " + std::to_string(units) + ", expected 1 or more");
        expect("weights", weights, {static_cast<size_t>(set_weights_size(units))});
        weights_ = set_weights(held_.data(), units);
    }

    PolarTables tables(const SonarArray& array, const Array2<float>& ranges, const Array2<float>& traits,
                       const std::optional<Array3>& mounts) const {
        const size_t scans = ranges.shape(0), sonars = array.sonars();
        expect("ranges", ranges, {scans, sonars});
        expect("traits", traits, {scans, TRAITS});
        if (mounts) expect("mounts", *mounts, {scans, sonars, 3});
        const bool ends = array.robot().ends;
        PolarTables found{scans, ends, std::make_unique_for_overwrite<float[]>(scans * TABLE),
                          std::make_unique_for_overwrite<float[]>(ends ? scans * BEARINGS : 0)};
        const Kernels& kernel = kernels();
        const nb::gil_scoped_release others_run;
        const size_t each = parts_of(scans, most_parts_of_a_batch);
        const auto room_size = static_cast<size_t>(set_room(static_cast<int>(sonars), weights_.units));
        const size_t parts = scans ? parts_of(scans, each) : 0;
        const auto room = std::make_unique_for_overwrite<float[]>(parts * room_size);
        const auto moved = std::make_unique_for_overwrite<SetArray[]>(mounts ? parts : 0);
        run_parts(parts, [&](size_t part) {
            SetRobot robot = array.robot();
            for (size_t scan = part * each; scan < std::min(scans, (part + 1) * each); ++scan) {
                const double* own = mounts ? mounts->data() + scan * sonars * 3 : array.robot().mounts;
                // Most scans of a batch may have looked from the robot's mounts, to the bit.
                const bool elsewhere = std::memcmp(own, array.robot().mounts, sonars * 3 * sizeof(double)) != 0;
                if (elsewhere) {
                    robot.mounts = own;
                    kernel.prepare_array(robot, bearings(), moved[part]);
                }
                kernel.polar_table(weights_, robot, elsewhere ? moved[part] : array.tables(),
                                   ranges.data() + scan * sonars, traits.data() + scan * TRAITS,
                                   room.get() + part * room_size, found.tables.get() + scan * TABLE,
                                   ends ? found.until.get() + scan * BEARINGS : nullptr);
            }
        });
        return found;
    }

    // Weights of the surroundings: in, begin, (layer, bias) of each layer, pass, cell, cell bias, out, scale.
    void surround(const std::vector<Array1<float>>& parts, int units, int passed, int cell_units) {
        const auto h = static_cast<size_t>(units), p = static_cast<size_t>(passed),
                   c = static_cast<size_t>(cell_units);
        if (units < 4 || units % 4 || passed < 1 || cell_units < 1)
            refuse("surroundings: found " + std::to_string(units) + " units, expected a multiple of 4");
        const size_t squares = PACK * PACK;
        std::vector<size_t> sizes = {squares * CELL_FEATURES * h};
        for (int i = 0; i < LAYERS; ++i) sizes.insert(sizes.end(), {9 * h * h, h});
        for (const size_t size : {h * squares * p, (CELL_FEATURES + p) * c, c, c, size_t{1}}) sizes.push_back(size);
        if (parts.size() != sizes.size())
            refuse("surroundings: found " + std::to_string(parts.size()) + " arrays, expected " +
                   std::to_string(sizes.size()));
        for (size_t i = 0; i < parts.size(); ++i) {
            expect("surroundings", parts[i], {sizes[i]});
            around_held_.emplace_back(parts[i].data(), parts[i].data() + parts[i].size());
        }
        for (size_t i = 0; i < LAYERS; ++i) around_held_[1 + 2 * i] = products_of(parts[1 + 2 * i], h);
        const auto at = [this](size_t i) { return static_cast<const float*>(around_held_[i].data()); };
        around_.units = units, around_.passed = passed, around_.cell_units = cell_units;
        around_.in = at(0);
        for (size_t i = 0; i < LAYERS; ++i) around_.layers[i] = at(1 + 2 * i), around_.bias[i] = at(2 + 2 * i);
        around_.pass = at(11), around_.cell = at(12), around_.cell_bias = at(13), around_.out = at(14);
        around_.scale = around_held_[15][0];
    }

    // See _core.pyi.
    void read_out(const std::vector<Layer<const float>>& held, std::pair<int, int> held_at,
                  std::pair<int, int> squares, const Array1<float>& begin, float faded, float least, float stood,
                  Layer<float> log_odds, Layer<bool> observed, std::pair<int, int> out_at) {
        ReadOut r{};
        r.set = weights_, r.around = around_;
        if (held.size() != 6) refuse("read_out: found " + std::to_string(held.size()) + " layers, expected 6");
        expect("begin", begin, {static_cast<size_t>(around_.units)});
        r.around.begin = begin.data();
        for (size_t n = 0; n < 6; ++n) {
            expect("layer", held[n], {held[0].shape(0), held[0].shape(1)});
            if (held[n].stride(0) != held[0].stride(0) || held[n].stride(1) != 1)
                refuse("layer: found other strides, expected those of the first, rows in one piece");
            r.held[n] = held[n].data();
        }
        r.stride = held[0].stride(0);
        r.held_row = held_at.first, r.held_col = held_at.second;
        r.held_rows = static_cast<int>(held[0].shape(0)), r.held_cols = static_cast<int>(held[0].shape(1));
        r.faded = faded, r.least = least, r.stood = stood;
        r.high = squares.first, r.wide = squares.second;
        expect("observed", observed, {log_odds.shape(0), log_odds.shape(1)});
        r.log_odds = log_odds.data(), r.observed = reinterpret_cast<uint8_t*>(observed.data());
        r.log_odds_stride = log_odds.stride(0), r.observed_stride = observed.stride(0);
        r.out_row = out_at.first, r.out_col = out_at.second;
        r.out_rows = static_cast<int>(log_odds.shape(0)), r.out_cols = static_cast<int>(log_odds.shape(1));
        const bool within = r.held_row >= 0 && r.held_col >= 0 && r.held_row + r.held_rows <= PACK * r.high &&
                            r.held_col + r.held_cols <= PACK * r.wide && r.out_row >= 0 && r.out_col >= 0 &&
                            r.out_row + r.out_rows <= PACK * r.high && r.out_col + r.out_cols <= PACK * r.wide;
        if (!within) refuse("read_out: found cells outside of the rectangle, expected them within");
        const nb::gil_scoped_release others_run;
        work_out(r);
    }

   private:
    void work_out(ReadOut& r) {
        const Kernels& kernel = kernels();
        r.padded = static_cast<int>(parts_of(static_cast<size_t>(r.wide), 16) * 16);
        r.pitch = r.padded + 2 * MARGIN;
        const auto high = static_cast<size_t>(r.high), pitch = static_cast<size_t>(r.pitch);
        const auto units = static_cast<size_t>(r.around.units);
        const size_t told = high * PLANES * pitch, hidden = high * units * pitch;
        // Rooms of the parts, of which most have ``squares_of_a_part`` rows; a group of rows is one at least.
        const auto cells = static_cast<size_t>(12 * r.pitch + 16 * (CELL_FEATURES + 3 * r.around.passed));
        const size_t each = std::max(cells, units * convolution_room);
        const size_t most_parts = parts_of(high, squares_of_a_part) + parts_of(8, groups_of_a_part);
        const std::lock_guard<std::mutex> alone(room_.lock);
        r.told = room_.of(told + 2 * hidden + most_parts * each);
        r.hidden[0] = r.told + told, r.hidden[1] = r.hidden[0] + hidden;
        float* const own = r.hidden[1] + hidden;
        const auto in_parts = [&](const Squares& wanted, const auto& work) {
            run_parts(parts_of(static_cast<size_t>(wanted.row_end - wanted.row), squares_of_a_part),
                      [&](size_t part) {
                          const int first = wanted.row + static_cast<int>(part * squares_of_a_part);
                          work(first, std::min(wanted.row_end, first + static_cast<int>(squares_of_a_part)),
                               own + part * each);
                      });
        };
        int around = units ? REACH / PACK : 0;
        Squares wanted = wanted_of(r, around);
        if (wanted.row_end <= wanted.row) return;
        in_parts(wanted, [&](int first, int last, float* room) {
            kernel.tell_cells(r, first, last, room);
            if (units) kernel.begin_stack(r, first, last);
        });
        if (units) {
            for (int layer = 0; layer < LAYERS; ++layer) {
                around -= DILATIONS[layer];
                wanted = wanted_of(r, around);
                const int rows = wanted.row_end - wanted.row, block = 4 * DILATIONS[layer];
                const auto groups = static_cast<size_t>((rows + block - 1) / block * DILATIONS[layer]);
                run_parts(parts_of(groups, groups_of_a_part), [&](size_t part) {
                    const size_t first = part * groups_of_a_part, last = std::min(groups, first + groups_of_a_part);
                    kernel.convolve(r, layer, wanted, static_cast<int>(first), static_cast<int>(last),
                                    own + part * each);
                });
            }
        }
        in_parts(wanted_of(r, 0),
                 [&](int first, int last, float* room) { kernel.finish_cells(r, first, last, room); });
    }

    // Squares within so many of those that are written.
    static Squares wanted_of(const ReadOut& r, int around) {
        constexpr int widest = 16;  // vector
        const auto end = [around](int first, int count, int most) {
            return std::min(most, (first + count + PACK - 1) / PACK + around);
        };
        return {std::max(0, r.out_row / PACK - around), end(r.out_row, r.out_rows, r.high),
                std::max(0, r.out_col / PACK - around) / widest * widest,
                (end(r.out_col, r.out_cols, r.wide) + widest - 1) / widest * widest};
    }

    std::vector<float> held_;
    SetWeights weights_{};
    std::vector<std::vector<float>> around_held_;
    Around around_{};
    Room room_;
};

// See _core.pyi.
void add_scans(const PolarTables& tables, const Array2<float>& corner, const Array1<double>& heading,
               const Array2<int32_t>& first, const Array1<float>& weight, float cell,
               const std::vector<Layer<float>>& sums, const Layer<int32_t>& views) {
    const size_t scans = tables.scans;
    expect("corner", corner, {scans, 2});
    expect("heading", heading, {scans});
    expect("first", first, {scans, 2});
    expect("weight", weight, {scans});
    if (!(cell > 0)) refuse("cell: found " + text(cell) + ", expected m > 0");
    if (sums.size() != 5) refuse("add: found " + std::to_string(sums.size()) + " layers, expected 5");
    SetWindow window{};
    window.stride = views.stride(0);
    window.rows = static_cast<int>(views.shape(0)), window.cols = static_cast<int>(views.shape(1));
    window.cell = cell, window.views = views.data();
    if (window.cols < LEAST_COLS)
        refuse("add: found a window of " + std::to_string(window.cols) + " columns, expected " +
               std::to_string(LEAST_COLS) + " or more");
    for (size_t n = 0; n < 5; ++n) {
        expect("layer", sums[n], {views.shape(0), views.shape(1)});
        if (sums[n].stride(0) != views.stride(0) || sums[n].stride(1) != 1 || views.stride(1) != 1)
            refuse("layer: found other strides, expected those of the views, rows in one piece");
        window.sums[n] = sums[n].data();
    }
    std::vector<SetScan> placed(scans);
    for (size_t i = 0; i < scans; ++i) {
        const float x = corner.data()[2 * i], y = corner.data()[2 * i + 1];
        if (!(std::abs(x) < 100 && std::abs(y) < 100 && std::isfinite(heading.data()[i])))
            refuse("corner: found (" + text(x) + ", " + text(y) + "), expected m from the robot, within reach of it");
        placed[i] = {tables.tables.get() + i * TABLE,
                     tables.ends ? tables.until.get() + i * BEARINGS : nullptr,
                     static_cast<float>(std::cos(heading.data()[i])),
                     static_cast<float>(std::sin(heading.data()[i])),
                     x,
                     y,
                     first.data()[2 * i],
                     first.data()[2 * i + 1],
                     weight.data()[i]};
    }
    const Kernels& kernel = kernels();
    const nb::gil_scoped_release others_run;
    const size_t rows = views.shape(0), each = scans < least_scans_of_parts ? rows : rows_of_a_part;
    run_parts(rows ? parts_of(rows, each) : 0, [&](size_t part) {
        const int low = static_cast<int>(part * each);
        kernel.add_scans(window, placed.data(), static_cast<int>(scans), low,
                         std::min(window.rows, low + static_cast<int>(each)));
    });
}

// See _core.pyi.
NewArray<float> told_at(const PolarTables& tables, const Array2<float>& x, const Array2<float>& y) {
    const size_t scans = tables.scans, points = x.shape(1), padded = points + LEAST_COLS;
    expect("x", x, {scans, points});
    expect("y", y, {scans, points});
    auto found = std::make_unique<float[]>(scans * points);
    std::vector<float> at_x(padded), at_y(padded), told(padded);
    for (size_t i = 0; i < scans; ++i) {
        std::copy_n(x.data() + i * points, points, at_x.data());
        std::copy_n(y.data() + i * points, points, at_y.data());
        SetScan scan{};
        scan.table = tables.tables.get() + i * TABLE;
        scan.until = tables.ends ? tables.until.get() + i * BEARINGS : nullptr;
        kernels().look_up(scan, at_x.data(), at_y.data(), static_cast<int>(points), told.data());
        std::copy_n(told.data(), points, found.get() + i * points);
    }
    return new_array(std::move(found), {scans, points});
}

}  // namespace

void bind_set_network(nb::module_& module) {
    nb::class_<SonarArray>(module, "SonarArray")
        .def(nb::init<const Array2<double>&, const Array1<float>&, float, float, bool>(), nb::arg("mounts"),
             nb::arg("max_range"), nb::arg("footprint"), nb::arg("half_beam"), nb::arg("ends"));
    nb::class_<PolarTables>(module, "PolarTables")
        .def("values", &PolarTables::values)
        .def("told_until", &PolarTables::told_until)
        .def("at", &told_at, nb::arg("x"), nb::arg("y"))
        .def("add", &add_scans, nb::arg("corner"), nb::arg("heading"), nb::arg("first"), nb::arg("weight"),
             nb::arg("cell"), nb::arg("sums"), nb::arg("views"));
    nb::class_<Network>(module, "SetNetwork")
        .def(nb::init<const Array1<float>&, int>(), nb::arg("weights"), nb::arg("units"))
        .def("surround", &Network::surround, nb::arg("parts"), nb::arg("units"), nb::arg("passed"),
             nb::arg("cell_units"))
        .def("tables", &Network::tables, nb::arg("array"), nb::arg("ranges"), nb::arg("traits"),
             nb::arg("mounts") = nb::none())
        .def("read_out", &Network::read_out, nb::arg("held"), nb::arg("held_at"), nb::arg("squares"),
             nb::arg("begin"), nb::arg("faded"), nb::arg("least"), nb::arg("stood"), nb::arg("log_odds"),
             nb::arg("observed"), nb::arg("out_at"));
}

}  // namespace echogrid
