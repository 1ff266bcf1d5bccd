import resource
from dataclasses import replace
from math import inf, nan
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bag_samples import DRIVE, FRAMES, assert_same_frames, refused, rosbag_of, with_rosbag
from bag_writers import B21, FORMATS, START_S, Said, drive, file_of, in_order, odometry, ranging, time_of, write
from echogrid.bags.bag_file import BagFile
from echogrid.bags.recognising import recognises
from echogrid.errors import InputError
from echogrid.frame import Frame
from echogrid.logs.formats import load_log
from echogrid.ros.messages import RangeSaid


@with_rosbag
def test_a_bag_without_its_index_says_how_to_mend_it(tmp_path, capsys):
    path = rosbag_of(tmp_path / "killed.bag", unindexed=True)
    assert "rosbag reindex" in refused(capsys, path)


@pytest.mark.parametrize("form", FORMATS)
def test_ranges_are_decoded_as_the_general_decoder_does(tmp_path, form):
    told = [ranging(START_S + n, "/s", "f" * n, 0.1 + n, B21, field_of_view=0.1 * n) for n in range(10)]
    told += [
        ranging(1.5, "/s", "Sonär", inf),
        ranging(2.0, "/s", "x", nan, max_range=-inf),
    ]
    for little in (True, False):
        path = write(tmp_path / f"{form}{little}.bag", in_order(told), form, little=little) if form == "bag" else None
        path = path or write(tmp_path / f"{form}{little}", in_order(told), form, little=little)
        with BagFile(path) as opened:
            found = [message.content for message in opened.messages({"/s"})]
        for one, said in zip(found, in_order(told), strict=True):
            assert isinstance(one, RangeSaid)
            content = said.content
            expected = [content[name] for name in ("field_of_view", "min_range", "max_range", "range")]
            assert one.frame == content["header"]["frame_id"]
            at = content["header"]["stamp"]
            assert one.stamp == at["sec"] + at["nanosec"] * 1e-9
            np.testing.assert_array_equal(np.array(one[2:], "f4"), np.array(expected, "f4"))


def test_the_range_of_newer_distributions_is_read_too(tmp_path):
    store = get_typestore(Stores.ROS2_JAZZY)
    path = write(tmp_path / "jazzy", drive(FRAMES[:5]), "sqlite3", store=store)
    assert_same_frames(load_log(path), FRAMES[:5])


def test_a_range_whose_fields_are_in_another_order_is_read_by_its_definition(tmp_path):
    store = get_typestore(Stores.ROS2_HUMBLE)
    other = get_typestore(Stores.EMPTY)
    other.register({name: store.fielddefs[name] for name in store.fielddefs if name != "sensor_msgs/msg/Range"})
    fields = "std_msgs/Header header\nfloat32 range\nfloat32 max_range\nfloat32 min_range\nfloat32 field_of_view"
    other.register(get_types_from_msg(fields, "sensor_msgs/msg/Range"))
    path = write(tmp_path / "other", drive(FRAMES[:5]), "mcap", store=other)
    assert_same_frames(load_log(path), FRAMES[:5])


@pytest.mark.parametrize("name", ["drive.mcap", "drive", "drive.bag.gz", "drive.db3"])
def test_a_bag_with_the_ending_of_another_says_which_it_is(put, tmp_path, capsys, name):
    path = put(DRIVE[:50]).rename(tmp_path / name)
    assert "begins like .bag" in refused(capsys, path)


def test_an_mcap_with_channels_that_are_not_of_ros_is_not_called_damaged(tmp_path, capsys):
    path = tmp_path / "drive.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        schema = writer.register_schema("log", "jsonschema", b"{}")
        channel = writer.register_channel("/log", "json", schema)
        writer.add_message(channel, 0, b"{}", 0)
        writer.finish()
    assert "channels of jsonschema in an MCAP, expected messages of ROS 2 alone" in refused(capsys, path)


def test_a_folder_without_its_metadata_says_which_file_to_take(put, capsys):
    path = put(DRIVE, "mcap")
    (path / "metadata.yaml").unlink()
    line = refused(capsys, path)
    assert "a folder without metadata.yaml" in line
    assert str(file_of(path)) in line
    assert_same_frames(load_log(file_of(path)), FRAMES)


def test_a_folder_whose_file_is_gone_is_refused(put, capsys):
    path = put(DRIVE, "sqlite3")
    file_of(path).unlink()
    assert "cut off or damaged" in refused(capsys, path)


