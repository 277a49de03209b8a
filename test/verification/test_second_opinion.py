"""Bags flown again: reference bags by the plant, and commands by MuJoCo."""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ET
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from click.testing import Result
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import JointState
from support.altered_bags import altered
from support.command_line import CliRunner
from support.raw_messages import iterate_raw
from support.sentences import assert_one_sentence
from support.slow import some_fast

from spacerobot_ros import fly
from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.cli.main import main
from spacerobot_ros.errors import RobotDescriptionError
from spacerobot_ros.flight.verification import EngineComparison, EngineFlight, verify_bag
from spacerobot_ros.model import SpaceRobot, parse_robot
from spacerobot_ros.resources import resource_names, robot_file, share_directory
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario
from spacerobot_ros.simulation import mujoco_model
from spacerobot_ros.simulation.actuators import PlantWithFaults
from spacerobot_ros.simulation.loads import Surroundings
from spacerobot_ros.simulation.plant import InitialState
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

mujoco = pytest.importorskip("mujoco")

BAGS = Path(__file__).resolve().parents[2] / "bags"
QUICK = ("coordinated_control",)
LARGEST = {"reach": 1e-9, "two_hands": 2e-10, "gravity_gradient": 1e-10}
"""Errors by steps of 1 ms in fast motions or of 80 ms, m or rad; all others are below 2e-11."""


def opinion_of(path: Path) -> EngineComparison:
    found = verify_bag(path, mujoco=True)
    assert found.difference is None
    assert found.second_opinion is not None
    return found.second_opinion


def verify(path: Path) -> Result:
    return CliRunner().invoke(main, ["verify", str(path), "--engine", "mujoco"])


CAPTURES = ("capture", "servicing")
"""Bags with a target, which MuJoCo does not model here."""


@pytest.mark.parametrize(
    "name",
    some_fast([each for each in resource_names("bags", ".mcap") if each not in CAPTURES], *QUICK),
)
def test_mujoco_flies_reference_bags_to_the_same_states(name: str) -> None:
    path = BAGS / f"{name}.mcap"
    found = opinion_of(path)
    assert (found.agrees, found.stop_reason) == (True, "")
    assert max(found.position, found.attitude, found.joints) <= LARGEST.get(name, 2e-11)
    assert found.ticks == verify_bag(path).ticks
    assert found.engine.startswith("MuJoCo ")


