import numpy as np
import pytest
from evo.tools.file_interface import read_tum_trajectory_file
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from echogrid.errors import InputError, UsageError
from echogrid.geometry import wrap
from echogrid.output.trajectory import read_tum, write_tum


@st.composite
def drives(draw):
    count = draw(st.integers(1, 30))
    place = arrays(float, (count, 2), elements=st.floats(-1e3, 1e3))
    heading = arrays(float, (count, 1), elements=st.floats(-np.pi, np.pi))
    stamps = np.sort(draw(arrays(float, count, elements=st.floats(0, 2e9))))
    return stamps, np.concatenate([draw(place), draw(heading)], axis=1)


@given(drives())
def test_a_trajectory_comes_back_and_its_stamps_to_the_last_bit(tmp_path_factory, drive):
    stamps, poses = drive
    path = tmp_path_factory.mktemp("tum") / "trajectory.tum"
    write_tum(path, stamps, poses)
    again, back = read_tum(path)
    np.testing.assert_array_equal(again, stamps)
    np.testing.assert_allclose(back[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_allclose(wrap(back[:, 2] - poses[:, 2]), 0, atol=1e-8)


def test_evo_reads_the_same_poses(tmp_path):
    stamps = 1.7e9 + np.arange(50) / 3
    poses = np.random.default_rng(0).uniform(-3, 3, (50, 3))
    write_tum(tmp_path / "trajectory.tum", stamps, poses)
    read = read_tum_trajectory_file(tmp_path / "trajectory.tum")
    np.testing.assert_array_equal(read.timestamps, stamps)
    np.testing.assert_allclose(read.positions_xyz[:, :2], poses[:, :2], atol=1e-6)
    np.testing.assert_array_equal(read.positions_xyz[:, 2], 0)
    np.testing.assert_allclose(wrap(read.get_orientations_euler()[:, 2] - poses[:, 2]), 0, atol=1e-8)


def test_the_heading_of_a_turn_in_space_is_read(tmp_path):
    # A drone of heading 0.7 rad that is pitched by 0.3 rad: q = q_yaw * q_pitch.
    (cy, sy), (cp, sp) = ((np.cos(a / 2), np.sin(a / 2)) for a in (0.7, 0.3))
    quaternion = [-sy * sp, cy * sp, sy * cp, cy * cp]
    (tmp_path / "t.tum").write_text("# stamp and pose\n0.5 1 2 3 " + " ".join(f"{q:.17g}" for q in quaternion) + "\n")
    stamps, poses = read_tum(tmp_path / "t.tum")
    assert stamps.tolist() == [0.5]
    np.testing.assert_allclose(poses, [[1, 2, 0.7]], atol=1e-12)


@pytest.mark.parametrize("text", ["1 2 3\n", "0 0 0 0 0 0 0 x\n", "", "0 0 0 0 0 0 0 nan\n", "0 0 0 0 0 0 0 0\n"])
@pytest.mark.filterwarnings("error")
def test_what_is_no_trajectory_is_refused_in_one_line(tmp_path, text):
    (tmp_path / "t.tum").write_text(text)
    with pytest.raises(InputError, match=r"t\.tum.*found .*expected") as error:
        read_tum(tmp_path / "t.tum")
    assert "\n" not in str(error.value)


def test_no_file_and_no_place_for_one(tmp_path):
    with pytest.raises(InputError, match="none"):
        read_tum(tmp_path / "none.tum")
    with pytest.raises(UsageError):
        write_tum(tmp_path, np.zeros(1), np.zeros((1, 3)))
