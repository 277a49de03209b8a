"""The table of topics, against the message classes and the nodes that publish them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

import pytest

from spacerobot_ros.bag import message_definition
from spacerobot_ros.topics import TOPICS, Topic, state_topics


def message_of(topic: Topic) -> Any:
    package, _, name = topic.type.split("/")
    return getattr(import_module(f"{package}.msg"), name)()


@pytest.mark.parametrize("topic", TOPICS.values(), ids=TOPICS)
def test_every_topic_has_a_type_that_is_installed_and_says_what_it_is(topic: Topic) -> None:
    if topic.name in ("/tf", "/tf_static"):
        # Its package is not everywhere; its definition is in the bags.
        assert "TransformStamped[] transforms" in message_definition(topic.type)
    else:
        message_of(topic)
    assert topic.publishers
    assert topic.meaning
    assert "\n" not in topic.meaning + topic.condition


@pytest.mark.parametrize("topic", state_topics(), ids=lambda topic: topic.name)
def test_state_topics_name_numbers_of_their_messages(topic: Topic) -> None:
    message = message_of(topic)
    names = ["elbow", "wrist"]
    for field in topic.state:
        for column in field.columns:
            value = message
            for part in column.split("."):
                value = getattr(value, part)
            if field.members:
                assert isinstance(value, float), column
            else:
                assert len(value) == 0
                assert value.typecode == "d"
        width = len(field.members or field.array_entry_names) or len(names)
        assert len(field.labels(names)) == width


def test_labels_and_quaternions() -> None:
    odom, joints = TOPICS["odom"].state, TOPICS["joint_states"].state
    assert [field.quaternion for field in odom] == [3, None]
    assert joints[0].labels(["elbow"]) == ["position of elbow"]
    assert TOPICS["momentum"].state[0].labels([])[-1] == "kinetic energy"
    assert TOPICS["odom"].short_type == "nav_msgs/Odometry"


def test_the_plant_publishes_the_clock_first_and_what_sets_commanders_off_late() -> None:
    names = list(TOPICS)
    assert names[0] == "/clock"
    measured = [names.index("odom"), names.index("joint_states")]
    before = ["base_pose", "end_effector_pose", "momentum", "momentum_expected", "odom_true"]
    assert max(map(names.index, before)) < min(measured)
