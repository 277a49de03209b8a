"""Quality of service as bags hold it: in words (Jazzy) and in numbers (before)."""

from __future__ import annotations

import pytest

from spacerobot_ros.bag import LATCHED, QosProfile, RecordingError
from spacerobot_ros.bag.mcap_file import INFINITE_NS

# As rosbag2 of Humble wrote it: rmw's numbers, an infinite duration as the largest numbers.
HUMBLE = """- history: 1
  depth: 5
  reliability: 2
  durability: 1
  deadline:
    sec: 9223372036
    nsec: 854775807
  lifespan:
    sec: 1
    nsec: 500000000
  liveliness: 3
  liveliness_lease_duration:
    sec: 9223372036
    nsec: 854775807
  avoid_ros_namespace_conventions: false"""


@pytest.mark.parametrize(
    "profile",
    [
        QosProfile(),
        LATCHED,
        QosProfile(
            "unknown", 0, "best_effort", deadline_ns=5, avoid_ros_namespace_conventions=True
        ),
    ],
)
def test_what_is_written_is_read_back(profile: QosProfile) -> None:
    other = QosProfile(depth=77)
    assert QosProfile.from_yaml(profile.to_yaml()) == [profile]
    assert QosProfile.from_yaml(f"{profile.to_yaml()}\n{other.to_yaml()}") == [profile, other]


def test_numbers_of_earlier_versions_are_read() -> None:
    assert QosProfile.from_yaml(HUMBLE) == [
        QosProfile(
            history="keep_last",
            depth=5,
            reliability="best_effort",
            durability="transient_local",
            lifespan_ns=1_500_000_000,
            liveliness="manual_by_topic",
        )
    ]
    assert QosProfile.from_yaml(HUMBLE)[0].deadline_ns == INFINITE_NS
    for word in ("9", "sometimes"):
        assert QosProfile.from_yaml(f"- history: {word}")[0].history == "unknown"
    assert QosProfile.from_yaml("") == []


@pytest.mark.parametrize("text", ["- [", "- 5", "- depth: -1", "- deadline: 3", "7"])
def test_what_is_no_profile_is_refused(text: str) -> None:
    with pytest.raises(RecordingError):
        QosProfile.from_yaml(text)
