import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from echogrid.errors import EchogridError, InputError, UsageError
from echogrid.robot import (
    MAX_SONARS,
    TRANSDUCERS,
    Robot,
    Transducer,
    parse_robot,
    preset_names,
    robot_yaml,
    surrounded,
)

# physics.md, section 4: x and y in mm, axis in degrees.
P3DX = [
    *[(69, 136, 90), (114, 119, 50), (148, 78, 30), (166, 27, 10)],
    *[(166, -27, -10), (148, -78, -30), (114, -119, -50), (69, -136, -90)],
    *[(-157, -136, -90), (-203, -119, -130), (-237, -78, -150), (-255, -27, -170)],
    *[(-255, 27, 170), (-237, 78, 150), (-203, 119, 130), (-157, 136, 90)],
]

GOOD = """\
name: my-robot
footprint_radius_m: 0.25
sonar: {transducer: polaroid-600, min_range_m: 0.15, max_range_m: 5.0, beam_width_deg: 25}
mounts:
  - [0.25, 0.00, 0]
  - [0.00, 0.25, 90]
"""

SONAR = GOOD.splitlines(keepends=True)[2]

# What is put in the place of what, and how the one line that comes of it begins after the file's name.
WRONG = {
    "name is missing": ("name: my-robot\n", "", ": name: found nothing"),
    "footprint is missing": ("footprint_radius_m: 0.25\n", "", ": footprint_radius_m: found nothing"),
    "sonar is missing": (SONAR, "", ": sonar: found nothing"),
    "minimum range is missing": ("min_range_m: 0.15, ", "", ": sonar.min_range_m: found nothing"),
    "maximum range is missing": ("max_range_m: 5.0, ", "", ": sonar.max_range_m: found nothing"),
    "beam width is missing": (", beam_width_deg: 25", "", ": sonar.beam_width_deg: found nothing"),
    "neither transducer nor frequency": ("transducer: polaroid-600, ", "", ": sonar.frequency_hz: found nothing"),
    "frequency without aperture": (
        "transducer: polaroid-600",
        "frequency_hz: 40000",
        ": sonar.aperture_radius_m: found nothing",
    ),
    "mounts are missing": (GOOD[GOOD.index("mounts") :], "", ": mounts: found nothing"),
    "unknown key on top": ("name: my-robot", "name: my-robot\nwheels: 2", ": wheels: found an unknown key"),
    "unknown key of the sonar": (
        "min_range_m",
        "shortest_m: 1, min_range_m",
        ": sonar.shortest_m: found an unknown key",
    ),
    "key that is a number": ("name: my-robot", "name: my-robot\n7: 2", ": 7: found an unknown key"),
    "text for a number": (
        "footprint_radius_m: 0.25",
        "footprint_radius_m: wide",
        ": footprint_radius_m: found 'wide'",
    ),
    "true for a number": ("max_range_m: 5.0", "max_range_m: true", ": sonar.max_range_m: found True"),
    "a number for a text": ("name: my-robot", "name: 7", ": name: found 7"),
    "an empty text": ("name: my-robot", "name: ''", ": name: found ''"),
    "a text of two lines": ("name: my-robot", 'name: "my\\nrobot"', ": name: found 'my"),
    "infinite range": ("max_range_m: 5.0", "max_range_m: .inf", ": sonar.max_range_m: found inf"),
    "range that is no number": ("max_range_m: 5.0", "max_range_m: .nan", ": sonar.max_range_m: found nan"),
    "negative range": ("min_range_m: 0.15", "min_range_m: -0.15", ": sonar.min_range_m: found -0.15"),
    "maximum below minimum": ("max_range_m: 5.0", "max_range_m: 0.1", ": sonar.max_range_m: found 0.1"),
    "maximum at minimum": ("max_range_m: 5.0", "max_range_m: 0.15", ": sonar.max_range_m: found 0.15"),
    "beam wider than half a turn": ("beam_width_deg: 25", "beam_width_deg: 250", ": sonar.beam_width_deg: found 250"),
    "unknown transducer": ("polaroid-600", "polaroid-6000", ": sonar.transducer: found polaroid-6000"),
    "sonar that is a list": (SONAR[len("sonar: ") :].strip(), "[1, 2]", ": sonar: found [1, 2]"),
    "mount too short": ("[0.00, 0.25, 90]", "[0.00, 90]", ": mounts[1]: found [0.0, 90]"),
    "mount too long": ("[0.25, 0.00, 0]", "[0.25, 0, 0, 0]", ": mounts[0]: found [0.25, 0, 0, 0]"),
    "text in a mount": ("[0.00, 0.25, 90]", "[0.00, left, 90]", ": mounts[1]: found 'left'"),
    "mount far away": ("[0.00, 0.25, 90]", "[0.00, 250, 90]", ": mounts[1]: found [0.0, 250.0, 90.0]"),
    "no mounts": (GOOD[GOOD.index("mounts") :], "mounts: []\n", ": mounts: found []"),
    "mounts that are a number": (GOOD[GOOD.index("mounts") :], "mounts: 24\n", ": mounts: found 24"),
    "too many mounts": ("mounts:\n", "mounts:\n" + "  - [0, 0, 0]\n" * MAX_SONARS, ": mounts: found 514 rows"),
    "bracket that is not closed": ("[0.00, 0.25, 90]", "[0.00, 0.25, 90", ":7: found "),
    "tab for a space": ("footprint_radius_m", "\tfootprint_radius_m", ":2: found "),
    "a list on top": (GOOD, "- 1\n- 2\n", ": found [1, 2], expected a mapping"),
    "a text on top": (GOOD, "a robot", ": found 'a robot', expected a mapping"),
    "nothing": (GOOD, "", ": found nothing, expected a mapping"),
}


