"""Stamps that are accepted: lost messages, restarts, times that are not the plant's."""

from __future__ import annotations

import pytest

from spacerobot_ros.commanding.plant_state import Stamped, StampFilter
from spacerobot_ros.times import SECOND

PERIOD = 0.05


def message(topic: str, seconds: float) -> Stamped:
    return Stamped(round(seconds * SECOND), (topic, seconds))


class Listener:
    """States as they come in real time, and which of them are believed."""

    def __init__(self, pace: float = 1.0) -> None:
        self.wall, self.pace, self.time = 100.0, pace, 40.0
        self.times = StampFilter(clock=lambda: self.wall)
        self.believed: list[float] = []
        """The times of the states that were admitted, s."""

    def states(self, count: int) -> None:
        """Let the plant publish states, one a control period."""
        for _ in range(count):
            self.wait(PERIOD / self.pace)
            self.time += PERIOD
            assert self.odom(self.time)
            assert self.joints(self.time)

    def odom(self, seconds: float) -> bool:
        return self.times.accepts_odom(*message("odom", seconds))

    def joints(self, seconds: float) -> bool:
        admitted = self.times.accepts_joints(*message("joint_states", seconds))
        if admitted:
            self.believed.append(seconds)
        return admitted

    def wait(self, wall: float) -> None:
        """Let wall time pass, and look as often as a node does."""
        for _ in range(int(wall / 0.1)):
            self.wall += 0.1
            self.look()
        self.wall += wall % 0.1

    def look(self) -> tuple[Stamped | None, Stamped] | None:
        return self.times.accepted_jump()


@pytest.mark.parametrize("pace", [1.0, 10.0, 500.0])
@pytest.mark.parametrize("ahead", [1e6, 2e9 - 100, 3.0, 0.493, -0.05, -3.0, -39.0])
def test_one_state_of_another_time_is_ignored_and_counted(ahead: float, pace: float) -> None:
    if pace > 100 and 0 < ahead < 2 * PERIOD + 2 * pace * PERIOD / pace:
        pytest.skip("as near as lost messages")
    listener = Listener(pace)
    listener.states(20)
    assert not listener.odom(listener.time + ahead) or abs(ahead) <= 1.5 * PERIOD
    assert not listener.joints(listener.time + ahead)
    assert listener.look() is None
    listener.states(20)
    assert len(listener.believed) == 40
    assert listener.times.ignored >= 1
    where = "ahead of" if ahead > 0 else "behind"
    assert where in listener.times.last_ignored
    assert "stamp" in listener.times.last_ignored


def test_a_second_publisher_of_another_time_never_takes_over() -> None:
    listener = Listener()
    listener.states(5)
    for tick in range(100):
        listener.states(1)
        for part in range(3):
            assert not listener.joints(listener.time + 3.0 + part * 0.01)
            assert not listener.joints(1e6 + tick)
    assert len(listener.believed) == 105


def test_lost_states_are_explained_by_the_wall_time_without_them() -> None:
    listener = Listener()
    listener.states(20)
    # This node is stopped for 6 s: the first states of its queue are lost, and the rest come in a
    # burst.
    listener.wall += 6.0
    listener.time += 1.0
    for _ in range(100):
        listener.time += PERIOD
        assert listener.odom(listener.time)
        assert listener.joints(listener.time)
    listener.states(5)
    assert listener.times.ignored == 0


def test_a_stamp_that_is_shown_again_is_of_the_present_time() -> None:
    listener = Listener()
    listener.states(3)
    assert listener.joints(listener.time)
    listener.wall += 100.0
    assert listener.odom(listener.time)
    assert listener.joints(listener.time)


@pytest.mark.parametrize("at", [0.0, 39.8, 1e6])
def test_a_restarted_plant_is_believed_when_nothing_contradicts_it(at: float) -> None:
    """In lockstep it publishes one state, and waits for the answer."""
    listener = Listener()
    listener.states(20)
    listener.wall += 2.0
    assert not listener.odom(at)
    assert not listener.joints(at)
    looks = 0
    while (believed := listener.look()) is None:
        looks += 1
        listener.wall += 0.1
        assert looks < 8
    assert looks >= 4
    assert believed == (message("odom", at), message("joint_states", at))
    assert listener.joints(at + PERIOD)
    assert not listener.joints(listener.time + PERIOD)
    assert listener.times.ignored == 0


@pytest.mark.parametrize("rate", [0.5, 5.0, 200.0])
@pytest.mark.parametrize("pace", [1.0, 500.0])
def test_the_rate_of_any_plant_is_known_after_three_states(rate: float, pace: float) -> None:
    listener = Listener(pace)
    for number in range(50):
        assert (listener.times.rate > 0) == (number > 2)
        listener.time += 1 / rate
        listener.wait(1 / rate / pace)
        assert listener.odom(listener.time)
        assert listener.joints(listener.time)
    assert listener.times.rate == pytest.approx(rate, rel=1e-6)


