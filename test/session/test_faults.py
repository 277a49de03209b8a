"""The scenarios in config/faults: flown, measured by the truth in their bags, flown again."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import uuid
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.awaited import await_end, await_size, processes_with
from support.sentences import assert_one_sentence

from spacerobot_ros.bag import Bag, RecordingError, read_bag
from spacerobot_ros.bag.reader import columns
from spacerobot_ros.bag.salvage import salvage_bag
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.flight.verification import verify_bag
from spacerobot_ros.resources import share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.scenario_files import parse_kills
from spacerobot_ros.session.child import end_message
from spacerobot_ros.session.processes import KillTimeline
from spacerobot_ros.session.run import run_scenario

pytestmark = pytest.mark.usefixtures("own_domain")

# Whether the goal is met, and to how many m and rad of the truth; None: not the method's to meet.
EXPECTED: dict[str, tuple[bool, float | None, float | None]] = {
    "noisy_sensors": (True, 3e-3, 2.6e-3),
    "wrong_masses": (True, 1e-3, 1e-3),
    "stuck_elbow": (True, None, 1e-3),
    "stuck_slider": (False, None, None),
    "broken_thrusters": (True, 4e-3, 4e-3),
    "closed_nozzle": (True, 5e-3, 1e-2),
    "weak_motors": (True, 2e-3, 2e-3),
    "wheel_failure": (True, 4e-3, 4e-3),
    "late_poses": (True, 2e-3, 2e-3),
    "biased_pose": (False, 0.11, 2e-3),
    "missed_capture": (False, 1e-6, 1e-6),
}
KILLED = "killed_nodes"


def test_every_scenario_is_here() -> None:
    files = {path.stem for path in (share_directory() / "config" / "faults").glob("*.yaml")}
    assert files == {*EXPECTED, KILLED}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPECTED)
def test_a_scenario_ends_as_documented_and_can_be_flown_again(name: str, tmp_path: Path) -> None:
    met, distance, angle = EXPECTED[name]
    scenario = load_scenario(f"faults/{name}")
    result = run_scenario(scenario, tmp_path / "run.mcap")
    assert result.succeeded is met, result.message
    bag = read_bag(tmp_path / "run.mcap")
    odom = bag["/odom_true" if "/odom_true" in bag.topics else "/odom"]
    pose = odom.table(columns("odom", "pose.pose"))[-1]
    left = np.linalg.norm(pose[:3] - scenario.goal.position)
    turn = Rotation.from_quat(pose[3:]).inv() * Rotation.from_quat(scenario.goal.quaternion)
    if distance is not None:
        assert left <= distance
    if angle is not None:
        assert turn.magnitude() <= angle
    if name == "biased_pose":
        assert left >= 0.09, "it is believed"
    if name == "stuck_slider":
        assert result.message.startswith("The goal is not reached: joint 'slider_1' is stuck at ")
        assert " Remaining: " in result.message
    assert result.summary["succeeded_by_measurement"] is (name != "stuck_slider")
    # The summary is of the truth.
    assert result.summary["position_error_m"] == pytest.approx(left, abs=1e-12)
    verification = verify_bag(tmp_path / "run.mcap")
    assert verification.difference is None, str(verification.difference)


def test_the_summary_names_what_detects_a_fault(tmp_path: Path) -> None:
    scenario = load_scenario("faults/stuck_elbow")
    found = run_scenario(scenario, tmp_path / "run.mcap").summary["detection"]
    assert found["node"] == "planner"
    assert found["message"].startswith("Stuck: elbow_pitch.")
    # It sticks at 5 s, and 50 ticks of 0.05 s later it is known to.
    assert found["time_s"] == pytest.approx(7.5, abs=0.1)


@pytest.mark.slow
def test_killed_nodes_go_on_to_the_goal(tmp_path: Path) -> None:
    scenario = load_scenario(f"faults/{KILLED}").in_real_time(4.0)
    result = run_scenario(scenario, tmp_path / "run.mcap", nodes=True)
    assert result.succeeded, result.message
    bag = read_bag(tmp_path / "run.mcap")
    end = bag["/odom"].table(columns("odom", "pose.pose"))[-1]
    assert np.linalg.norm(end[:3] - scenario.goal.position) <= 1e-3
    # While the planner was away the joints rested.
    states, commands = bag["/joint_states"], bag["/joint_commands"]
    silent = (states.stamp > 12.0) & (states.stamp <= 14.0)
    assert silent.sum() > 20
    assert not np.asarray(states.field("velocity"))[silent].any()
    assert not ((commands.stamp > 12.0) & (commands.stamp <= 14.0)).any()
    # The recorder needs a moment to find the plant again; the flight goes on to its end.
    assert states.stamp[-1] > 80.0


@pytest.mark.slow
def test_nodes_that_are_killed_between_capture_and_goal_go_on_with_the_held_body(
    tmp_path: Path,
) -> None:
    """First the controller, then the plant: the momenta are those of the thrust all the time."""
    kills = parse_kills(["coordinated_control at 2 until 3", "plant at 6 until 8"], "the test")
    scenario = (
        replace(load_scenario("capture").in_real_time(1.0), kills=kills)
        .with_overrides("plant", {"tick_rate": 50.0})
        .with_overrides("coordinated_control", {"tick_rate": 50.0, "settle_time": 8.0})
        .with_overrides("recorder", {"flush_period": 0.1})
    )
    result = run_scenario(scenario, tmp_path / "run.mcap", nodes=True)
    assert result.succeeded, result.message
    bag = read_bag(tmp_path / "run.mcap")
    momenta, expected = (
        np.array([each[:6] for each in bag[topic].field("data")])
        for topic in ("/momentum", "/momentum_expected")
    )
    # The robot is alone in the first state: the target's momentum is not its own.
    assert np.abs(momenta[1:2]).max() > 0.1
    count = min(len(momenta), len(expected))
    np.testing.assert_allclose(momenta[-count:], expected[-count:], rtol=0, atol=1e-12)


@pytest.mark.parametrize("nodes", [False, True])
def test_kills_need_nodes_in_real_time(tmp_path: Path, nodes: bool) -> None:
    scenario = load_scenario(f"faults/{KILLED}")
    with pytest.raises(ParameterError) as caught:
        run_scenario(scenario, tmp_path / "run.mcap", nodes=nodes)
    assert_one_sentence(str(caught.value), "kills nodes during the flight", "--nodes", "--realtime")
    assert not (tmp_path / "run.mcap").exists()


def test_kills_come_in_their_order() -> None:
    lines = ["plant at 5 until 6", "planner  at 1 until 4.5", "planner at 7"]
    kills = parse_kills(lines, "x.yaml")
    timeline = KillTimeline(kills)
    assert timeline.due(0.5) == ([], [])
    assert timeline.due(1.0) == (["planner"], [])
    # A time that was estimated too late is corrected: nothing happens twice.
    assert timeline.due(0.9) == timeline.due(1.1) == ([], [])
    assert timeline.away == {"planner"}
    assert timeline.due(4.5) == ([], ["planner"])
    assert timeline.away == set()
    assert timeline.due(5.5) == (["plant"], [])
    assert timeline.due(100.0) == (["planner"], ["plant"])
    assert timeline.due(200.0) == ([], [])
    assert timeline.away == {"planner"}


def test_a_node_that_is_killed_has_no_cause_in_its_log_but_one_that_crashes_has() -> None:
    log = "[ERROR] [1.5] [plant]: Node '/coordinated_control' is silent\n"
    assert end_message("plant", -9, log) == "Node 'plant' was ended by SIGKILL."
    thread = 'Current thread 0x1 (most recent call first):\n  File "stops.py", line 7 in hold\n'
    crash = f"{log}Fatal Python error: Segmentation fault\n\n{thread}"
    assert end_message("plant", -11, crash) == (
        "Node 'plant' was ended by SIGSEGV: Fatal Python error: Segmentation fault at "
        '"stops.py", line 7 in hold.'
    )
    assert end_message("plant", 1, log).endswith("code 1: Node '/coordinated_control' is silent")


KILLS = 4
ROOT = Path(__file__).parents[2]
START_PATIENCE = 60.0
SOON = 20.0
"""Wall s after which no process is left; on an idle machine 1.2 s."""

MARK = "SPACEROBOT_TEST_MARK"
FLIGHT = (
    *("run", "sliding_masses", "--processes", "--realtime", "--method", "lie_bracket"),
    *("--set", "planner.lie_bracket.t1=60", "--set", "recorder.flush_period=0.1"),
)
LATEST = 12.0
"""Wall s from the start of the supervisor, which flies by then."""


def whole(path: Path) -> Bag:
    """Read a bag; one whose recorder was killed is salvaged first."""
    try:
        return read_bag(path)
    except RecordingError:
        return read_bag(salvage_bag(path).path)


class Supervisor:
    """``spacerobot run --processes``, and what it has started."""

    def __init__(self, folder: Path, domain: int, *words: str) -> None:
        self.bag = folder / "flight.mcap"
        self._mark = uuid.uuid4().hex
        environment = {**os.environ, "ROS_DOMAIN_ID": str(domain), MARK: self._mark}
        environment["PYTHONPATH"] = str(ROOT)
        with (folder / "output.txt").open("wb") as output:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "spacerobot_ros", *FLIGHT, "--bag", str(self.bag), *words],
                env=environment,
                cwd=folder,
                stdout=output,
                stderr=output,
                start_new_session=True,
            )

    def left(self) -> list[int]:
        """Return the processes that carry our mark and have not ended."""
        return list(processes_with(f"{MARK}={self._mark}"))

    def await_flight(self) -> None:
        """Wait until states of a robot that moves are in the bag."""
        await_size(self.bag, 30_000, self.process, START_PATIENCE)

    def kill(self) -> None:
        """End the supervisor as by a crash, and require that everything ends with it."""
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        left = await_end(self.left, SOON)
        for each in left:
            with suppress(ProcessLookupError):
                os.kill(each, signal.SIGKILL)
        assert not left

    def speeds(self) -> np.ndarray:
        """Return the largest joint rate of every recorded state; empty where none was recorded."""
        if not self.bag.exists() or not self.bag.stat().st_size:
            return np.zeros(0)
        bag, refusal = None, ""
        try:
            bag = whole(self.bag)
        except RecordingError as error:
            refusal = str(error)
        if bag is None:
            # Killed before anything was recorded.
            assert "no message" in refusal or "nothing" in refusal, refusal
            return np.zeros(0)
        if "/joint_states" not in bag.topics or not bag.message_count("/joint_states"):
            return np.zeros(0)
        return np.abs(np.asarray(bag["/joint_states"].field("velocity"))).max(axis=1)


@pytest.mark.slow
def test_nodes_end_with_their_supervisor_and_the_robot_at_rest(
    ros_domain: int, tmp_path: Path
) -> None:
    supervisor = Supervisor(tmp_path, ros_domain)
    supervisor.await_flight()
    supervisor.kill()
    speeds = supervisor.speeds()
    assert speeds[:-1].max() > 1e-5, "it moved"
    assert speeds[-1] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("run", range(KILLS))
def test_a_supervisor_killed_at_a_random_moment_leaves_nothing(
    ros_domain: int, tmp_path: Path, run: int
) -> None:
    """From its first import on: nodes that start, models that are compiled, plans, flights."""
    delay = random.Random(run).uniform(0.0, LATEST)
    supervisor = Supervisor(tmp_path, ros_domain)
    with suppress(subprocess.TimeoutExpired):
        supervisor.process.wait(delay)
    assert supervisor.process.returncode is None
    supervisor.kill()
    assert supervisor.speeds()[-1:].sum() == 0.0