@pytest.mark.parametrize(
    ("name", "link"),
    some_fast(
        [("coordinated_control", "link_1"), ("reach", "link_2")], ("coordinated_control", "link_1")
    ),
)
def test_a_thousandth_of_a_mass_is_noticed(
    name: str, link: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    of_urdf = mujoco_model.robot_spec

    def heavier(mujoco: Any, description: Any) -> Any:
        spec = of_urdf(mujoco, description)
        (body,) = (each for each in spec.bodies if each.name == link)
        body.mass *= 1.001
        return spec

    monkeypatch.setattr(mujoco_model, "robot_spec", heavier)
    result = verify(BAGS / f"{name}.mcap")
    assert result.exit_code == 1
    assert_one_sentence(result.stderr, "differs by more than 1e-08 m or rad")


def flown(tmp_path: Path, duration: float, **plant: Any) -> Path:
    """Fly paper 4's robot; return its bag."""
    path = tmp_path / "flown.mcap"
    settings = {f"plant.{name}": value for name, value in plant.items()}
    limit = {"coordinated_control.time_limit": duration}
    fly("coordinated_control", parameters={**settings, **limit}).save(path)
    return path


def test_faults_are_flown_and_held_joints_end_the_comparison(tmp_path: Path) -> None:
    """A slow joint moves as its actuator realises it; a brake is a force that nobody commands."""
    faults = ["joint_slow elbow 0.6 at 0.1", "joint_stuck shoulder at 0.47"]
    turned = [0.0, 0.0, 0.6, 0.8]
    path = flown(tmp_path, 0.8, faults=faults, initial_orientation=turned)
    result = verify(path)
    assert result.exit_code == 0, result.output
    note = result.stdout.splitlines()[-1]
    assert note.startswith("note        compared until joint 'shoulder' is held at 0.4")
    found = opinion_of(path)
    assert 40 <= found.ticks <= 48
    assert max(found.position, found.attitude, found.joints) < 1e-10


@pytest.mark.parametrize(
    "plant",
    [
        {
            "disturbances": [
                "link_1 force 0.4 2 0 at 0.13 until 0.37",
                "link_2 torque 0 0 -0.3 in link at 0.2",
            ]
        },
        {"orbit.mean_motion": 0.7, "orbit.orientation": [0.0, 0.6, 0.0, 0.8]},
        {"table.tilt": 0.02, "table.direction": 0.7, "table.friction": 0.3},
    ],
    ids=["wrenches", "gradient", "table"],
)
def test_external_loads_are_flown(tmp_path: Path, plant: dict[str, Any]) -> None:
    path = flown(tmp_path, 0.5, **plant)
    found = opinion_of(path)
    assert (found.stop_reason, found.ticks) == ("", 51)
    assert max(found.position, found.attitude, found.joints) < 1e-10


@pytest.mark.parametrize(
    "surroundings",
    some_fast(
        {
            "gradient": Surroundings(mean_motion=0.7, quaternion_WO=(0.0, 0.6, 0.0, 0.8)),
            "table": Surroundings(gravity_W=(0.3, -0.1, 0.2), friction=0.4),
        },
        "table",
    ),
)
def test_external_loads_are_flown_under_velocities(surroundings: Surroundings) -> None:
    """Where joint rates are given, loads change the momenta."""
    robot = SpaceRobot.from_file(robot_file("three_joint_arm"))
    start = InitialState(
        position=np.array([0.3, -0.2, 0.5]),
        quaternion=np.array([0.1, -0.5, 0.5, 0.7]),
        joint_positions=np.array([-0.4, -0.5, 0.2]),
        angular_momentum=np.array([0.2, -0.3, 0.1]),
    )
    period, pushed = 0.013, [f"{robot.link_names[2]} force 0 2 0.5 at 0.1"]
    plant = PlantWithFaults(
        VelocityPlant(robot, period, start),
        (),
        period,
        wrench=False,
        disturbances=pushed,
        surroundings=surroundings,
    )
    flight = EngineFlight(plant, period)
    poses, shapes = [plant.pose.copy()], [plant.q.copy()]
    for tick in range(30):
        plant.step(0.2 * np.cos(np.arange(robot.n) + 0.1 * tick))
        flight.fly_next_tick()
        poses.append(plant.pose.copy())
        shapes.append(plant.q.copy())
    found = flight.comparison(np.arange(31), np.array(poses), np.array(shapes))
    assert (found.stop_reason, found.ticks) == ("", 30)
    assert np.linalg.norm(plant.momentum[:3]) > 0.1
    assert max(found.position, found.attitude, found.joints) < 1e-10
    # Differences of a bag, which has further ticks.
    poses[7] = poses[7] + np.array([0.001, 0.002, -0.002, 0, 0, 0, 0])
    turn = Rotation.from_rotvec([0.0, 0.003, 0.004])
    poses[9][3:] = (Rotation.from_quat(poses[9][3:]) * turn).as_quat()
    shapes[8] = shapes[8] - np.array([0.0, 0.006, 0.0])
    bag = [np.append(each, each[-1:], axis=0) for each in (np.array(poses), np.array(shapes))]
    found = flight.comparison(np.arange(32), *bag)
    assert found.ticks == 30
    assert found.time == pytest.approx(8 * period)
    assert found.position == pytest.approx(0.003)
    assert found.attitude == pytest.approx(0.005)
    assert found.joints == pytest.approx(0.006)


def test_a_joint_at_its_stop_ends_the_comparison(tmp_path: Path) -> None:
    pushed = ["actuator_bias elbow 20 at 0"]
    found = opinion_of(flown(tmp_path, 1.2, faults=pushed, initial_joint_positions=[-1.0, 2.78]))
    assert found.stop_reason.startswith("joint 'elbow' is at its stop at ")
    assert found.ticks > 20
    assert found.joints < 1e-8


def test_without_mujoco_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    result = verify(BAGS / "reach.mcap")
    assert result.exit_code == 2
    assert_one_sentence(result.stderr, "pip install '.[mujoco]' in the clone")


def test_joints_that_follow_others_are_refused() -> None:
    text = robot_file("planar_chain").read_text("utf-8")
    mimic = '<mimic joint="pin_1" multiplier="-0.5"/>'
    before, joint, after = text.partition('<joint name="pin_2" type="continuous">')
    robot = parse_robot(f"{before}{joint}{mimic}{after}")
    assert robot.has_mimic_joints
    with pytest.raises(RobotDescriptionError, match="<mimic>"):
        mujoco_model.build_model(mujoco, robot, None, 0.001)


# -- the reference bags: every scenario has one, every reader reads it, and it can be ------------


SHARED_BAGS = share_directory() / "bags"
NAMES = resource_names("config", ".yaml")

QUICK_BAGS = ("sliding_masses", "arm_attitude", "planar_chain", "coordinated_control")
"""Bags of which all tests are quick."""

MIN_TICKS = {"reach": 30, "two_hands": 25, "strut": 50, "capture": 150, "gravity_gradient": 200}
MIN_TICKS |= {"free_flyer": 200, "wheels": 250}
"""Flights of these are short, or have few ticks a second."""


def test_every_scenario_has_a_bag_and_they_are_small() -> None:
    assert resource_names("bags", ".mcap") == NAMES
    assert sum(path.stat().st_size for path in SHARED_BAGS.iterdir()) < 5_500_000


@pytest.mark.parametrize("name", some_fast(NAMES, *QUICK_BAGS))
def test_the_commands_in_it_give_the_states_in_it(name: str) -> None:
    # Where this fails, the plant behaves in another way than before: `make bags` if that is meant.
    result = verify_bag(SHARED_BAGS / f"{name}.mcap")
    assert result.difference is None, str(result.difference)
    assert result.ticks > MIN_TICKS.get(name, 300)
    # Clock, end-effector and base pose apart, three messages tell the state of every tick.
    assert result.messages > 3 * result.ticks


def pushed(message: JointState) -> JointState:
    """Change what one joint is commanded, velocity or effort, by little."""
    values = message.effort if any(message.effort) else message.velocity
    values[-1] += 1e-3
    return message


@pytest.mark.parametrize(
    "name",
    some_fast([name for name in NAMES if name not in ("free_flyer", "inspection")], *QUICK_BAGS),
)  # The cube of these has no joint.
def test_one_altered_command_is_found_at_its_time(name: str, tmp_path: Path) -> None:
    bag = read_bag(SHARED_BAGS / f"{name}.mcap")
    stamps = bag["/joint_commands"].stamp
    number = len(stamps) // 2
    copy = altered(bag.path, tmp_path / "b.mcap", "/joint_commands", number, pushed)
    difference = verify_bag(copy).difference
    assert difference is not None
    assert difference.time == pytest.approx(stamps[number + 1], abs=1e-9)
    joints = next(bag.messages("/joint_states"))[1].name
    # The effect on the other joints comes first where efforts drive them.
    assert difference.topic == "/joint_states"
    assert difference.field in {f"{what} of {j}" for what in ("position", "effort") for j in joints}


@pytest.mark.parametrize("name", some_fast(NAMES, "planar_chain", "servicer_thrusters"))
def test_every_reader_reads_every_message(name: str) -> None:
    path = SHARED_BAGS / f"{name}.mcap"
    own = [(topic, time_ns) for topic, _, time_ns, _, _ in iterate_raw(path)]
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()], validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        decoded = [
            (channel.topic, message.log_time)
            for _, channel, message, _ in reader.iter_decoded_messages(log_time_order=False)
        ]
        counts = {
            summary.channels[channel].topic: count
            for channel, count in summary.statistics.channel_message_counts.items()
        }
        assert summary.statistics.message_count == len(own)
        assert {record.name for record in reader.iter_metadata()} >= {"rosbag2", "scenario"}
        attached = ["robot_description.urdf"]
        if name in ("capture", "servicing"):
            attached.append("target.robot_description.urdf")
        assert [record.name for record in reader.iter_attachments()] == attached
        assert len(summary.chunk_indexes) == summary.statistics.chunk_count
    assert decoded == own
    assert counts == Counter(topic for topic, _ in own)
    with AnyReader([path]) as any_reader:
        assert any_reader.message_count == len(own)
        read: Counter[str] = Counter()
        for connection, _, data in any_reader.messages():
            any_reader.deserialize(data, connection.msgtype)
            read[connection.topic] += 1
    assert read == counts


