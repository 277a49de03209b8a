"""Tables of thrusters from URDF and YAML, and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from spacerobot_ros.errors import ParameterError, RobotDescriptionError
from spacerobot_ros.model.thrusters import ThrusterTable, load_thrusters, thrusters_of_urdf
from spacerobot_ros.model.urdf import load_robot, parse_robot

SERVICER = Path(__file__).parents[2] / "urdf" / "servicer.urdf"

URDF = """<robot name="tug">
  <link name="bus"><inertial><mass value="10"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="pod"/>
  <joint name="mount" type="fixed"><parent link="bus"/><child link="pod"/>
    <origin xyz="0 1 0" rpy="0 0 1.5707963267948966"/></joint>
  <link name="arm"><inertial><mass value="1"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="hinge" type="continuous"><parent link="bus"/><child link="arm"/></joint>
  {thrusters}
</robot>"""
GOOD: dict[str, Any] = {
    "name": "a",
    "link": "pod",
    "position": [2.0, 0.0, 0.0],
    "direction": [0.0, 3.0, 0.0],
    "force": 5.0,
    "min_on_time": 0.01,
    "isp": 200.0,
}


def of_yaml(folder: Path, entries: Any, **others: Any) -> ThrusterTable:
    path = folder / "table.yaml"
    path.write_text(yaml.safe_dump({"thrusters": entries, **others}), encoding="utf-8")
    return load_thrusters(path, parse_robot(URDF.format(thrusters="")))


def box() -> list[dict[str, Any]]:
    """A table that gives every wrench: three thrusters at each corner of a cube, inwards."""
    corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    return [
        {
            "name": f"{corner}{axis}".replace(" ", ""),
            "position": list(map(float, corner)),
            "direction": [-float(corner[axis]) if i == axis else 0.0 for i in range(3)],
            "force": 1.0,
            "isp": 200.0,
        }
        for corner in corners
        for axis in range(3)
    ]


def test_a_thruster_on_a_mounted_link_acts_on_the_base(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    element = (
        '<thruster name="a" link="pod"><origin xyz="2 0 0" rpy="0 0 1.5707963267948966"/>'
        '<axis xyz="2 0 0"/><thrust force="5" min_on_time="0.01" isp="200"/></thruster>'
    )
    for table in (
        thrusters_of_urdf(parse_robot(URDF.format(thrusters=element))),
        of_yaml(tmp_path, [GOOD]),
    ):
        # By hand: the pod is 1 m along y of the bus and turned by a quarter about z.
        np.testing.assert_allclose(table.r_B, [[0.0, 3.0, 0.0]], atol=1e-15)
        np.testing.assert_allclose(table.direction_B, [[-1.0, 0.0, 0.0]], atol=1e-15)
        np.testing.assert_allclose(table.wrenches[:, 0], [-5, 0, 0, 0, 0, 15], atol=1e-14)
        assert (table.names, table.min_on_time[0]) == (("a",), 0.01)
        assert table.mass_flow[0] == pytest.approx(5.0 / (9.80665 * 200.0), rel=1e-15)
    assert capfd.readouterr() == ("", "")


def test_defaults_are_what_a_thruster_does_not_say(tmp_path: Path) -> None:
    given = {key: GOOD[key] for key in ("name", "position")}
    table = of_yaml(tmp_path, [given, {**given, "name": "b", "force": 7}], defaults=GOOD)
    assert table.force.tolist() == [5.0, 7.0]
    assert table.isp.tolist() == [200.0, 200.0]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"force": 0.0}, "The force of thruster 'a' is 0.0; it must be a positive number."),
        ({"force": None}, "The force of thruster 'a' is missing; it must be a positive number."),
        ({"isp": float("nan")}, "The isp of thruster 'a' is nan; it must be a positive number."),
        ({"isp": "much"}, "The isp of thruster 'a' is much; it must be a positive number."),
        ({"min_on_time": -1}, "The min_on_time of thruster 'a' is -1; it must be zero or more."),
        ({"direction": [0, 0, 0]}, "The direction of thruster 'a' is zero"),
        ({"position": [1, 2]}, "must be three finite numbers"),
        ({"link": "wing"}, "The link of thruster 'a' is 'wing', but there is no such link."),
        ({"link": "arm"}, "on link 'arm', which joints move"),
        ({"name": ""}, "The name of a thruster is missing."),
        ({"colour": "red"}, "The thruster 'a' has 'colour'; known are"),
    ],
)
def test_refusals_name_the_thruster(change: dict[str, Any], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError) as refusal:
        of_yaml(tmp_path, [{**GOOD, **change}])
    assert sentence in str(refusal.value)
    assert "table.yaml" in str(refusal.value)


def test_a_name_is_used_once(tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match="'a' is used twice"):
        of_yaml(tmp_path, [GOOD, GOOD])


@pytest.mark.parametrize("entries", [[], 3, ["a"], {"a": 1}])
def test_files_without_thrusters_are_refused(entries: Any, tmp_path: Path) -> None:
    with pytest.raises(ParameterError, match=r"table\.yaml"):
        of_yaml(tmp_path, entries)
    with pytest.raises(ParameterError, match="cannot be read"):
        load_thrusters(tmp_path / "none.yaml", load_robot(SERVICER))


def test_a_urdf_without_thrusters_is_refused() -> None:
    with pytest.raises(RobotDescriptionError, match="has no <thruster> elements"):
        thrusters_of_urdf(parse_robot(URDF.format(thrusters="")))
    with pytest.raises(RobotDescriptionError, match="'tug': The position of thruster 'a'"):
        thrusters_of_urdf(parse_robot(URDF.format(thrusters='<thruster name="a"/>')))


def test_an_unknown_thruster_is_named() -> None:
    with pytest.raises(ParameterError, match="There is no thruster 'nose'"):
        thrusters_of_urdf(load_robot(SERVICER)).index("nose")


def test_what_a_table_cannot_give_is_named(tmp_path: Path) -> None:
    full = of_yaml(tmp_path, box())
    assert full.missing() == ""
    # At each corner there is one along each axis: any one may die, but not all that push one way.
    assert full.missing([full.names[0]]) == ""
    pulls = [n for n, d in zip(full.names, full.direction_B, strict=True) if d[1] < 0]
    assert full.missing(pulls) == "negative force along y"
    flat = of_yaml(tmp_path, [entry for entry in box() if entry["direction"][2] == 0.0])
    assert "force along z" in flat.missing()
    assert "torque about z" not in flat.missing()
    assert full.missing(full.names) == "any wrench"


def test_the_servicer_has_redundant_thrusters() -> None:
    table = thrusters_of_urdf(load_robot(SERVICER))
    assert len(table.names) == 24
    assert table.missing() == ""
    assert all(table.missing([name]) == "" for name in table.names[::5])
    # Each sits on a corner of the bus and pushes into it.
    assert np.all(np.abs(table.r_B) == [0.6, 0.5, 0.5])
    assert np.all(np.sum(table.r_B * table.direction_B, axis=1) < 0.0)


def test_what_a_thruster_leaves_open(tmp_path: Path) -> None:
    """It pushes along x, as the axis of a joint does, from the base, in pulses of any length."""
    entry = {"name": "a", "position": [1.0, 2.0, 3.0], "force": 5.0, "isp": 200.0}
    table = of_yaml(tmp_path, [entry, {**entry, "name": "b", "rpy": [0.0, 0.0, np.pi / 2]}])
    np.testing.assert_allclose(table.direction_B, np.eye(3)[:2], atol=1e-15)
    assert table.r_B.tolist() == [[1.0, 2.0, 3.0]] * 2
    assert table.min_on_time.tolist() == [0.0, 0.0]
