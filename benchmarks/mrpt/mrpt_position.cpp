// MRPT's particle filters, fed with sonar readings and odometry.
//
//     mrpt_position slam < drive > poses       # CMetricMapBuilderRBPF, of which the program rbpf-slam consists
//     mrpt_position localise < drive > poses   # CMonteCarloLocalization2D, of which pf-localization consists
//     mrpt_position --version                  # of MRPT
//
// The drive is a text header, one "key number" to a line and then the line "data", followed by doubles in the
// machine's byte order: `sonars` mounts of x, y (m) and axis (rad, counter-clockwise) in the robot's frame, then
// `frames` rows of x, y (m), heading (rad) by odometry and one range (m) a sonar, inf = no echo, nan = not fired; to
// localise, a pose x, y, heading where the robot about begins, and rows * cols probabilities of *free* too, row 0 at
// the lowest y. The poses come back in the same manner: a header (frames, updates, seconds, cpu_seconds), "data", the
// pose of each frame as it was known when it came, and as it is known in the end (slam; else once more the same).
//
// Between two updates of a filter poses go on by odometry. A reading without an echo is left out: MRPT's likelihood
// knows none.
//
// Wrong input is one line on stderr and exit status 2.

#include <mrpt/maps/CMultiMetricMap.h>
#include <mrpt/maps/COccupancyGridMap2D.h>
#include <mrpt/obs/CActionCollection.h>
#include <mrpt/obs/CActionRobotMovement2D.h>
#include <mrpt/obs/CObservationRange.h>
#include <mrpt/obs/CSensoryFrame.h>
#include <mrpt/random.h>
#include <mrpt/slam/CMetricMapBuilderRBPF.h>
#include <mrpt/slam/CMonteCarloLocalization2D.h>
#include <mrpt/system/os.h>

#include <chrono>
#include <cmath>
#include <ctime>
#include <deque>
#include <exception>
#include <iostream>
#include <limits>
#include <memory>
#include <string>
#include <vector>

#include "input.hpp"

namespace
{
constexpr double PI = 3.14159265358979323846;
constexpr double INF = std::numeric_limits<double>::infinity();
constexpr double MAX_CELLS = 4e8;

using mrpt::maps::COccupancyGridMap2D;
using mrpt::obs::CActionRobotMovement2D;
using mrpt::poses::CPose2D;
using mrpt::poses::CPose3D;

// What both filters are told.
struct Options
{
    size_t particles;
    double update_m, update_rad;              // way and turn between two updates
    double way, heading, turned;              // sigmas: m a m, rad a m, rad a rad of such a way
    COccupancyGridMap2D::TLikelihoodOptions likelihood;
    double power;                             // of a likelihood
    unsigned seed;
};

struct Drive
{
    double beam_width, max_range;  // rad, m
    size_t sonars, frames;
    std::vector<double> mounts;  // [sonars, 3]
    std::vector<double> table;   // [frames, 3 + sonars]

