"""Which outputs a robot gets, and which are refused."""

from __future__ import annotations

import numpy as np
import pytest
from control.flights import END_EFFECTOR, load
from support.random_robots import random_chain_urdf

from spacerobot_ros.control import OutputSelection, default_selection, plane_normal
from spacerobot_ros.control.outputs import AXES
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import RobotDescription, parse_robot

BODY = '<link name="{name}"><inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" '
BODY += 'ixy="0" ixz="0" iyz="0"/></inertial></link>'


def chain(*joints: tuple[str, str], rpy: str = "0 0 0") -> RobotDescription:
    """Return a chain of (type, axis); the first joint's frame is turned by ``rpy``."""
    parts = [BODY.format(name="base_link")]
    for k, (kind, axis) in enumerate(joints, start=1):
        parent = "base_link" if k == 1 else f"link_{k - 1}"
        parts.append(BODY.format(name=f"link_{k}"))
        parts.append(
            f'<joint name="joint_{k}" type="{kind}"><parent link="{parent}"/>'
            f'<child link="link_{k}"/><origin xyz="1 0 0" rpy="{rpy if k == 1 else "0 0 0"}"/>'
            f'<axis xyz="{axis}"/><limit lower="-1" upper="1" velocity="1" effort="1"/></joint>'
        )
    return parse_robot(f'<robot name="chain">{"".join(parts)}</robot>')


R, P, C = "revolute", "prismatic", "continuous"


@pytest.mark.parametrize(
    ("description", "normal"),
    [
        (load("planar_manipulator").description, [0, 0, 1]),
        (load("planar_chain").description, [0, 0, 1]),
        (load("servicer").description, None),
        (load("sliding_masses").description, None),
        (load("three_joint_arm").description, None),
        (chain((R, "0 0 1"), (C, "0 0 -2"), (P, "3 4 0")), [0, 0, 1]),
        (chain((P, "1 0 0"), (R, "0 1 0")), [0, 1, 0]),
        (chain((R, "0 0 1"), (P, "0 0 1")), None),
        (chain((P, "1 0 0"), (P, "0 1 0")), None),
        (chain((R, "0 0 1"), (R, "0 0 1"), rpy="1.5707963267948966 0 0"), [0, -1, 0]),
        (chain((R, "0 0 1"), (R, "0 0 1"), rpy="0.3 0 0"), [0, -np.sin(0.3), np.cos(0.3)]),
    ],
)
def test_plane_of_a_robot(description: RobotDescription, normal: list[float] | None) -> None:
    found = plane_normal(description)
    if normal is None:
        assert found is None
    else:
        assert found is not None
        np.testing.assert_allclose(found, normal, atol=1e-12)


def test_default_outputs() -> None:
    planar = OutputSelection(("x", "y", "rz"), ("x", "y"), (), END_EFFECTOR)
    assert default_selection(load("planar_manipulator").description, END_EFFECTOR) == planar
    spatial = OutputSelection(AXES, AXES, (), END_EFFECTOR)
    assert default_selection(load("servicer").description, END_EFFECTOR) == spatial
    # No end-effector: base and joints.
    pins = OutputSelection(("x", "y", "rz"), joints=("pin_1", "pin_2"))
    assert default_selection(load("planar_chain").description, "") == pins
    # Three joints: the position of the end-effector only.
    arm = load("three_joint_arm").description
    tip = arm.links[-1].name
    assert default_selection(arm, tip) == OutputSelection(AXES, ("x", "y", "z"), (), tip)
    # A plane of the base's x and z; and one along none of its axes, with too few joints for space.
    tilted = chain((R, "0 1 0"), (R, "0 1 0"))
    assert default_selection(tilted, "link_2") == OutputSelection(
        ("x", "z", "ry"), ("x", "z"), (), "link_2"
    )
    askew = chain((R, "0 0 1"), (R, "0 0 1"), rpy="0.3 0 0")
    assert default_selection(askew, "link_2") == OutputSelection(AXES, joints=askew.joint_names)
    # One joint.
    single = chain((R, "0 0 1"))
    assert default_selection(single, "link_1") == OutputSelection(
        ("x", "y", "rz"), joints=("joint_1",)
    )


@pytest.mark.parametrize("joints", range(1, 9))
def test_default_outputs_never_exceed_the_degrees_of_freedom(joints: int) -> None:
    description = parse_robot(random_chain_urdf(np.random.default_rng(joints), joints))
    for link in ("", f"link_{joints}"):
        selection = default_selection(description, link)
        selection.require_valid(description)
        assert len(selection.labels) <= 6 + joints


@pytest.mark.parametrize(
    ("selection", "sentence"),
    [
        (OutputSelection(), "No output"),
        (OutputSelection(base=("x", "u")), "no axis of the base 'u'"),
        (OutputSelection(base=("x", "x")), "'x' is named twice"),
        (OutputSelection(end_effector=("x",)), "no end-effector link ''"),
        (OutputSelection(end_effector=("x",), end_effector_link="hand"), "link 'hand'"),
        (OutputSelection(joints=("knee",)), "no joint 'knee'; there are: shoulder, elbow"),
        (OutputSelection(AXES, AXES, (), END_EFFECTOR), "12 outputs .* 8 degrees"),
    ],
)
def test_selections_that_are_refused(selection: OutputSelection, sentence: str) -> None:
    with pytest.raises(ParameterError, match=sentence):
        selection.require_valid(load("planar_manipulator").description)


def test_unknown_end_effector_is_refused() -> None:
    with pytest.raises(ParameterError, match="no end-effector link 'hand'"):
        default_selection(load("servicer").description, "hand")
