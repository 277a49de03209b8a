"""Blocks of lanes without a compiler: their memory, their chunks of ticks, and their noise."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spacerobot_ros.batch import (
    BatchResult,
    ControlledGoals,
    Flights,
    FollowedSchedule,
    HeldCommands,
    InitialStates,
    SensorErrors,
    lanes,
)
from spacerobot_ros.batch.native import Job, Pending, RowLayout
from spacerobot_ros.batch.scalar import plant_of
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.outputs import OutputDistance
from spacerobot_ros.errors import SpaceRobotError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.description import Array
from spacerobot_ros.resources import robot_file


@pytest.fixture(autouse=True)
def interpreted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SPACEROBOT_COMPILE", "0")


@pytest.fixture(scope="module")
def sliders() -> SpaceRobot:
    return SpaceRobot(load_robot(robot_file("sliding_masses")))


COUNT, N = 7, 3


def starts_of(robot: SpaceRobot, *, moving: bool) -> InitialStates:
    rng = np.random.default_rng(11)
    return InitialStates(
        rng.normal(size=(COUNT, 3)),
        3.0 * rng.normal(size=(COUNT, 4)),
        rng.uniform(-0.1, 0.1, (COUNT, N)),
        0.02 * rng.normal(size=(COUNT, N)) * moving,
        rng.normal(size=(COUNT, 6)),
        np.arange(COUNT) % 3 == 0,
    )


def sensors_of(count: int = COUNT) -> SensorErrors:
    rng = np.random.default_rng(12)
    noise, pose_bias = rng.uniform(0.001, 0.002, (count, 6)), rng.normal(size=(count, 6)) / 9
    pose_bias[1] = 0.0
    return SensorErrors(
        noise, pose_bias, rng.normal(size=(count, N)) / 7, np.arange(count) * 10 + 3
    )


def flights_of(robot: SpaceRobot, actuation: str, program: Any, **changes: Any) -> Flights:
    starts = starts_of(robot, moving=actuation == "effort")
    rng = np.random.default_rng(13)
    bodies = len(robot.description.bodies)
    inertial = robot.inertial.scaled(rng.uniform(0.8, 1.2, (COUNT, bodies)))
    return Flights(
        robot,
        actuation,
        0.04,
        7,
        starts,
        program,
        inertial,
        **{"report_ticks": (0, 3, 7), **changes},
    )


SIZES = {
    **{"alive": 1, "measured": N, "joint_bias": N, "joint_noise": 1, "limits": 2 * N},
    **{"peak_rate": N, "peak_effort": N, "peak_wrench": 2, "impulse": 2, "lowest": N, "highest": N},
    **{"decision": 1, "decided": 1, "decided_state": 2 * N + 13, "ended": 1},
    **{"end_state": 2 * N + 20, "drift": 2, "p": 40, "h": 1, "command": N + 6},
    **{"momenta": 6, "r_cm": 3},
    **{"limited": 2 * N + 1, "pose": 7, "twist": 6, "momentum": 7, "exact": 1},
}


class Library:
    """Stand-in for the compiled driver: notes its calls and hands back what it is told to."""

    def __init__(self, waits: Sequence[Callable[[], None]] = ()) -> None:
        self.calls: list[tuple[Any, ...]] = []
        self._waits = list(waits)

    def start_flights(self, job: Job) -> None:
        self.calls.append(("start",))

    def measure_starts(self, job: Job) -> None:
        self.calls.append(("measure",))

    def end_flights(self, job: Job) -> None:
        self.calls.append(("end",))

    def fly_until(self, job: Job, end: int) -> int:
        chunk = job.normals_from, job.normals_ticks, job.normals_width
        self.calls.append(("fly", end, *chunk))
        if not self._waits:
            return 0
        self._waits.pop(0)()
        return 1


def block_of(
    flights: Flights,
    rows: Sequence[int] = (0, 2, 3, 4, 6),
    controller: Any = None,
    library: Library | None = None,
    **sizes: int,
) -> Any:
    """Return a block of two lanes a group, of which the last repeats a flight."""
    assert flights.inertial is not None
    model, p = flights.robot.symbolic_model(flights.inertial)
    effort = flights.actuation == "effort"
    state = {"state": 2 * N + 13 if effort else N + 4}
    state["next_state"] = state["state"]
    tick = SimpleNamespace(
        vector_unit=SimpleNamespace(lanes=2, name="pairs"),
        memory_layout=RowLayout({**SIZES, **state, "p": p.shape[1], **sizes}),
        controller=controller,
        library=library or Library(),
        report_width=2 * N + 20,
        reported_link="",
    )
    return lanes.LaneBlock(flights, cast(Any, tick), model, p, np.array(rows))


def held(actuation: str = "effort") -> HeldCommands:
    rng = np.random.default_rng(14)
    if actuation == "velocity":
        return HeldCommands(rng.normal(size=(2, N)))
    return HeldCommands(rng.normal(size=(2, N)), rng.normal(size=(COUNT, 3, 6)))


@pytest.mark.parametrize("actuation", ["velocity", "effort"])
def test_lanes_start_in_the_states_of_the_plants(sliders: SpaceRobot, actuation: str) -> None:
    flights = flights_of(sliders, actuation, held(actuation), sensors=sensors_of())
    block = block_of(flights)
    at = [0, 2, 3, 4, 6, 6]
    assert block._rows_of_lanes.tolist() == at
    assert block._memory.shape == (3, block._rows.total_rows, 2)
    for index, row in enumerate(at):
        plant: Any = plant_of(flights, row)
        size = np.linalg.norm(flights.initial_states.quaternion[row])
        quaternion = flights.initial_states.quaternion[row] / size
        center = flights.initial_states.position[row]
        if not flights.initial_states.position_is_of_center_of_mass[row]:
            R_WB = Rotation.from_quat(quaternion).as_matrix()
            center = center + R_WB @ flights.robot_of(row).center_of_mass(plant.q)
        shape = flights.initial_states.q[row], quaternion
        if actuation == "effort":
            parts = flights.initial_states.qdot[row], flights.initial_states.momenta[row], center
            expected = np.concatenate([*shape, *parts])
        else:
            expected = np.concatenate(shape)
            np.testing.assert_allclose(block._read_rows("r_cm")[index], center, atol=1e-12)
            np.testing.assert_array_equal(
                block._read_rows("momenta")[index], flights.initial_states.momenta[row]
            )
        np.testing.assert_allclose(block._read_rows("state")[index], expected, atol=1e-12)
        assert flights.sensors is not None
        np.testing.assert_array_equal(
            block._read_rows("joint_bias")[index], flights.sensors.joint_bias[row]
        )
        assert block._read_rows("joint_noise")[index].tolist() == [flights.sensors.noise[row, 4]]
        assert block._read_rows("p")[index] @ np.ones(block._rows.row_count("p")) == pytest.approx(
            block._memory[index // 2, block._rows["p"], index % 2].sum()
        )
    assert (block._read_rows("alive") == 1.0).all()
    for name in ("decided_state", "end_state"):
        assert np.isnan(block._read_rows(name)).all()
    for name in ("h", "ended", "decision", "decided", "limits", "impulse"):
        assert not block._read_rows(name).any()
    assert (block._at.tolist(), block._pending.tolist()) == ([0, 0, 0], [0, 0, 0])
    assert block._reports.shape == (3, 3, 2 * N + 20, 2)
    assert not block._reports.any()


def test_commands_have_zeros_after_their_last_and_a_copy_for_each_lane(
    sliders: SpaceRobot,
) -> None:
    program = held()
    assert program.wrench is not None
    block = block_of(flights_of(sliders, "effort", program))
    table = block._command_table()
    assert table.shape == (3, 3, N + 6, 2)
    assert table.flags.c_contiguous
    for index, row in enumerate([0, 2, 3, 4, 6, 6]):
        here = table[index // 2, :, :, index % 2]
        np.testing.assert_array_equal(here[:2, :N], program.joints)
        np.testing.assert_array_equal(here[:, N:], program.wrench[row])
        assert not here[2, :N].any()
    job = block._job
    assert (job.groups, job.each_table, job.table_ticks, job.program) == (3, 1, 3, 0)
    assert (job.period, job.period_ns, job.noisy, job.ends) == (0.04, 40_000_000, 0, 0)
    assert job.instant_count == 3

    alike = HeldCommands(program.joints)
    job_of_all = block_of(flights_of(sliders, "effort", alike))
    table = job_of_all._command_table()
    np.testing.assert_array_equal(table, np.hstack([program.joints, np.zeros((2, 6))]))
    assert (job_of_all._job.each_table, job_of_all._job.table_ticks) == (0, 2)
    # With one wrench for all, each flight has joints of its own.
    own = HeldCommands(np.arange(COUNT * 6.0).reshape(COUNT, 2, N), np.ones((1, 6)))
    table = block_of(flights_of(sliders, "effort", own))._command_table()
    np.testing.assert_array_equal(table[1, :, :N, 0], own.joints[3])
    np.testing.assert_array_equal(table[1, :, N:, 0], [[1.0] * 6, [0.0] * 6])


def test_a_schedule_is_followed_with_a_gain_that_a_tick_can_bear(sliders: SpaceRobot) -> None:
    positions = np.arange(COUNT * 12.0).reshape(COUNT, 4, N)
    for gain, wanted in ((3.0, 3.0), (40.0, 25.0)):
        program = FollowedSchedule(positions, gain, deadband=0.25)
        block = block_of(flights_of(sliders, "velocity", program, sensors=sensors_of()))
        job = block._job
        assert (job.gain, job.deadband, job.program) == (pytest.approx(wanted), 0.25, 1)
        assert (job.table_ticks, job.each_table, job.noisy) == (4, 1, 1)
        np.testing.assert_array_equal(block._command_table()[2, :, :, 1], positions[6])


def test_ticks_are_flown_in_chunks_with_the_noise_of_each(
    sliders: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lanes, "_CHUNK_TICKS", 3)
    program = FollowedSchedule(np.zeros((4, N)), 3.0)
    for sensors, chunks in (
        (sensors_of(), [(0, 3, N), (3, 3, N), (6, 2, N)]),
        (None, [(0, 0, 0)] * 3),
    ):
        flights = flights_of(sliders, "velocity", program, sensors=sensors)
        library = Library()
        block = block_of(flights, library=library)
        block.fly(BatchResult.empty(flights), {})
        flown = [("fly", end, *chunk) for end, chunk in zip((3, 6, 7), chunks, strict=True)]
        assert library.calls == [("start",), *flown]
        np.testing.assert_array_equal(block._read_rows("h"), np.full((6, 1), 0.04))


def test_a_block_whose_flights_have_all_failed_is_flown_no_further(
    sliders: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lanes, "_CHUNK_TICKS", 3)
    flights = flights_of(sliders, "effort", held())
    failures: dict[int, str] = {}

    def fail() -> None:
        for index in range(6):
            block._end_flight(index, 2, f"lane {index}", failures)

    library = Library([fail])
    block = block_of(flights, library=library)
    result = BatchResult.empty(flights)
    block.fly(result, failures)
    assert [call[:2] for call in library.calls] == [("start",), ("fly", 3), ("fly", 3)]
    # The sixth lane repeats the last flight: its failure is nobody's.
    assert failures == {0: "lane 0", 2: "lane 1", 3: "lane 2", 4: "lane 3", 6: "lane 4"}
    # States after the tick of the failure are unknown: of ticks 0, 3 and 7 the last two.
    assert np.isnan(result.q[6]).all(axis=1).tolist() == [False, True, True]
    assert np.isnan(result.q[1]).all()


def test_results_come_from_the_rows_of_their_names(sliders: SpaceRobot) -> None:
    flights = flights_of(sliders, "velocity", held("velocity"))
    block, result = block_of(flights), BatchResult.empty(flights)
    block._memory[:] = np.arange(block._memory.size).reshape(block._memory.shape)
    block._reports[:] = np.arange(block._reports.size).reshape(block._reports.shape)
    block._write_results(result)
    width = 2 * N + 20
    for index, row in enumerate([0, 2, 3, 4, 6]):
        group, lane = divmod(index, 2)
        begin = 0
        for name, size in (("q", N), ("qdot", N), ("pose", 7), ("twist", 6), ("momentum", 7)):
            for instant in range(3):
                first = (group * 3 + instant) * width + begin
                wanted = 2.0 * np.arange(first, first + size) + lane
                np.testing.assert_array_equal(getattr(result, name)[row, instant], wanted)
            begin += size
        for name in ("peak_rate", "peak_effort", "peak_wrench", "impulse", "lowest", "highest"):
            wanted = block._memory[group, block._rows[name], lane]
            np.testing.assert_array_equal(getattr(result, name)[row], wanted)
        limits = block._memory[group, block._rows["limits"], lane]
        np.testing.assert_array_equal(result.limited_ticks["rate"][row], limits[:N])
        np.testing.assert_array_equal(result.limited_ticks["stroke"][row], limits[N:])
    np.testing.assert_array_equal(result.measured_q, result.q)
    np.testing.assert_array_equal(result.measured_pose, result.pose)
    assert not result.peak_rate[[1, 5]].any()


def test_a_lane_at_a_stop_is_stepped_by_its_plant(sliders: SpaceRobot) -> None:
    flights = flights_of(sliders, "effort", held())
    flights.initial_states.q[3, 1] = sliders.upper[1] - 1e-4
    flights.initial_states.qdot[3, 1] = 0.1
    result = BatchResult.empty(flights)

    def wait() -> None:
        memory, at = block._memory, block._rows
        block._pending[1], block._at[1] = Pending.COMMIT, 5
        memory[1, at["command"], 0] = 0.1 * np.arange(1, N + 7)
        memory[1, at.first_row("limited", 1 + N)] = [1.0, 0.0]

    block = block_of(flights, library=Library([wait]))
    block.fly(result, {})
    plant: Any = plant_of(flights, 3)
    plant.step(0.1 * np.arange(1, N + 1), 0.1 * np.arange(N + 1, N + 7))
    memory = {name: block._memory[1, at, 0] for name, at in block._rows.slices.items()}
    for name, wanted in (
        ("next_state", plant.state),
        ("pose", plant.pose),
        ("twist", plant.twist),
        ("momentum", plant.momentum),
    ):
        np.testing.assert_allclose(memory[name], wanted, rtol=1e-12, atol=1e-12, err_msg=name)
    assert not memory["limited"].any()
    assert result.fallback_ticks.tolist() == [0, 0, 0, 1, 0, 0, 0]
    assert plant.stroke_limited.tolist() == [0, 1, 0]
    np.testing.assert_array_equal(result.limited_ticks["stroke"][3], plant.stroke_limited)
    assert list(block._stopped) == [2]


class Controller:
    """Stand-in for the controller of a batch: notes what it is asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[Any, ...]] = []

    def gains_argument(self, rows: Sequence[int]) -> Array:
        return np.array([[row + 0.25, row + 0.5, row + 0.75] for row in rows])

    def begin_flight(self, row: int, state: Any) -> tuple[Any, Array]:
        if row == 4:
            raise SpaceRobotError("no goal")
        return SimpleNamespace(goal=f"goal {row}", row=row), np.array([row + 0.1, state.r_WB[0]])

    def profile_argument(self, profile: Any) -> Array:
        return np.array([profile.row, 8.0])

    def exact_command(self, row: int, profile: Any, tick: int, state: Any) -> Any:
        self.asked.append((row, profile.row, tick, float(state.qdot[-1])))
        if row == 6:
            raise SpaceRobotError("no command")
        realised = SimpleNamespace(tau=np.array([1.0, 2, 3]), wrench_B=np.arange(4.0, 10))
        return SimpleNamespace(realised=realised)

    def distance(self, state: Any, goal: Any) -> Any:
        self.asked.append((goal, float(state.qdot[-1])))
        return OutputDistance(state.r_WB[0], 0.25, float(state.qdot[-1]))