# -- recorded commands, replayed open loop in another engine, lead to the recorded states --------


Array = npt.NDArray[np.float64]

STEP = 0.001
TOLERANCE = 1e-8
"""m, rad, s; the two engines agree a hundred times better over these flights."""

_KNOWS_INERTIA = {
    f"gains.{group}_{kind}.{name}": value
    for group in ("base", "end_effector")
    for kind in ("position", "attitude")
    for name, value in (("kp", 1.0), ("kd", 2.0))
}
FLIGHTS: dict[str, tuple[str, dict[str, Any]]] = {
    "planar, transposed Jacobian": ("coordinated_control", {"law": "transposed_jacobian"}),
    "planar, model-based": ("coordinated_control", {"law": "model_based"}),
    "planar, saturated": (
        "coordinated_control",
        {"law": "model_based", "max_force": 20.0, "max_torque": 10.0, "time_limit": 10.0},
    ),
    "spatial, transposed Jacobian": ("servicer", {"law": "transposed_jacobian"}),
    "spatial, model-based": ("servicer", {"law": "model_based", **_KNOWS_INERTIA}),
}


@dataclass(frozen=True)
class Motion:
    """States of a robot, one row each: base pose (world), base twist (base), joints."""

    position: Array
    quaternion: Array
    linear: Array
    angular: Array
    q: Array
    qdot: Array