def put(folder: Path, content: str | bytes) -> Path:
    path = folder / "robot.yaml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


@pytest.mark.parametrize(
    ("name", "sonars"), [("b21", 24), ("robuter2", 24), ("p3dx", 16), ("nomad200", 16), ("scitos-g5", 24)]
)
def test_a_preset_has_its_sonars_on_its_body(name, sonars):
    robot = Robot.load(name)
    assert robot.name == name
    assert robot.sonars == sonars == len(robot.mounts)
    assert np.all(np.hypot(*robot.mounts[:, :2].T) <= robot.footprint_radius_m)
    assert 0 < robot.min_range_m < robot.max_range_m


def test_the_presets_are_the_five_of_the_contract():
    assert preset_names() == ["b21", "nomad200", "p3dx", "robuter2", "scitos-g5"]


def test_the_b21_looks_out_of_an_even_ring_with_no_sonar_straight_ahead():
    axis = np.deg2rad(172.5 - 15 * np.arange(24))
    ring = np.column_stack([0.25 * np.cos(axis), 0.25 * np.sin(axis), axis])
    np.testing.assert_allclose(Robot.load("b21").mounts, ring, atol=1e-4)


def test_the_pioneer_has_the_mounts_of_its_driver():
    mounts = np.array(P3DX) * [1e-3, 1e-3, np.pi / 180]
    np.testing.assert_allclose(Robot.load("p3dx").mounts, mounts, atol=1e-9)


@pytest.mark.parametrize(("low", "deaf"), [(0.26, 0.2475), (0.01, 0.0)])
def test_nearer_than_its_shortest_range_a_robot_is_deaf(low, deaf):
    assert replace(Robot.load("b21"), min_range_m=low).deaf_m == pytest.approx(deaf, abs=1e-4)


@pytest.mark.parametrize(("name", "pitch", "radius"), [("nomad200", 22.5, 0.225), ("scitos-g5", 15, None)])
def test_a_round_robot_has_an_even_ring(name, pitch, radius):
    mounts = Robot.load(name).mounts
    steps = np.rad2deg(np.diff(np.sort(mounts[:, 2])))
    np.testing.assert_allclose(steps, pitch, atol=1e-6)
    np.testing.assert_allclose(np.arctan2(mounts[:, 1], mounts[:, 0]) - mounts[:, 2], 0, atol=1e-3)
    reach = np.hypot(mounts[:, 0], mounts[:, 1])
    np.testing.assert_allclose(reach, radius or reach[0], atol=1e-3)


