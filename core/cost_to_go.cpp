#include "cost_to_go.hpp"

#include <algorithm>
#include <array>
#include <bit>
#include <limits>
#include <numbers>

namespace echogrid {
namespace {

constexpr double infinity = std::numeric_limits<double>::infinity();
constexpr int32_t nobody = -1;

// A radix heap of cells. What is put in is never less than what was last taken out, so a cell lies in the bucket of
// the highest bit in which its cost differs from that (the bits of doubles that are not negative are in their order):
// it moves down at most once for each bit. Buckets are chains through arrays of the caller.
class CellHeap {
   public:
    explicit CellHeap(const CostField& field) : field_(field) { heads_.fill(nobody); }

    bool empty() const { return filled_ == 0; }

    void put(int32_t cell) { link(cell, bucket_of(cell)); }

    // Before its cost is made less; `put` follows.
    void take_out(int32_t cell) {
        const int32_t next = field_.next[cell_at(cell)], previous = field_.previous[cell_at(cell)];
        if (previous >= 0)
            field_.next[cell_at(previous)] = next;
        else
            set_head(bucket_of(cell), next);
        if (next >= 0) field_.previous[cell_at(next)] = previous;
    }

    // One of least cost. Only of a heap that holds cells.
    int32_t take_least() {
        const size_t lowest = static_cast<size_t>(std::countr_zero(filled_));
        if (lowest > 0) spread(lowest);
        const int32_t cell = heads_[0];
        const int32_t next = field_.next[cell_at(cell)];
        set_head(0, next);
        if (next >= 0) field_.previous[cell_at(next)] = nobody;
        return cell;
    }

   private:
    static size_t cell_at(int32_t cell) { return static_cast<size_t>(cell); }

    uint64_t key(int32_t cell) const { return std::bit_cast<uint64_t>(field_.to_go[cell_at(cell)]); }

    // The sign is never set, so that 63 bits may differ and a word tells which buckets are filled.
    size_t bucket_of(int32_t cell) const { return static_cast<size_t>(std::bit_width(key(cell) ^ last_)); }

    void set_head(size_t bucket, int32_t cell) {
        heads_[bucket] = cell;
        const uint64_t bit = uint64_t{1} << bucket;
        filled_ = cell >= 0 ? filled_ | bit : filled_ & ~bit;
    }

    void link(int32_t cell, size_t bucket) {
        const int32_t head = heads_[bucket];
        field_.next[cell_at(cell)] = head;
        field_.previous[cell_at(cell)] = nobody;
        if (head >= 0) field_.previous[cell_at(head)] = cell;
        set_head(bucket, cell);
    }

    // The least of a bucket becomes the last taken out, and all of them move to lower buckets.
    void spread(size_t bucket) {
        int32_t cell = heads_[bucket];
        set_head(bucket, nobody);
        last_ = key(cell);
        for (int32_t other = cell; other >= 0; other = field_.next[cell_at(other)])
            last_ = std::min(last_, key(other));
        while (cell >= 0) {
            const int32_t next = field_.next[cell_at(cell)];
            put(cell);
            cell = next;
        }
    }

    const CostField& field_;
    std::array<int32_t, 64> heads_;
    uint64_t filled_ = 0;
    uint64_t last_ = 0;
};

}  // namespace

void find_cost_to_go(const CostField& field, std::span<const int32_t> goals, double resolution) {
    std::fill(field.to_go.begin(), field.to_go.end(), infinity);
    CellHeap heap(field);
    for (const int32_t goal : goals) {
        double& cost = field.to_go[static_cast<size_t>(goal)];
        if (cost == 0 || field.costs[static_cast<size_t>(goal)] == infinity) continue;
        cost = 0;
        heap.put(goal);
    }
    // Half of a step: it is multiplied by the sum of two costs.
    const double straight = resolution / 2, diagonal = straight * std::numbers::sqrt2;
    const std::array<int32_t, 4> sides{1, field.cols, -1, -field.cols};
    while (!heap.empty()) {
        const int32_t cell = heap.take_least();
        const double here = field.to_go[static_cast<size_t>(cell)];
        const double cost = static_cast<double>(field.costs[static_cast<size_t>(cell)]);
        const auto step = [&](int32_t to, double half_length) {
            const double through =
                here + half_length * (cost + static_cast<double>(field.costs[static_cast<size_t>(to)]));
            double& known = field.to_go[static_cast<size_t>(to)];
            if (!(through < known)) return;
            if (known < infinity) heap.take_out(to);
            known = through;
            heap.put(to);
        };
        std::array<bool, 4> open;
        for (size_t i = 0; i < 4; ++i) {
            const int32_t to = cell + sides[i];
            open[i] = static_cast<double>(field.costs[static_cast<size_t>(to)]) < infinity;
            if (open[i]) step(to, straight);
        }
        for (size_t i = 0; i < 4; ++i) {
            const size_t after = (i + 1) % 4;
            if (open[i] && open[after]) step(cell + sides[i] + sides[after], diagonal);
        }
    }
}

}  // namespace echogrid