SHORT = [Frame(frame.stamp, frame.pose, frame.ranges[:3]) for frame in FRAMES[:8]]
TRIO = replace(B21, mounts=B21.mounts[:3])


@pytest.fixture(scope="module")
def small(folder):
    """The ending and the bytes of a short bag of a format."""
    out = {}
    for form in FORMATS:
        name = "small.bag" if form == "bag" else f"small-{form}"
        path = file_of(write(folder / name, drive(SHORT, robot=TRIO), form))
        out[form] = path.suffix, path.read_bytes()
    return lambda form: out[form]


def survives(path: Path) -> InputError | None:
    """Read all of a bag; its error if it has one."""
    found = None
    try:
        assert len(list(load_log(path))) <= 200
    except InputError as error:
        found = error
    assert found is None or (len(str(found)) < 600 and str(found).isprintable())
    return found


@pytest.mark.parametrize("form", FORMATS)
def test_a_bag_cut_off_anywhere_is_refused(small, tmp_path, form):
    suffix, whole = small(form)
    path = tmp_path / f"cut{suffix}"
    path.write_bytes(whole)
    assert survives(path) is None
    for length in [0, 1, 5, 8, 12, 13, 16, *np.linspace(17, len(whole) - 1, 40).astype(int).tolist()]:
        path.write_bytes(whole[:length])
        # Of a database the last page may hold nothing that is looked at.
        assert survives(path) is not None or (form == "sqlite3" and length > len(whole) - 4096), length


edits = st.lists(
    st.tuples(st.floats(0, 1), st.sampled_from(["flip", "set", "cut", "double", "long"]), st.integers(0, 255)),
    min_size=1,
    max_size=4,
)


@pytest.mark.parametrize("form", FORMATS)
@given(edits=edits)
@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_bytes_a_bag_holds_nothing_but_one_line_comes_of_it(small, tmp_path, form, edits):
    suffix, whole = small(form)
    content = bytearray(whole)
    for share, kind, value in edits:
        at = int(share * (len(content) - 1))
        match kind:
            case "flip":
                content[at] ^= 1 << value % 8
            case "set":
                content[at] = value
            case "cut":
                del content[at : at + 1 + value]
            case "double":
                content[at:at] = content[at : at + value]
            case "long":
                content[at : at + 4] = b"\xff\xff\xff\x7f"
    path = tmp_path / f"any{suffix}"
    path.write_bytes(content)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    survives(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000, "kB that it took at most"


@pytest.mark.parametrize(
    ("kind", "wrong"),
    [
        ("tf2_msgs/msg/TFMessage", "std_msgs/Header[] transforms"),
        ("tf2_msgs/msg/TFMessage", "geometry_msgs/TransformStamped transforms"),
        ("tf2_msgs/msg/TFMessage", "string[] transforms"),
        ("nav_msgs/msg/Odometry", "std_msgs/Header header\nint32 child_frame_id"),
        ("sensor_msgs/msg/Range", "std_msgs/Header header\nfloat32 range"),
        ("sensor_msgs/msg/Range", "std_msgs/Header header\nstring range\n" + "float32 {}\n" * 3),
    ],
)
def test_definitions_without_the_fields_that_are_read_are_refused(tmp_path, capsys, kind, wrong):
    wrong = wrong.format("field_of_view", "min_range", "max_range")
    store, whole = get_typestore(Stores.EMPTY), get_typestore(Stores.ROS2_HUMBLE)
    store.register({name: whole.fielddefs[name] for name in whole.fielddefs if name != kind})
    store.register(get_types_from_msg(wrong, kind))
    said = [
        *(said for said in DRIVE if said.type != kind),
        *(odometry(time_of(frame), frame.pose) for frame in FRAMES if "Odometry" not in kind),
        *(Said("/any", time_of(frame), kind, {}) for frame in FRAMES),
    ]
    path = write(tmp_path / "drive", in_order(said), "mcap", store=store)
    assert f"found a definition of {kind} without" in refused(capsys, path)


@pytest.mark.parametrize(("content", "found"), [(b"", "an empty file"), (b"#ROSB", "does not begin like a bag")])
def test_a_file_that_is_none_is_refused_by_its_name(tmp_path, capsys, content, found):
    for suffix in (".bag", ".mcap", ".db3"):
        path = tmp_path / f"drive{suffix}"
        path.write_bytes(content)
        assert found in refused(capsys, path)


def test_what_is_no_bag_is_left_to_the_other_readers(tmp_path):
    assert not recognises(Path(__file__))
    assert not recognises(tmp_path)
    assert not recognises(tmp_path / "absent.bag")