def test_a_plant_that_is_restarted_with_another_rate_is_followed() -> None:
    listener = Listener()
    listener.states(20)
    believed, time = 0, 0.0
    for _ in range(40):
        time += 10 * PERIOD
        listener.wait(10 * PERIOD)
        believed += listener.joints(time)
    assert believed >= 37
    assert listener.times.rate == pytest.approx(0.1 / PERIOD)


def test_the_rate_of_a_driver_with_jitter_and_losses_is_that_of_most_states() -> None:
    listener = Listener()
    jitter = [0.0, 0.003, -0.002, 0.001, -0.003, 0.002, 0.0, 0.004, -0.001, 0.002]
    for number, off in enumerate(jitter):
        listener.wait(PERIOD)
        listener.time += PERIOD
        if number != 4:
            assert listener.joints(listener.time + off)
    assert listener.times.rate == 20.0


def test_the_first_state_is_believed_whatever_its_stamp() -> None:
    listener = Listener()
    assert listener.odom(1e6)
    assert listener.joints(1e6)
    # If it was not the plant's, the plant's are believed when it does not come again.
    assert not listener.joints(10.0)
    listener.wall += 0.5
    assert listener.look() is not None


class Exact:
    """A filter after 16 states at a pace; all times are binary fractions of a second."""

    PERIOD = 0.0625

    def __init__(self, pace: float = 1.0) -> None:
        self.wall = 64.0
        self.times = StampFilter(clock=lambda: self.wall)
        for tick in range(1, 17):
            self.wall += self.PERIOD / pace
            assert self.times.accepts_joints(round(tick * self.PERIOD * SECOND), "joints")

    @property
    def now(self) -> int:
        return self.times.now_ns


@pytest.mark.parametrize(("pace", "wall"), [(1.0, 0.0), (1.0, 0.5), (4.0, 0.5), (0.5, 0.5)])
def test_stamps_are_plausible_up_to_the_bounds_of_a_step_and_of_losses(
    pace: float, wall: float
) -> None:
    """One step and a half, and twice the time that passes at this pace; odom may be behind, too."""
    exact = Exact(pace)
    exact.wall += wall
    step = 1.5 * Exact.PERIOD
    longest = round((step + 2.0 * pace * wall) * SECOND)
    odom_from = -round(step * SECOND)
    for ahead, plausible, of_odom in (
        (0, True, True),
        (longest, True, True),
        (longest + 1, False, False),
        (-1, False, True),
        (odom_from, False, True),
        (odom_from - 1, False, False),
    ):
        assert exact.times.is_present(exact.now + ahead) is plausible
        assert exact.times.accepts_odom(exact.now + ahead, "odom") is of_odom


@pytest.mark.parametrize("pace", [0.5, 1.0, 100.0])
def test_a_jump_is_believed_after_half_a_second(pace: float) -> None:
    exact = Exact(pace)
    stamp = exact.now + 8 * SECOND
    assert exact.times.accepted_jump() is None
    assert not exact.times.accepts_odom(stamp, "odom")
    assert not exact.times.accepts_joints(stamp, "joints")
    begin = exact.wall
    for wall in (0.125, 0.25, 0.4375):
        exact.wall = begin + wall
        assert exact.times.accepted_jump() is None
    exact.wall = begin + 0.5
    assert exact.times.accepted_jump() == (Stamped(stamp, "odom"), Stamped(stamp, "joints"))
    assert (exact.now, exact.times.ignored) == (stamp, 0)
    assert exact.times.accepted_jump() is None


def test_ignored_messages_are_named_with_their_distance_in_time() -> None:
    exact = Exact()
    exact.wall += 1.0  # The nodes have met.
    for part, ahead, words in (
        ("joint_states", 8.125, "8.125 s ahead of"),
        ("joint_states", -0.5, "0.5 s behind"),
        ("odom", 1234.5678, "1235 s ahead of"),
    ):
        stamp = exact.now + round(ahead * SECOND)
        put = exact.times.accepts_joints if part == "joint_states" else exact.times.accepts_odom
        assert not put(stamp, "message")
        before = exact.times.ignored
        assert exact.times.accepts_joints(exact.now, "joints")
        assert exact.times.ignored == before + 1
        assert exact.times.last_ignored == (
            f"A message on '{part}' is ignored: its stamp is {words} the time of the states."
        )


@pytest.mark.parametrize(("wall", "counted"), [(0.9375, 0), (1.0, 1)])
@pytest.mark.parametrize("ahead", [-0.375, 0.25])
def test_poses_of_other_times_do_not_count_while_nodes_meet(
    ahead: float, wall: float, counted: int
) -> None:
    clock = [50.0]
    times = StampFilter(clock=lambda: clock[0])
    stamp = 8 * SECOND
    assert times.accepts_joints(stamp, "joints")
    stamp += SECOND // 16
    clock[0] += 1 / 16
    assert times.accepts_joints(stamp, "joints")
    clock[0] = 50.0 + wall
    # As far ahead of the states as the pace of the plant does not explain.
    pose = stamp + round((ahead if ahead < 0 else 2 * wall + ahead) * SECOND)
    assert not times.accepts_odom(pose, "odom")
    assert times.accepts_joints(stamp, "joints")
    assert times.ignored == counted