def test_the_scitos_numbers_its_sonars_as_its_recordings_do():
    # Driving forward, what S1 sees recedes and what S13 sees comes nearer; turning right, S_k hands on to S_k+1.
    mounts = Robot.load("scitos-g5").mounts
    np.testing.assert_allclose(mounts[12], [0.3, 0, 0], atol=1e-4)
    np.testing.assert_allclose(np.rad2deg(mounts[13, 2] - mounts[12, 2]), 15)


@pytest.mark.parametrize("name", ["b21", "robuter2", "p3dx", "nomad200", "scitos-g5"])
def test_a_preset_is_the_same_seen_in_a_mirror(name):
    mounts = Robot.load(name).mounts
    near = np.hypot(
        np.hypot(mounts[:, None, 0] - mounts[:, 0], mounts[:, None, 1] + mounts[:, 1]),
        np.sin((mounts[:, None, 2] + mounts[:, 2]) / 2),
    )
    assert np.all(near.min(axis=1) < 1e-6)


def test_a_robot_file_says_what_the_robot_is(tmp_path):
    robot = Robot.load(put(tmp_path, GOOD))
    assert (robot.name, robot.footprint_radius_m, robot.sonars) == ("my-robot", 0.25, 2)
    assert (robot.min_range_m, robot.max_range_m) == (0.15, 5.0)
    assert robot.transducer == TRANSDUCERS["polaroid-600"]
    assert robot.beam_width_rad == pytest.approx(np.deg2rad(25))
    np.testing.assert_allclose(robot.mounts, [[0.25, 0, 0], [0, 0.25, np.pi / 2]])


def test_a_transducer_may_be_given_by_its_numbers():
    text = GOOD.replace("transducer: polaroid-600", "frequency_hz: 40000, aperture_radius_m: 0.008")
    assert parse_robot(text, "r").transducer == Transducer("custom", 40000, 0.008, cycles=16)
    text = text.replace("0.008", "0.008, cycles: 8")
    assert parse_robot(text, "r").transducer == Transducer("custom", 40000, 0.008, cycles=8)


robots = st.builds(
    Robot,
    name=st.text(st.characters(codec="utf-8"), min_size=1, max_size=20).filter(str.isprintable),
    footprint_radius_m=st.floats(0, 10),
    transducer=st.one_of(
        st.sampled_from(list(TRANSDUCERS.values())),
        st.builds(
            Transducer, st.just("custom"), st.floats(1e3, 1e6), st.floats(1e-3, 0.5), cycles=st.integers(1, 1000)
        ),
    ),
    min_range_m=st.floats(0, 0.5),
    max_range_m=st.floats(0.6, 100),
    beam_width_rad=st.floats(1.01, 179.9).map(lambda deg: float(np.deg2rad(deg))),
    mounts=st.lists(
        st.tuples(st.floats(-10, 10), st.floats(-10, 10), st.floats(-np.pi, np.pi)), min_size=1, max_size=30
    ).map(np.array),
)


@settings(max_examples=60)
@given(robots)
def test_write_then_read_is_the_identity(robot):
    read = parse_robot(robot_yaml(robot), "robot.yaml")
    assert (read.name, read.transducer) == (robot.name, robot.transducer)
    for key in ("footprint_radius_m", "min_range_m", "max_range_m"):
        assert getattr(read, key) == getattr(robot, key)
    assert read.beam_width_rad == pytest.approx(robot.beam_width_rad, abs=1e-6)
    np.testing.assert_allclose(read.mounts, robot.mounts, atol=1e-6)


