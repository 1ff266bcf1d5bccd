import pytest
from hypothesis import given
from hypothesis import strategies as st

from echogrid.live.tf_topics import MAX_TOPICS, TfTopics

SPACES = ("", "/robot1", "/robot2", "/robot1/arm")


def topics(*names, volatile=()):
    found = TfTopics()
    for name in names:
        found.add(name, name in volatile)
    return found


@pytest.mark.parametrize(
    ("there", "ranges", "wanted"),
    [
        (["/tf", "/tf_static"], ["/front", "/arm/left"], ["/tf", "/tf_static"]),
        (["/robot1/tf", "/robot1/tf_static"], ["/robot1/s0"], ["/robot1/tf", "/robot1/tf_static"]),
        (["/robot1/tf"], ["/s0"], ["/robot1/tf"]),
        (["/robot1/tf", "/robot2/tf"], ["/robot2/s0"], ["/robot2/tf"]),
        (["/robot1/tf", "/robot11/tf"], ["/robot11/s0"], ["/robot11/tf"]),
        (["/tf", "/robot1/tf", "/robot2/tf"], ["/robot1/s0"], ["/tf", "/robot1/tf"]),
        (["/robot1/tf", "/robot2/tf"], ["/robot1/s0", "/robot2/s0"], []),
        (["/robot1/tf"], [], []),
        (["/robot1/transforms"], ["/robot1/s0"], []),
    ],
)
def test_transforms_are_those_of_the_robot_whose_sonars_are_heard(there, ranges, wanted):
    assert topics(*there).wanted(ranges) == wanted


def test_of_several_robots_it_is_said_where_transforms_are_and_what_chooses_one():
    found = topics("/robot1/tf", "/robot2/tf")
    (said,) = found.lack(["/robot1/s0", "/robot2/s0"])
    assert "/robot1/tf, /robot2/tf" in said
    assert "--topics '/robot1/*'" in said
    assert found.lack([]) == []


def test_a_static_transform_that_is_not_kept_is_told_and_one_that_is_kept_is_not():
    (said,) = topics("/tf", "/tf_static", volatile=["/tf", "/tf_static"]).lack(["/s0"])
    assert said.startswith("/tf_static has durability volatile")
    assert topics("/tf", "/tf_static", volatile=["/tf"]).lack(["/s0"]) == []


@given(
    st.lists(st.sampled_from([f"{space}/{name}" for space in SPACES for name in ("tf", "tf_static")])),
    st.lists(st.sampled_from([f"{space}/s{i}" for space in SPACES for i in range(2)])),
)
def test_every_topic_is_taken_or_told_of(there, ranges):
    found = topics(*there)
    wanted = found.wanted(ranges)
    told = " ".join(found.lack(ranges))
    assert not ranges or all(topic in wanted or topic.rsplit("/", 1)[0] + "/" in told for topic in there)
    assert not (wanted and told) or any(topic not in wanted for topic in there)


def test_made_up_topics_are_bounded():
    found = topics(*(f"/r{i}/tf" for i in range(1000)))
    assert len(found.wanted([f"/r{i}/s" for i in range(1)])) == 1
    assert len(found._volatile) == MAX_TOPICS
