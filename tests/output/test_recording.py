"""What is kept of a drive while it is mapped."""

import numpy as np

from echogrid.mapping import build as mapping
from echogrid.output import recording as recorded
from echogrid.output.recording import Recording
from page_samples import ROBOT, a_frame, a_grid


def test_a_recording_stays_bounded_and_keeps_the_last_scan():
    recording, grid = Recording(ROBOT), a_grid(20, 20)
    frame = a_frame(0)
    for k in range(16_003):
        recording.add(frame)
        assert len(recording._frames) <= recorded.MAX_SCANS
        if k % 20 == 0:
            recording.keep(grid)
            assert len(recording._maps) <= recorded.MAX_MAPS
    numbers = [number for number, _ in recording.frames()]
    assert recording.stride == 8
    assert numbers == [*range(1, 16_003, 8), 16_003]
    steps = np.diff([kept.read for kept in recording.maps()])
    assert len(steps) >= recorded.MAX_MAPS // 2 - 1
    assert len(set(steps)) == 1


def test_a_map_that_lags_behind_the_reading_is_given_its_time():
    """As ``build_map`` does it: batches of 64 and a frame ahead, two batches waiting."""
    assert recorded.AHEAD == mapping.WORKERS
    recording, grid = Recording(ROBOT), a_grid(20, 20)
    read = [64 * k + 1 for k in range(1, 8)] + [500]
    seen = [*read[2:], 500, 500]
    for scans in seen:
        while recording.scans < scans:
            recording.add(a_frame(0))
        recording.keep(grid)
    assert [kept.scans for kept in recording.maps()] == [64, 128, *read[2:-1]]