@pytest.mark.parametrize("name", ["b21", "robuter2", "p3dx", "nomad200", "scitos-g5"])
def test_a_preset_that_is_written_is_read(name):
    robot = Robot.load(name)
    read = parse_robot(robot_yaml(robot), "robot.yaml")
    np.testing.assert_allclose(read.mounts, robot.mounts, atol=1e-6)
    assert robot_yaml(read) == robot_yaml(robot)


@pytest.mark.parametrize("kind", WRONG)
def test_a_wrong_robot_file_is_one_line_that_names_the_key(tmp_path, kind):
    old, new, begins = WRONG[kind]
    assert old in GOOD
    path = put(tmp_path, GOOD.replace(old, new, 1))
    with pytest.raises(InputError) as raised:
        Robot.load(path)
    message = str(raised.value)
    assert message.startswith(f"{path}{begins}")
    assert ", expected " in message
    assert "\n" not in message


def test_bytes_that_are_no_text_and_a_folder_are_one_line(tmp_path):
    path = put(tmp_path, b"\x93NUMPY\xff\xfe\x00")
    with pytest.raises(InputError, match=f"^{re.escape(str(path))}: found bytes that are not UTF-8 text, expected"):
        Robot.load(path)
    with pytest.raises(InputError, match=f"^{re.escape(str(tmp_path))}: found a folder, expected"):
        Robot.load(tmp_path)


def test_a_name_that_is_neither_preset_nor_file_is_answered_with_the_presets():
    with pytest.raises(UsageError, match=r"^robot: found r2d2, expected a file or one of b21, .*scitos-g5$"):
        Robot.load("r2d2")


yaml_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.dates(),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8) | st.integers(), inner, max_size=4)
    ),
    max_leaves=12,
)
keys = st.sampled_from(["name", "footprint_radius_m", "sonar", "mounts", "description"])
sonar_keys = st.sampled_from(
    ["transducer", "frequency_hz", "aperture_radius_m", "cycles", "min_range_m", "max_range_m", "beam_width_deg"]
)


@settings(max_examples=150)
@given(keys, sonar_keys, yaml_values)
def test_any_value_of_any_key_is_taken_or_refused_in_one_line(key, sonar_key, value):
    for change in ({key: value}, {"sonar": {sonar_key: value}}):
        data = yaml.safe_load(GOOD)
        if isinstance(change.get("sonar"), dict):
            change["sonar"] = data["sonar"] | change["sonar"]
        text = yaml.safe_dump(data | change, allow_unicode=True)
        message = "robot.yaml"
        try:
            robot = parse_robot(text, "robot.yaml")
        except EchogridError as error:
            message = str(error)
        else:
            assert np.all(np.isfinite(robot.mounts))
        assert message.startswith("robot.yaml")
        assert "\n" not in message


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@example(b"")
@example(b"\x00")
@example(b"[" * 3000)
@example(b"a: &a [*a]")
@example(b"name: &n {<<: *n}")
@example(b"2001-13-45: 1")
@example(b"!!python/object/apply:os.system [true]")
@given(st.binary(max_size=200) | st.text(max_size=100).map(str.encode))
def test_any_bytes_raise_nothing_but_our_errors(tmp_path, content):
    with pytest.raises(EchogridError) as raised:
        Robot.load(put(tmp_path, content))
    assert "\n" not in str(raised.value)


@given(
    st.lists(st.floats(0, 12) | st.just(np.inf) | st.just(np.nan), min_size=1, max_size=8).map(np.array),
)
def test_ranges_are_cleaned_by_the_no_echo_rule(ranges):
    robot = parse_robot(GOOD, "r")
    clean = robot.clean(ranges)
    for before, after in zip(ranges, clean, strict=True):
        if np.isnan(before) or before < 0.15 * (1 - 1e-6):
            assert np.isnan(after)
        elif before >= 5.0 * (1 - 1e-6):
            assert after == np.inf
        else:
            assert after == before
    np.testing.assert_array_equal(robot.clean(clean), clean)
    np.testing.assert_array_equal([robot.clean_one(value) for value in ranges.tolist()], clean)