    CPose2D pose(size_t frame) const
    {
        const double* row = &table[frame * (3 + sonars)];
        return {row[0], row[1], row[2]};
    }
};

// Poses of all frames, and what they cost.
struct Answer
{
    std::vector<CPose2D> then, end;
    size_t updates = 0;
};

Options read_options(Header& header)
{
    Options options;
    options.particles = header.count("particles", 1e6);
    options.update_m = header.take("update_m", 1e-3, 1e3);
    options.update_rad = header.take("update_rad", 1e-3, 1e3);
    options.way = header.take("way", 0, 10);
    options.heading = header.take("heading", 0, 10);
    options.turned = header.take("turned", 0, 10);
    auto& likelihood = options.likelihood;
    likelihood.likelihoodMethod = COccupancyGridMap2D::lmLikelihoodField_Thrun;
    likelihood.LF_stdHit = static_cast<float>(header.take("hit", 1e-3, 10));
    likelihood.LF_maxCorrsDistance = static_cast<float>(header.take("correspondence", 1e-3, 100));
    likelihood.LF_alternateAverageMethod = header.flag("average");
    options.power = header.take("power", 1e-6, 1);
    options.seed = static_cast<unsigned>(header.count("seed", 4e9));
    return options;
}

Drive read_sizes(Header& header)
{
    Drive drive;
    drive.beam_width = header.take("beam_width", 1e-3, PI);
    drive.max_range = header.take("max_range", 1e-3, 1e3);
    drive.sonars = header.count("sonars", 1e4);
    drive.frames = header.count("frames", 1e8);
    return drive;
}

void read_tables(std::istream& in, Drive& drive)
{
    drive.mounts = read_doubles(in, drive.sonars * 3, "mounts");
    drive.table = read_doubles(in, drive.frames * (3 + drive.sonars), "frames");
    for (const double value : drive.mounts)
        if (!(std::abs(value) <= 1e4)) fail("mounts", std::to_string(value), "finite metres and radians");
    for (size_t i = 0; i < drive.frames; i++)
    {
        const double* row = &drive.table[i * (3 + drive.sonars)];
        const std::string where = "frames[" + std::to_string(i) + "]";
        for (int k = 0; k < 3; k++)
            if (!(std::abs(row[k]) <= 1e4))
                fail(where, "a pose of " + std::to_string(row[k]), "m and rad within 10 km");
        for (size_t s = 0; s < drive.sonars; s++)
            if (row[3 + s] < 0) fail(where, "a range of " + std::to_string(row[3 + s]), "0 or more, inf or nan");
    }
}

void check_end(std::istream& in)
{
    if (in.peek() != std::istream::traits_type::eof()) fail("data", "more bytes after the last", "none");
}

// The readings of a frame that heard something, one observation to a sonar: MRPT gives all readings of one observation
// the pose of its first sonar. `turn` (rad) turns each to the left.
mrpt::obs::CSensoryFrame readings(const Drive& drive, size_t frame, double turn)
{
    mrpt::obs::CSensoryFrame result;
    for (size_t s = 0; s < drive.sonars; s++)
    {
        const double range = drive.table[frame * (3 + drive.sonars) + 3 + s];
        if (!std::isfinite(range) || range <= 0) continue;
        const double* mount = &drive.mounts[3 * s];
        auto heard = std::make_shared<mrpt::obs::CObservationRange>();
        heard->sensorConeApperture = static_cast<float>(drive.beam_width);
        heard->maxSensorDistance = static_cast<float>(drive.max_range + 0.01);
        heard->sensedData.resize(1);
        heard->sensedData[0].sensedDistance = static_cast<float>(range);
        heard->sensedData[0].sensorPose = mrpt::math::TPose3D(mount[0], mount[1], 0, mount[2] + turn, 0, 0);
        result.insert(heard);
    }
    return result;
}

mrpt::obs::CActionCollection movement(const CPose2D& step, const Options& options)
{
    CActionRobotMovement2D::TMotionModelOptions model;
    model.modelSelection = CActionRobotMovement2D::mmGaussian;
    model.gaussianModel.a1 = options.way;
    model.gaussianModel.a2 = 0;
    model.gaussianModel.a3 = options.heading;
    model.gaussianModel.a4 = options.turned;
    model.gaussianModel.minStdXY = 1e-3;
    model.gaussianModel.minStdPHI = 1e-3;
    CActionRobotMovement2D moved;
    moved.computeFromOdometry(step, model);
    mrpt::obs::CActionCollection result;
    result.insert(moved);
    return result;
}

mrpt::bayes::CParticleFilter::TParticleFilterOptions filter_options(const Options& options)
{
    mrpt::bayes::CParticleFilter::TParticleFilterOptions result;
    result.sampleSize = static_cast<unsigned>(options.particles);
    result.powFactor = options.power;
    result.PF_algorithm = mrpt::bayes::CParticleFilter::pfStandardProposal;
    result.resamplingMethod = mrpt::bayes::CParticleFilter::prSystematic;
    return result;
}

bool far_enough(const CPose2D& step, const Options& options)
{
    return step.norm() >= options.update_m || std::abs(step.phi()) >= options.update_rad;
}

// The poses begin at 0, 0, 0.
Answer slam(const Drive& drive, const Options& options, double cell, bool centred,
            const COccupancyGridMap2D::TInsertionOptions& insertion)
{
    mrpt::slam::CMetricMapBuilderRBPF::TConstructionOptions set_up;
    COccupancyGridMap2D::TMapDefinition grid;
    grid.resolution = static_cast<float>(cell);
    grid.insertionOpts = insertion;
    grid.likelihoodOpts = options.likelihood;
    set_up.mapsInitializers.push_back(grid);
    set_up.PF_options = filter_options(options);
    set_up.verbosity_level = mrpt::system::LVL_ERROR;
    // When is decided here, and so is with which cones: all calls that come here update, and none inserts.
    set_up.localizeLinDistance = set_up.localizeAngDistance = -1;
    set_up.insertionLinDistance = set_up.insertionAngDistance = std::numeric_limits<float>::max();
    mrpt::slam::CMetricMapBuilderRBPF builder(set_up);
    // MRPT's map draws the cone from the axis clockwise, its likelihood to both sides.
    const double turn = centred ? drive.beam_width / 2 : 0;
    const auto insert = [&](size_t frame) {
        auto heard = readings(drive, frame, turn);
        builder.mapPDF.insertObservation(heard);
    };

    Answer answer;
    std::vector<size_t> node;  // of each frame, in the paths
    std::vector<CPose2D> since;
    size_t last = 0;
    insert(0);
    CPose2D at;
    for (size_t i = 0; i < drive.frames; i++)
    {
        CPose2D step = drive.pose(i) - drive.pose(last);
        if (far_enough(step, options))
        {
            auto moved = movement(step, options);
            auto heard = readings(drive, i, 0);
            builder.processActionObservation(moved, heard);
            insert(i);
            last = i;
            step = CPose2D();
            answer.updates++;
            at = CPose2D(builder.getCurrentPoseEstimation()->getMeanVal());
        }
        node.push_back(answer.updates);
        since.push_back(step);
        answer.then.push_back(at + step);
    }
    std::deque<mrpt::math::TPose3D> path;
    builder.getCurrentMostLikelyPath(path);
    if (path.size() != answer.updates + 1) throw std::runtime_error("MRPT's path has another length than its updates");
    for (size_t i = 0; i < drive.frames; i++)
        answer.end.push_back(CPose2D(CPose3D(path[node[i]])) + since[i]);
    return answer;
}

Answer localise(const Drive& drive, const Options& options, const COccupancyGridMap2D::Ptr& grid, const CPose2D& start,
                double start_m, double start_rad)
{
    mrpt::slam::CMonteCarloLocalization2D guesses(options.particles);
    guesses.options.metricMap = grid;
    auto& random = mrpt::random::getRandomGenerator();
    for (auto& particle : guesses.m_particles)
    {
        particle.d.x = random.drawGaussian1D(start.x(), start_m);
        particle.d.y = random.drawGaussian1D(start.y(), start_m);
        particle.d.phi = random.drawGaussian1D(start.phi(), start_rad);
        particle.log_w = 0;
    }
    mrpt::bayes::CParticleFilter filter;
    filter.m_options = filter_options(options);
    filter.setVerbosityLevel(mrpt::system::LVL_ERROR);

    Answer answer;
    size_t last = 0;
    CPose2D at = start;
    for (size_t i = 0; i < drive.frames; i++)
    {
        CPose2D step = drive.pose(i) - drive.pose(last);
        if (far_enough(step, options))
        {
            auto moved = movement(step, options);
            auto heard = readings(drive, i, 0);
            filter.executeOn(guesses, &moved, &heard);
            at = guesses.getMeanVal();
            last = i;
            step = CPose2D();
            answer.updates++;
        }
        answer.then.push_back(at + step);
    }
    answer.end = answer.then;
    return answer;
}

void write(const std::vector<CPose2D>& poses)
{
    for (const auto& pose : poses)
    {
        const double row[] = {pose.x(), pose.y(), pose.phi()};
        std::cout.write(reinterpret_cast<const char*>(row), sizeof row);
    }
}

// What `work` answers goes to standard output, with the time that it took.
template <class Work>
void timed(const Drive& drive, const Options& options, Work work)
{
    mrpt::random::getRandomGenerator().randomize(options.seed);
    const auto begin = std::chrono::steady_clock::now();
    const std::clock_t cpu_begin = std::clock();
    const Answer answer = work();
    const auto cpu_seconds = static_cast<double>(std::clock() - cpu_begin) / CLOCKS_PER_SEC;
    const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - begin;
    std::cout.precision(17);
    std::cout << "frames " << drive.frames << "\nupdates " << answer.updates << "\nseconds " << seconds.count()
              << "\ncpu_seconds " << cpu_seconds << "\ndata\n";
    write(answer.then);
    write(answer.end);
    std::cout.flush();
    if (!std::cout) throw std::runtime_error("the poses could not be written");
}

void run_slam(std::istream& in)
{
    Header header(in);
    Drive drive = read_sizes(header);
    const Options options = read_options(header);
    const double cell = header.take("cell", 1e-2, 10);
    const bool centred = header.flag("centred");
    COccupancyGridMap2D::TInsertionOptions insertion;
    insertion.maxDistanceInsertion = static_cast<float>(drive.max_range + 0.01);
    insertion.maxOccupancyUpdateCertainty = static_cast<float>(header.take("occupied_certainty", 0.5, 1));
    insertion.considerInvalidRangesAsFreeSpace = false;
    header.check_all_taken();
    if (drive.max_range / cell > 1000) fail("cell", std::to_string(cell), "a thousandth of max_range or more");
    read_tables(in, drive);
    check_end(in);
    timed(drive, options, [&] { return slam(drive, options, cell, centred, insertion); });
}

void run_localise(std::istream& in)
{
    Header header(in);
    Drive drive = read_sizes(header);
    const Options options = read_options(header);
    const double cell = header.take("cell", 1e-2, 10);
    const double start_m = header.take("start_m", 0, 100), start_rad = header.take("start_rad", 0, PI);
    const double x0 = header.take("x0", -1e4, 1e4), y0 = header.take("y0", -1e4, 1e4);
    const size_t rows = header.count("rows", MAX_CELLS), cols = header.count("cols", MAX_CELLS);
    if (static_cast<double>(rows) * static_cast<double>(cols) > MAX_CELLS)
        fail("rows * cols", std::to_string(rows) + " x " + std::to_string(cols), "at most 4e8 cells");
    header.check_all_taken();
    read_tables(in, drive);
    const auto start = read_doubles(in, 3, "start");
    for (const double value : start)
        if (!(std::abs(value) <= 1e4)) fail("start", std::to_string(value), "m and rad within 10 km");
    const auto free = read_doubles(in, rows * cols, "map");
    check_end(in);
    const auto grid = std::make_shared<COccupancyGridMap2D>();
    const auto side = static_cast<float>(cell);
    grid->setSize(static_cast<float>(x0), static_cast<float>(x0 + static_cast<double>(cols) * cell),
                 static_cast<float>(y0), static_cast<float>(y0 + static_cast<double>(rows) * cell), side);
    // MRPT puts borders on whole cells, by which a grid may get one more.
    for (size_t row = 0; row < rows; row++)
        for (size_t col = 0; col < cols; col++)
        {
            const double p = free[row * cols + col];
            if (!(0 <= p && p <= 1)) fail("map", std::to_string(p), "probabilities");
            grid->setPos(static_cast<float>(x0 + (static_cast<double>(col) + 0.5) * cell),
                        static_cast<float>(y0 + (static_cast<double>(row) + 0.5) * cell), static_cast<float>(p));
        }
    grid->likelihoodOptions = options.likelihood;
    const CPose2D begin(start[0], start[1], start[2]);
    timed(drive, options, [&] { return localise(drive, options, grid, begin, start_m, start_rad); });
}
}  // namespace

int main(int argc, char** argv)
{
    std::ios::sync_with_stdio(false);
    const std::string task = argc == 2 ? argv[1] : "";
    try
    {
        if (task == "--version")
            std::cout << mrpt::system::MRPT_getVersion() << "\n";
        else if (task == "slam")
            run_slam(std::cin);
        else if (task == "localise")
            run_localise(std::cin);
        else
            fail("command line", argc > 1 ? argv[1] : "nothing", "slam, localise or --version");
    }
    catch (const Wrong& error)
    {
        std::cerr << "mrpt_position: " << error.what() << "\n";
        return 2;
    }
    catch (const std::exception& error)
    {
        std::cerr << "mrpt_position: " << error.what() << "\n";
        return 1;
    }
}