def test_controlled_lanes_begin_decide_and_end_each_for_itself(
    sliders: SpaceRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = ControllerConfig(tick_rate=25.0)
    flights = flights_of(
        sliders, "effort", ControlledGoals(config, ends_when_decided=True), sensors=sensors_of()
    )
    result, state = BatchResult.empty(flights), 2 * N + 13
    failures: dict[int, str] = {}
    controller = Controller()

    def decide() -> None:
        memory, at = block._memory, block._rows
        for group in range(3):
            block._pending[group], block._at[group] = Pending.TICK, 6 + group
            memory[group, at["measured"]] = 10 * group + np.arange(state)[:, None] + [[0, 0.5]]
            memory[group, at["exact"]] = 1.0
            memory[group, at["decision"]] = [[1.0, 0.0]]
            memory[group, at["decided"]] = [[5.0, -1.0]]
            memory[group, at["decided_state"]] = group + np.arange(state)[:, None]
            memory[group, at["ended"]] = [[6.0, 7.0]]
            memory[group, at["drift"]] = [[0.5, 0.6], [0.7, 0.8]]
            memory[group, at["end_state"]] = group + 0.5

    library = Library([decide])
    sizes: Any = {"measured": state, "profile": 2, "bounds": 2, "monitor": 3, "gains": 3}
    block = block_of(
        flights, controller=controller, library=library, **sizes, bias=6 + N, sigma=6
    )  # fmt: skip
    assert block._read_rows("monitor").tolist() == [[-1.0, 0.0, 0.0]] * 6
    assert (block._read_rows("decided") == -1.0).all()
    assert block._read_rows("gains")[3].tolist() == [4.25, 4.5, 4.75]
    assert flights.sensors is not None
    np.testing.assert_array_equal(block._read_rows("sigma")[1], flights.sensors.noise[2])
    np.testing.assert_array_equal(
        block._read_rows("bias")[2], [*flights.sensors.pose_bias[3], *flights.sensors.joint_bias[3]]
    )
    assert (block._job.ends, block._job.noisy, block._job.program) == (1, 1, 2)
    # Held commands of a controller are none: one row of zeros.
    assert block._command_table().tolist() == [[0.0] * (N + 6)]

    block.fly(result, failures)
    assert [call[0] for call in library.calls] == ["start", "measure", "fly", "fly", "end"]
    assert library.calls[2] == ("fly", 7, 0, 8, 12 + 2 * N)
    assert failures == {4: "no goal", 6: "no command"}
    assert block._ended == {3: 0, 4: 8}
    # Of the flight that did not begin and of the failed one nothing is commanded.
    assert [each for each in controller.asked if len(each) == 4] == [
        (0, 0, 6, 18.0),
        (2, 2, 6, 18.5),
        (3, 3, 7, 28.0),
        (6, 6, 8, 38.0),
        (6, 6, 8, 38.5),
    ]
    assert block._read_rows("command")[0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8, 9]
    assert not block._read_rows("command")[3].any()
    assert block._read_rows("profile").tolist() == [[0, 8], [2, 8], [3, 8], [0, 0], [6, 8], [6, 8]]
    assert block._read_rows("bounds")[:4, 0].tolist() == [0.1, 2.1, 3.1, 0.0]
    assert result.decision.tolist() == [1, 0, 0, 1, 0, 0, 1]
    assert result.decision_tick.tolist() == [5, -1, -1, 5, -1, -1, 5]
    assert result.end_tick[[0, 2, 3]].tolist() == [6, 7, 6]
    assert result.momentum_drift[2].tolist() == [0.6, 0.8]
    assert result.end_state[3, 4] == 1.5
    # The sixth lane repeats the fifth, whose goal is decided; others have no distance.
    assert result.decision_distance[[0, 3, 6]].tolist() == [
        [0, 0.25, 18],
        [1, 0.25, 19],
        [2, 0.25, 20],
    ]
    assert np.isnan(result.decision_distance[2]).all()
    assert [each for each in controller.asked if len(each) == 2] == [
        ("goal 0", 18.0),
        ("goal 3", 19.0),
        ("goal 6", 20.0),
    ]
    assert result.fallback_ticks.tolist() == [1, 0, 1, 1, 0, 0, 0]


def noise_of(
    program: Any, sensors: SensorErrors | None, rows: Sequence[int], instants: tuple[int, ...]
) -> lanes.SensorNoise:
    flights = SimpleNamespace(
        sensors=sensors, program=program, report_ticks=instants, robot=SimpleNamespace(n=N)
    )
    return lanes.SensorNoise(cast(Any, flights), np.array(rows))


@pytest.mark.parametrize("all_of_it", [False, True])
def test_noise_of_chunks_is_that_of_each_seed_in_one_go(all_of_it: bool) -> None:
    """A lane draws all numbers of a tick, whichever of them its commands need."""
    program = (
        ControlledGoals(ControllerConfig()) if all_of_it else FollowedSchedule(np.zeros((2, N)))
    )
    sensors, rows = sensors_of(), [5, 1, 2, 6]
    sensors.noise[2] = 0.0  # The third lane's sensors are biased alone.
    noise = noise_of(program, sensors, rows, (0, 2, 4, 6))
    assert noise.is_fed_back
    alive = np.ones((2, 2))
    first = noise.draw_noise(0, 4, alive)
    alive[1, 1] = 0.0  # The fourth fails.
    second = noise.draw_noise(4, 7, alive)
    assert first is not None
    assert second is not None
    width = 12 + 2 * N
    columns = slice(0, width) if all_of_it else slice(12, 12 + N)
    assert first.shape == (2, 4, columns.stop - columns.start, 2)
    assert second.shape == (2, 3, columns.stop - columns.start, 2)
    drawn = {row: np.random.default_rng(10 * row + 3).normal(size=(7, width)) for row in rows}
    drawn[2][:] = 0.0
    drawn[6][4:] = 0.0
    for index, row in enumerate(rows):
        group, lane = divmod(index, 2)
        both = np.concatenate([first[group, :, :, lane], second[group, :, :, lane]])
        np.testing.assert_array_equal(both, drawn[row][:, columns])

    pose = np.tile([1.0, 2.0, 3.0, 0.0, 0.6, 0.0, 0.8], (3, 4, 1))
    q = np.full((3, 4, N), 0.5)
    measured, joints = noise.measure(pose, q)
    for index, row in enumerate(rows[:3]):
        for instant, tick in enumerate((0, 2, 4, 6)):
            z, sigma, bias = drawn[row][tick], sensors.noise[row], sensors.pose_bias[row]
            here = measured[index, instant]
            np.testing.assert_allclose(here[:3], [1, 2, 3] + bias[:3] + sigma[0] * z[:3])
            turn = Rotation.from_rotvec(bias[3:] + sigma[1] * z[3:6])
            wanted = (Rotation.from_quat([0.0, 0.6, 0.0, 0.8]) * turn).as_quat()
            np.testing.assert_allclose(here[3:] * np.sign(here[6] * wanted[3]), wanted)
            of_joints = 0.5 + sensors.joint_bias[row] + sigma[4] * z[12 : 12 + N]
            np.testing.assert_allclose(joints[index, instant], of_joints)


def test_noise_that_no_command_needs_is_not_kept() -> None:
    program, sensors = held(), sensors_of()
    none = noise_of(program, None, [0, 1], (0,))
    assert (none.is_fed_back, none.draw_noise(0, 3, np.ones((1, 2)))) == (False, None)
    pose, q = np.ones((2, 1, 7)), np.ones((2, 1, N))
    assert none.measure(pose, q) == (pose, q)
    sensors.noise[:, 4], sensors.joint_bias[:] = 0.0, 0.0
    quiet = noise_of(program, sensors, [0, 3], (0,))
    assert (quiet.is_fed_back, quiet.draw_noise(0, 3, np.ones((1, 2)))) == (False, None)
    # It is drawn all the same, for what is reported.
    assert quiet.measure(pose, q)[0][1, 0, 0] == pytest.approx(
        1
        + sensors.pose_bias[3, 0]
        + sensors.noise[3, 0] * np.random.default_rng(33).standard_normal()
    )
    sensors.joint_bias[3, 1] = 1e-9
    assert noise_of(program, sensors, [0, 3], (0,)).is_fed_back
    assert not noise_of(program, sensors, [0, 4], (0,)).is_fed_back
    sensors.joint_bias[:], sensors.noise[0, 4] = 0.0, 1e-9
    assert noise_of(program, sensors, [0, 4], (0,)).is_fed_back


def test_starts_that_the_plant_would_refuse_are_left_to_it() -> None:
    lower, upper = np.array([-1.0, -2.0, 0.0]), np.array([1.0, 3.0, 0.5])
    good = {
        "position": np.zeros(3),
        "quaternion": np.array([0.0, 0.0, 0.0, 2.0]),
        "q": np.array([1.0, -2.0, 0.5]),
        "qdot": np.zeros(3),
        "momenta": np.ones(6),
    }
    cases: list[tuple[str, list[float], bool]] = [
        ("q", [-1.0, 3.0, 0.0], True),
        ("q", [-1.0, 3.0, -1e-9], False),
        ("q", [1.0 + 1e-9, 0.0, 0.25], False),
        ("q", [0.0, np.nan, 0.25], False),
        ("position", [0.0, np.inf, 0.0], False),
        ("qdot", [0.0, 0.0, np.nan], False),
        ("momenta", [0.0, 0.0, 0.0, 0.0, 0.0, -np.inf], False),
        ("quaternion", [0.0, 1e-3, 0.0, 0.0], False),
        ("quaternion", [0.0, 0.0, 1.01e-3, 0.0], True),
        ("quaternion", [1e3, 0.0, 0.0, 0.0], False),
        ("quaternion", [0.0, 0.0, 0.0, -999.0], True),
        ("quaternion", [0.0, 0.0, np.nan, 1.0], False),
    ]
    starts = {name: np.array([value] * len(cases)) for name, value in good.items()}
    for row, (name, value, _) in enumerate(cases):
        starts[name][row] = value
    robot = SimpleNamespace(lower=lower, upper=upper)
    flights: Any = SimpleNamespace(initial_states=SimpleNamespace(**starts), robot=robot)
    assert lanes.starts_accepted_by_plant(flights).tolist() == [fit for _, _, fit in cases]


@pytest.mark.parametrize(
    ("program", "noisy", "rows", "flights"),
    [
        # 8 bytes (2 * 100 rows + 60 * 3 instants) are 3040; 2**25 // (4 * 3040) = 2759 groups.
        (ControlledGoals(ControllerConfig()), False, 100, 64 * 4),
        # 8 (2 * 40000 + 180) = 641440: 13 groups.
        (ControlledGoals(ControllerConfig()), False, 40_000, 13 * 4),
        # With noise of 2000 ticks, 2 * 8 * 2000 * 18 = 576000 more: 6.89 groups of four.
        (ControlledGoals(ControllerConfig()), True, 40_000, 6 * 4),
        (FollowedSchedule(np.zeros((9, 3))), True, 40_000, 6 * 4),
        # Tables of each flight, twice 8 * 3 * 5000 = 240000 more.
        (FollowedSchedule(np.zeros((2, 5000, 3))), False, 40_000, 9 * 4),
        (HeldCommands(np.zeros((5000, 3))), False, 40_000, 13 * 4),
        (HeldCommands(np.zeros((2, 5000, 3))), False, 40_000, 9 * 4),
        (HeldCommands(np.zeros((9, 3)), np.zeros((2, 2500, 6))), False, 40_000, 9 * 4),
        (HeldCommands(np.zeros((2, 2500, 3)), np.zeros((2, 2500, 6))), False, 40_000, 8 * 4),
        # At least one group, however large.
        (ControlledGoals(ControllerConfig()), False, 5_000_000, 4),
    ],
)
def test_blocks_fill_their_memory(program: Any, noisy: bool, rows: int, flights: int) -> None:
    made: Any = SimpleNamespace(
        robot=SimpleNamespace(n=3),
        ticks=12_345,
        report_ticks=(0, 5, 9),
        sensors=object() if noisy else None,
        program=program,
    )
    tick: Any = SimpleNamespace(
        memory_layout=SimpleNamespace(total_rows=rows), vector_unit=SimpleNamespace(lanes=4)
    )
    assert lanes._block_size(made, tick) == flights


def test_short_flights_need_little_noise() -> None:
    """100 ticks: 8 (2 * 20000 + 60) + 2 * 8 * 100 * 18 = 349280 bytes, 12 groups of eight."""
    made: Any = SimpleNamespace(
        robot=SimpleNamespace(n=3),
        ticks=100,
        report_ticks=(0,),
        sensors=object(),
        program=ControlledGoals(ControllerConfig()),
    )
    tick: Any = SimpleNamespace(
        memory_layout=SimpleNamespace(total_rows=20_000), vector_unit=SimpleNamespace(lanes=8)
    )
    assert lanes._block_size(made, tick) == 12 * 8


def test_vectors_are_rotated_and_tables_filled_up() -> None:
    rng = np.random.default_rng(5)
    rotations, vectors = Rotation.random(6, random_state=3), rng.normal(size=(6, 3))
    np.testing.assert_allclose(
        lanes._rotate_vectors(rotations.as_quat(), vectors), rotations.apply(vectors), atol=1e-14
    )
    table = np.arange(6.0).reshape(2, 3)
    filled = [[0, 1, 2], [3, 4, 5], [0, 0, 0], [0, 0, 0]]
    assert lanes._pad_table(table, 4, 2, 5).tolist() == filled
    assert lanes._pad_table(table, 4, 3, 5).tolist() == [filled] * 5
    assert lanes._pad_table(table[None], 4, 3, 5).tolist() == [filled]
    np.testing.assert_array_equal(lanes._pad_table(table, 2, 2, 5), table)
    for shape in ((2, 3, 8), (1, 5, 4), (3, 1, 2)):
        array = lanes._aligned_array(shape, 0.5)
        assert (array.shape, array.ctypes.data % 64) == (shape, 0)
        assert (array == 0.5).all()
        assert not lanes._aligned_array(shape).any()
