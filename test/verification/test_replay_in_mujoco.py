"""Recorded commands, replayed open loop in another engine, lead to the recorded states."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from support.slow import some_fast

from spacerobot_ros.bag import Bag, read_bag
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.session.run import run_scenario

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