class Replay:
    """A free-floating robot in MuJoCo, with a motor in every joint and six on its base.

    The six act on a site in the base link, along and about its own axes: they turn with the base
    at every stage of every step.
    """

    def __init__(self, urdf: str, joint_names: list[str]) -> None:
        spec = mujoco.MjSpec.from_string(urdf)
        spec.compiler.fusestatic = False
        base = spec.worldbody.first_body()
        base.add_freejoint()
        base.add_site(name="thrusters")
        for axis in np.eye(6):
            spec.add_actuator(
                trntype=mujoco.mjtTrn.mjTRN_SITE, target="thrusters", gear=axis.tolist()
            )
        for name in joint_names:
            spec.add_actuator(trntype=mujoco.mjtTrn.mjTRN_JOINT, target=name)
        self.model = spec.compile()
        self.model.opt.gravity[:] = 0.0
        self.model.opt.timestep = STEP
        self.model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        assert not self.model.dof_armature.any()
        assert not self.model.dof_damping.any()
        assert not self.model.actuator_ctrllimited.any()
        assert not self.model.actuator_forcelimited.any()
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(name) for name in joint_names]
        self._q = [int(joint.qposadr[0]) for joint in joints]
        self._qdot = [int(joint.dofadr[0]) for joint in joints]

    def place(self, start: Motion) -> None:
        """Begin at the first of some states."""
        data = self.data
        data.qpos[:3] = start.position[0]
        data.qpos[3:7] = np.roll(start.quaternion[0], 1)
        data.qpos[self._q] = start.q[0]
        data.qvel[:3] = Rotation.from_quat(start.quaternion[0]).apply(start.linear[0])
        data.qvel[3:6] = start.angular[0]
        data.qvel[self._qdot] = start.qdot[0]

    def fly(self, commands: Array, steps: int) -> Motion:
        """Hold each command (force, torque, efforts) for some steps; return the states after."""
        qpos, qvel = [], []
        for command in commands:
            self.data.ctrl[:] = command
            mujoco.mj_step(self.model, self.data, steps)
            qpos.append(self.data.qpos.copy())
            qvel.append(self.data.qvel.copy())
        p, v = np.array(qpos), np.array(qvel)
        quaternion = np.roll(p[:, 3:7], -1, axis=1)
        linear = Rotation.from_quat(quaternion).inv().apply(v[:, :3])
        return Motion(p[:, :3], quaternion, linear, v[:, 3:6], p[:, self._q], v[:, self._qdot])