THREE = """name: three
footprint_radius_m: 0.2
sonar: {transducer: polaroid-600, min_range_m: 0.15, max_range_m: LONGEST, beam_width_deg: 25}
mounts: [[0.1, 0, 0], [0, 0.1, 90], [0, -0.1, -90]]
"""


def test_each_sonar_may_have_a_maximum_range_of_its_own():
    robot = parse_robot(THREE.replace("LONGEST", "[4, 0.9, 0.5]"), "r")
    assert robot.max_range_m == 4.0
    np.testing.assert_array_equal(robot.max_ranges_m, [4.0, 0.9, 0.5])
    assert "0.5..4 m" in repr(robot)
    ranges = np.array([[0.7, 0.7, 0.7], [4.0, 0.9, 0.1]])
    expected = np.array([[0.7, 0.7, np.inf], [np.inf, np.inf, np.nan]])
    np.testing.assert_array_equal(robot.clean(ranges), expected)
    np.testing.assert_array_equal([robot.clean_one(v, k) for k, v in enumerate(ranges[0].tolist())], expected[0])
    read = parse_robot(robot_yaml(robot), "again")
    np.testing.assert_array_equal(read.max_ranges_m, robot.max_ranges_m)


def test_a_list_of_one_maximum_range_is_that_range():
    robot = parse_robot(THREE.replace("LONGEST", "[4, 4, 4]"), "r")
    assert robot.own_max_ranges_m is None
    assert robot_yaml(robot) == robot_yaml(parse_robot(THREE.replace("LONGEST", "4"), "r"))


@pytest.mark.parametrize(
    ("given_", "said"),
    [
        ("[4, 0.9]", "found 2 numbers, expected a number, or one for each of 3 mounts"),
        ("[4, 0.9, far]", "found 'far', expected a number"),
        ("[4, 0.9, 0.1]", "found 0.1, expected more than min_range_m (0.15)"),
    ],
)
def test_a_wrong_list_of_maximum_ranges_is_one_line(given_, said):
    with pytest.raises(InputError) as raised:
        parse_robot(THREE.replace("LONGEST", given_), "r")
    assert str(raised.value) == f"r: sonar.max_range_m: {said}"


@given(st.floats(0.01, 90), st.floats(0.01, 90))
def test_a_limit_that_was_rounded_to_single_precision_is_the_limit(low, span):
    robot = replace(parse_robot(GOOD, "r"), min_range_m=low, max_range_m=low + span)
    single = np.array([low, low + span], np.float32).astype(float)
    np.testing.assert_array_equal(robot.clean(single), [single[0], np.inf])


def test_the_limits_themselves_are_a_reading_and_no_echo():
    robot = parse_robot(GOOD, "r")
    np.testing.assert_array_equal(robot.clean(np.array([0.15, 5.0])), [0.15, np.inf])


@given(st.integers(3, 24), st.floats(0.02, 1.0), st.floats(-3, 3))
def test_a_ring_surrounds_the_disc_between_its_sonars(sonars, radius, turn):
    axis = np.arange(sonars) * 2 * np.pi / sonars + turn
    ring = np.column_stack([radius * np.cos(axis), radius * np.sin(axis), axis])
    least = radius * np.cos(np.pi / sonars)
    assert max(least, min(0.1, radius)) - 1e-9 <= surrounded(ring) <= max(least, min(0.1, radius)) + 0.005


def test_a_long_robot_covers_no_more_than_its_width():
    corners = np.array([[0.4, 0.15, 0], [0.4, -0.15, 0], [-0.4, 0.15, 0], [-0.4, -0.15, 0]])
    assert surrounded(corners) == pytest.approx(0.15)


def test_sonars_on_one_side_surround_little():
    bar = np.array([[0.3, 0.1, 0], [0.3, 0.0, 0], [0.3, -0.1, 0]])
    assert surrounded(bar) == pytest.approx(0.1)
    assert surrounded(bar * 0.1) == pytest.approx(0.03)
