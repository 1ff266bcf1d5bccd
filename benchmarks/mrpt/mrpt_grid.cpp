// MRPT's occupancy grid, fed with sonar readings.
//
//     mrpt_grid < drive > map
//     mrpt_grid --version          # of MRPT
//
// The drive is a text header, one "key number" to a line and then the line "data", followed by doubles in the
// machine's byte order: `sonars` mounts of x, y (m) and axis (rad, counter-clockwise) in the robot's frame, then
// `frames` rows of the robot's x, y (m), heading (rad) and one range (m) a sonar, inf = no echo, nan = not fired.
// The map comes back in the same manner: a header (rows, cols, x0, y0, resolution, seconds, cpu_seconds, scans,
// readings), "data", and rows * cols floats, row 0 at the lowest y: MRPT's probabilities as they are, which is to say of
// *free*.
//
// Wrong input is one line on stderr and exit status 2.

#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/obs/CObservationRange.h>
#include <mrpt/system/os.h>

#include <algorithm>
#include <chrono>
#include <cmath>
#include <ctime>
#include <exception>
#include <iostream>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "input.hpp"

namespace
{
constexpr double PI = 3.14159265358979323846;
constexpr double INF = std::numeric_limits<double>::infinity();

// MRPT enlarges a grid when the end of a reading comes within 15 cells of its border, and so moves its cells; it also
// does not count the corners of the cone when it does so.
constexpr double BORDER_CELLS = 17;

// MRPT draws the sides of a cone with 9 fractional bits a cell; a side that rises by one row over 2^10 columns rounds
// to no rise at all, and its loop never ends.
constexpr double MAX_SIDE_CELLS = 1000;

constexpr double MAX_CELLS = 4e8;

struct Drive
{
    size_t rows, cols;
    double x0, y0;            // lower left corner of cell [0, 0] in the world, m
    double resolution;        // m
    double beam_width;        // full width, rad
    bool centred;             // whether the cone is turned back onto the sonar's axis
    double no_echo;           // the distance that MRPT is given where no echo came back, m; may be inf
    mrpt::maps::COccupancyGridMap2D::TInsertionOptions options;
    size_t sonars, frames;
    std::vector<double> mounts;  // [sonars, 3]
    std::vector<double> table;   // [frames, 3 + sonars]
};

Drive read_drive(std::istream& in)
{
    Header header(in);
    Drive drive;
    drive.rows = header.count("rows", MAX_CELLS);
    drive.cols = header.count("cols", MAX_CELLS);
    if (static_cast<double>(drive.rows) * static_cast<double>(drive.cols) > MAX_CELLS)
        fail("rows * cols", std::to_string(drive.rows) + " x " + std::to_string(drive.cols), "at most 4e8 cells");
    drive.x0 = header.take("x0", -1e8, 1e8);
    drive.y0 = header.take("y0", -1e8, 1e8);
    drive.resolution = header.take("resolution", 1e-4, 1e3);
    drive.beam_width = header.take("beam_width", 1e-3, PI);
    drive.centred = header.flag("centred");
    drive.no_echo = header.take("no_echo", 0, INF);
    auto& options = drive.options;
    options.maxDistanceInsertion = static_cast<float>(header.take("max_distance", 1e-3, 1e4));
    options.maxOccupancyUpdateCertainty = static_cast<float>(header.take("occupied_certainty", 0.5, 1));
    options.maxFreenessUpdateCertainty = static_cast<float>(header.take("free_certainty", 0, 1));
    options.considerInvalidRangesAsFreeSpace = header.flag("invalid_as_free");
    drive.sonars = header.count("sonars", 1e4);
    drive.frames = header.count("frames", 1e8);
    header.check_all_taken();
    drive.mounts = read_doubles(in, drive.sonars * 3, "mounts");
    drive.table = read_doubles(in, drive.frames * (3 + drive.sonars), "frames");
    if (in.peek() != std::istream::traits_type::eof()) fail("frames", "more bytes after the last", "none");
    return drive;
}

// Rewrites the table for MRPT: places counted from the grid's corner (MRPT's coordinates are single floats, too coarse
// far from the world's origin), no echo as its distance. Refuses whatever would make MRPT grow the grid, which moves
// its cells, or write past its end.
void prepare(Drive& drive)
{
    for (const double value : drive.mounts)
        if (!(std::abs(value) <= 1e4)) fail("mounts", std::to_string(value), "finite metres and radians");
    const double far = drive.options.maxDistanceInsertion;
    const double widest = std::max(1.0, 2 * std::sin(drive.beam_width / 2));  // longest side of a cone of reach 1
    for (size_t i = 0; i < drive.frames; i++)
    {
        const std::string where = "frames[" + std::to_string(i) + "]";
        double* row = &drive.table[i * (3 + drive.sonars)];
        for (int k = 0; k < 3; k++)
            if (!(std::abs(row[k]) <= 1e8)) fail(where, "a pose of " + std::to_string(row[k]), "finite m and rad");
        row[0] -= drive.x0;
        row[1] -= drive.y0;
        for (size_t s = 0; s < drive.sonars; s++)
        {
            double& range = row[3 + s];
            if (std::isnan(range)) continue;
            if (range < 0) fail(where, "a range of " + std::to_string(range), "0 or more, inf or nan");
            if (std::isinf(range)) range = drive.no_echo;
            const double reach = range < far ? range : far / 2;  // what is too far is taken for half as far
            if (reach * widest / drive.resolution > MAX_SIDE_CELLS)
                fail(where, "a cone with a side of more than 1000 cells", "larger cells or a smaller max_distance");
            const double margin = reach + BORDER_CELLS * drive.resolution;
            const double* mount = &drive.mounts[3 * s];
            const double x = row[0] + std::cos(row[2]) * mount[0] - std::sin(row[2]) * mount[1];
            const double y = row[1] + std::sin(row[2]) * mount[0] + std::cos(row[2]) * mount[1];
            if (!(margin <= x && x <= static_cast<double>(drive.cols) * drive.resolution - margin && margin <= y &&
                  y <= static_cast<double>(drive.rows) * drive.resolution - margin))
                fail(where, "a reading that comes within 17 cells of the grid's border", "a larger grid");
        }
    }
}

// One observation to a sonar: MRPT gives all readings of one observation the pose of its first sonar.
std::vector<mrpt::obs::CObservationRange> observations(const Drive& drive)
{
    std::vector<mrpt::obs::CObservationRange> result(drive.sonars);
    for (size_t s = 0; s < drive.sonars; s++)
    {
        const double* mount = &drive.mounts[3 * s];
        // MRPT draws the cone from the axis clockwise, so half a cone's turn to the left centres it on the axis.
        const double turn = drive.centred ? drive.beam_width / 2 : 0;
        result[s].sensorConeApperture = static_cast<float>(drive.beam_width);
        result[s].maxSensorDistance = drive.options.maxDistanceInsertion;
        result[s].sensedData.resize(1);
        result[s].sensedData[0].sensorPose = mrpt::math::TPose3D(mount[0], mount[1], 0, mount[2] + turn, 0, 0);
    }
    return result;
}

// Number of readings inserted.
size_t insert(const Drive& drive, mrpt::maps::COccupancyGridMap2D& grid)
{
    auto sonars = observations(drive);
    size_t readings = 0;
    for (size_t i = 0; i < drive.frames; i++)
    {
        const double* row = &drive.table[i * (3 + drive.sonars)];
        const mrpt::poses::CPose3D pose(row[0], row[1], 0, row[2], 0, 0);
        for (size_t s = 0; s < drive.sonars; s++)
        {
            if (std::isnan(row[3 + s])) continue;
            sonars[s].sensedData[0].sensedDistance = static_cast<float>(row[3 + s]);
            grid.insertObservation(sonars[s], pose);
            readings++;
        }
    }
    return readings;
}

void write_map(std::ostream& out, const Drive& drive, const mrpt::maps::COccupancyGridMap2D& grid, double seconds,
               double cpu_seconds, size_t readings)
{
    out.precision(17);
    out << "rows " << drive.rows << "\ncols " << drive.cols << "\nx0 " << drive.x0 << "\ny0 " << drive.y0
        << "\nresolution " << drive.resolution << "\nseconds " << seconds << "\ncpu_seconds " << cpu_seconds
        << "\nscans " << drive.frames << "\nreadings " << readings << "\ndata\n";
    std::vector<float> row(drive.cols);
    for (size_t y = 0; y < drive.rows; y++)
    {
        for (size_t x = 0; x < drive.cols; x++) row[x] = grid.getCell(static_cast<int>(x), static_cast<int>(y));
        out.write(reinterpret_cast<const char*>(row.data()), static_cast<std::streamsize>(row.size() * sizeof(float)));
    }
    out.flush();
    if (!out) throw std::runtime_error("the map could not be written");
}

void run()
{
    Drive drive = read_drive(std::cin);
    prepare(drive);
    mrpt::maps::COccupancyGridMap2D grid;
    const auto resolution = static_cast<float>(drive.resolution);
    grid.setSize(0, static_cast<float>(drive.cols) * resolution, 0, static_cast<float>(drive.rows) * resolution,
                 resolution);
    grid.insertionOptions = drive.options;
    const auto is_as_asked = [&] {
        return grid.getSizeX() == drive.cols && grid.getSizeY() == drive.rows && grid.getXMin() == 0 &&
               grid.getYMin() == 0;
    };
    if (!is_as_asked()) throw std::runtime_error("MRPT made a grid of another size than asked for");
    const auto begin = std::chrono::steady_clock::now();
    const std::clock_t cpu_begin = std::clock();
    const size_t readings = insert(drive, grid);
    const auto cpu_seconds = static_cast<double>(std::clock() - cpu_begin) / CLOCKS_PER_SEC;
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - begin;
    if (!is_as_asked()) throw std::runtime_error("MRPT enlarged the grid");
    write_map(std::cout, drive, grid, seconds.count(), cpu_seconds, readings);
}
}  // namespace

int main(int argc, char** argv)
{
    std::ios::sync_with_stdio(false);
    try
    {
        if (argc == 2 && std::string(argv[1]) == "--version")
            std::cout << mrpt::system::MRPT_getVersion() << "\n";
        else if (argc > 1)
            fail("command line", argv[1], "nothing (the drive comes through standard input) or --version");
        else
            run();
    }
    catch (const Wrong& error)
    {
        std::cerr << "mrpt_grid: " << error.what() << "\n";
        return 2;
    }
    catch (const std::exception& error)
    {
        std::cerr << "mrpt_grid: " << error.what() << "\n";
        return 1;
    }
}