def recorded_motion(bag: Bag) -> Motion:
    odom, joints = bag["/odom"], bag["/joint_states"]
    np.testing.assert_array_equal(odom.stamp, joints.stamp)

    def columns(path: str, axes: str = "xyz") -> Array:
        return np.column_stack([odom.field(f"{path}.{x}") for x in axes])

    return Motion(
        columns("pose.pose.position"),
        columns("pose.pose.orientation", "xyzw"),
        columns("twist.twist.linear"),
        columns("twist.twist.angular"),
        np.asarray(joints.field("position")),
        np.asarray(joints.field("velocity")),
    )


def recorded_commands(bag: Bag, urdf: str, joint_names: list[str], ticks: int) -> Array:
    """Return (ticks, 6 + n): wrench, and the efforts of it that the joints' limits admit."""
    wrenches, efforts = bag["/base_wrench"], bag["/joint_commands"]
    for series in (wrenches, efforts):
        np.testing.assert_array_equal(series.stamp[:ticks], bag["/odom"].stamp[:ticks])
    for _, message in wrenches.messages():
        assert message.header.frame_id == "base_link"
    assert next(efforts.messages())[1].name == joint_names
    wrench = np.column_stack(
        [wrenches.field(f"wrench.{part}.{x}") for part in ("force", "torque") for x in "xyz"]
    )
    limit = np.array([effort_limits(urdf)[name] for name in joint_names])
    effort = np.clip(np.asarray(efforts.field("effort")), -limit, limit)
    return np.hstack([wrench[:ticks], effort[:ticks]])


def effort_limits(urdf: str) -> dict[str, float]:
    limits = {}
    for joint in ET.fromstring(urdf).iter("joint"):
        limit = joint.find("limit")
        if limit is not None:
            limits[joint.attrib["name"]] = float(limit.attrib["effort"])
    return limits


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    some_fast(list(FLIGHTS), "planar, saturated"),
)
def test_the_commands_lead_to_the_same_motion(
    name: str, ros_domain: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", str(ros_domain))
    scenario_name, settings = FLIGHTS[name]
    scenario = load_scenario(scenario_name).with_overrides("coordinated_control", settings)
    run_scenario(scenario, tmp_path / "run.mcap")
    bag = read_bag(tmp_path / "run.mcap")
    urdf = bag.attachments["robot_description.urdf"].decode()
    joint_names = list(next(bag["/joint_states"].messages())[1].name)
    recorded = recorded_motion(bag)
    ticks = len(recorded.q) - 1
    commands = recorded_commands(bag, urdf, joint_names, ticks)
    tick = np.diff(bag["/odom"].stamp)
    np.testing.assert_allclose(tick, 0.01, rtol=0, atol=1e-9)

    replay = Replay(urdf, joint_names)
    replay.place(recorded)
    flown = replay.fly(commands, round(0.01 / STEP))

    # What is compared moves by far more than the tolerance.
    assert np.abs(np.diff(recorded.position[[0, -1]], axis=0)).max() > 0.3
    for part in ("position", "linear", "angular", "q", "qdot"):
        expected = getattr(recorded, part)[1:]
        np.testing.assert_allclose(
            getattr(flown, part), expected, rtol=0, atol=TOLERANCE, err_msg=part
        )
    turn = Rotation.from_quat(flown.quaternion) * Rotation.from_quat(recorded.quaternion[1:]).inv()
    assert turn.magnitude().max() <= TOLERANCE


def test_a_moved_command_is_noticed() -> None:
    """The comparison has teeth: one newton more in one tick of a second ends a micrometre off."""
    urdf = (Path(__file__).parents[2] / "urdf" / "servicer.urdf").read_text("utf-8")
    names = list(effort_limits(urdf))
    start = Motion(
        np.zeros((1, 3)), np.array([[0.0, 0, 0, 1]]), *np.zeros((2, 1, 3)), *np.zeros((2, 1, 6))
    )
    commands = np.zeros((100, 12))
    ends = []
    for force in (0.0, 1.0):
        commands[0, 0] = force
        replay = Replay(urdf, names)
        replay.place(start)
        ends.append(replay.fly(commands, 10))
    assert np.abs(ends[0].position[-1]).max() == 0.0
    assert np.abs(ends[1].position[-1]).max() > 10 * TOLERANCE
