import warnings
from dataclasses import replace

import numpy as np
import pytest
from numpy import inf

from echogrid import DoubtWarning, Frame, Log, Robot, build_map
from echogrid.doubts import STAYS
from echogrid.errors import UsageError
from echogrid.models.batches import BATCH
from echogrid.models.model import Evidence, Fusion, Model

pytestmark = pytest.mark.filterwarnings("ignore::echogrid.DoubtWarning")  # places in no order of driving

B21 = Robot.load("b21")
POINT_LIKE = Robot("point", 0.0, B21.transducer, 0.1, 5.0, B21.beam_width_rad, B21.mounts[::6])
"""Four sonars and no body: no cell is under it."""


class Visits(Model):
    """A kind of model that nobody has heard of: it counts in each cell the scans that were taken in it."""

    name, cell_m = "visits", 0.5

    def told(self):
        return {}

    def fusion(self, robot, resolution, half_life=None):
        self.refuse_fading(half_life)
        return Visiting(robot, resolution)


class Visiting(Fusion):
    def __init__(self, robot, resolution):
        self.blank, self.resolution = {}, resolution
        super().__init__(robot)

    def read(self, batch, filled=False):
        cells = np.array([np.floor(frame.pose[1::-1] / self.resolution) for frame in batch], dtype=np.int64)
        return lambda: Evidence(cells.min(axis=0), cells.max(axis=0) + 1, cells)

    def fuse(self, grown, evidence):
        for cell in evidence.told:
            there = grown.window(cell, (1, 1))
            there["log_odds"] += 1
            there["observed"][:] = True


def frame(x, y, theta, ranges=None):
    return Frame(0.0, np.array([x, y, theta], dtype=float), np.full(4, 1.0) if ranges is None else ranges)


def wandering(count):
    rng = np.random.default_rng(0)
    return [frame(*pose) for pose in np.column_stack([rng.uniform(-1, 1, (count, 2)), rng.uniform(-3, 3, count)])]


MANY = wandering(2 * BATCH + 2)


def test_a_new_kind_of_model_maps_by_what_it_says_itself():
    *_, grid = build_map([frame(0.1, 0.1, 0), frame(0.2, 0.2, 0), frame(0.6, 0.1, 0)], POINT_LIKE, Visits())
    np.testing.assert_array_equal(grid.log_odds, [[2, 1]])
    assert (grid.resolution, grid.origin) == (0.5, (0.0, 0.0))
    *_, coarse = build_map(MANY, POINT_LIKE, Visits(), 4.0)
    assert (coarse.log_odds.sum(), coarse.shape) == (len(MANY), (2, 2))
    with pytest.raises(
        UsageError, match=r"^map: found model visits, expected the set network, whose evidence can fade$"
    ):
        list(build_map(MANY, POINT_LIKE, Visits(), half_life=5.0))


@pytest.mark.parametrize(
    ("count", "steps"), [(0, 0), (1, 1), (BATCH - 1, 1), (BATCH, 1), (BATCH + 1, 2), (len(MANY), 3)]
)
def test_the_map_is_shown_after_each_batch(count, steps):
    seen = [grid.observed.sum() for grid in build_map(MANY[:count], POINT_LIKE, Visits())]
    assert len(seen) == steps
    assert seen == sorted(seen)


@pytest.mark.parametrize("lengths", [(3,), (5,), (4, 4, 0), (*[4] * BATCH, 24)])
def test_frames_that_do_not_fit_the_robot_are_refused_in_one_line(lengths):
    frames = [frame(0, 0, 0, np.full(n, inf)) for n in lengths]
    where = rf"^map: frame {len(lengths) - 1} \(stamp 0.0 s\)"
    with pytest.raises(UsageError, match=rf"{where}: found {lengths[-1]} readings, expected 4 \(robot point\)$"):
        list(build_map(frames, POINT_LIKE, Visits()))


def test_a_pose_that_is_far_off_is_refused_in_one_line():
    with pytest.raises(UsageError, match=r"^map: found a drive that spans 1e\+07 x .* m at 0.5 m a cell, expected"):
        list(build_map([frame(0, 0, 0), *[frame(1e7, 1e7, 0)] * (STAYS + 1)], POINT_LIKE, Visits()))


def test_frames_are_read_once_and_no_more_than_a_few_batches_ahead():
    given = []

    def stream():
        for each in MANY * 4:
            given.append(each)
            yield each

    steps = build_map(stream(), POINT_LIKE, Visits())
    next(steps)
    assert len(given) <= 4 * BATCH
    del steps


def test_a_model_that_works_in_turn_reads_no_batch_ahead():
    given = []

    def stream():
        for each in MANY * 4:
            given.append(each)
            yield each

    steps = build_map(stream(), POINT_LIKE, "cone")
    next(steps)
    assert len(given) == BATCH + 1
    del steps


def driven(count=200, sonars=4):
    """Frames of a faultless drive, in a circle."""
    rng, angle = np.random.default_rng(5), np.linspace(0, 2 * np.pi, count)
    poses = np.column_stack([np.cos(angle), np.sin(angle), angle + np.pi / 2])
    return [Frame(0.2 * i, pose, rng.uniform(0.3, 4.9, sonars)) for i, pose in enumerate(poses)]


def doubts(frames, robot=POINT_LIKE):
    """What is warned of when frames are mapped, and where."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        list(build_map(frames, robot, Visits()))
    assert all(each.category is DoubtWarning and each.filename == __file__ for each in caught)
    return [str(each.message) for each in caught]


def in_cm(frames):
    return [replace(each, ranges=np.minimum(100 * each.ranges, 100.0)) for each in frames]


@pytest.mark.parametrize("handed_over", [list, iter, Log.of])
def test_doubts_about_frames_that_no_log_holds_are_warned_of_one_line_a_kind(handed_over):
    faultless = driven()
    assert doubts(handed_over(faultless)) == []
    jumps = [replace(each, pose=each.pose + np.array([3.0 * (i >= 50), 0, 0])) for i, each in enumerate(faultless)]
    (told,) = doubts(handed_over(jumps))
    length = np.hypot(*(jumps[50].pose - jumps[49].pose)[:2])
    assert told.startswith(f"the pose jumps by {length:.2f} m at 10.00 s, faster than any robot")
    (told,) = doubts(handed_over(in_cm(faultless)))
    assert "past max_range 5 m" in told
    cm = in_cm(faultless)
    far = [replace(each, pose=each.pose + np.array([2e4 * (i in (7, 8)), 0, 0])) for i, each in enumerate(cm)]
    first, second = sorted(doubts(handed_over(far)))
    assert (first, "past max_range" in second) == (
        "a scan left out: its pose is where no robot can have got to (2 times)",
        True,
    )


def test_a_log_that_knows_its_robot_tells_its_doubts_in_its_notes_alone():
    log = replace(Log.of(in_cm(driven())), robot=POINT_LIKE)
    assert doubts(log) == []
    assert len(log.notes) == 1
