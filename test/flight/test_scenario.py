"""Scenarios: their parameters are those that the nodes declare, and are read the same way."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from support.sentences import assert_one_sentence

from spacerobot_ros import fly
from spacerobot_ros.errors import GoalError, ParameterError, PlanningError
from spacerobot_ros.flight.lockstep import fly_scenario
from spacerobot_ros.flight.trials import PlanningProblem
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.nodes import NODE_TYPES
from spacerobot_ros.planning import Goal
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.resources import robot_file, share_directory
from spacerobot_ros.scenario import (
    CONFIGS,
    Kill,
    Scenario,
    different_parameters,
    load_scenario,
    scenario_names,
    scenario_of,
    scenario_or_robot,
    scenario_text,
)
from spacerobot_ros.scenario_files import (
    NODES,
    number_in,
    parse_kills,
    parse_setting,
    read_sections,
)


def test_the_configurations_are_those_of_the_nodes() -> None:
    assert {name: kind.Config for name, kind in NODE_TYPES.items()} == CONFIGS


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_of_the_package_is_declared(name: str) -> None:
    scenario = load_scenario(name)
    for node in NODES:
        scenario.config(node)
    assert scenario.lockstep, "unless it is asked to run in real time"
    assert not scenario.in_real_time(2.0).lockstep


def test_groups_and_numbers_without_a_dot_are_read_as_ros_reads_them(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        """
scenario: {ros__parameters: {}}
plant: {ros__parameters: {robot: planar_chain, tick_rate: 1e1, autostart: true}}
planner: {ros__parameters: {lie_bracket: {t1: 5}, world_frame: "1e1"}}
"""
    )
    scenario = load_scenario(str(path))
    assert scenario.plant.tick_rate == 10.0
    assert scenario.planner.options["lie_bracket"].t1 == 5.0
    assert scenario.planner.world_frame == "1e1"
    changed = scenario.with_settings(["planner.lie_bracket.t1=7"])
    assert changed.planner.options["lie_bracket"].t1 == 7.0
    # Likewise of a scenario whose configurations nobody has looked at.
    unread = load_scenario(str(path)).with_settings(["planner.lie_bracket.t1=7"])
    assert unread.planner.options["lie_bracket"].t1 == 7.0


def test_the_hand_that_the_controller_names_is_judged_by_the_plant(tmp_path: Path) -> None:
    """The servicer flies alike if its end-effector has another name, which one section gives."""
    named = robot_file("servicer").read_text("utf-8")
    (tmp_path / "servicer.urdf").write_text(named.replace("end_effector", "tool_tip"))
    path = tmp_path / "mine.yaml"
    packaged = load_scenario("servicer")
    text = packaged.path.read_text("utf-8").replace("robot: servicer", "robot: servicer.urdf")
    path.write_text(text)
    unnamed = load_scenario(str(path))
    scenario = unnamed.with_settings(["coordinated_control.end_effector_frame=tool_tip"])
    path.write_text(text.replace("law:", "end_effector_frame: tool_tip\n    law:"))
    assert unnamed.plant.end_effector_frame == ""
    for each in (scenario, load_scenario(str(path))):
        assert each.plant.end_effector_frame == "tool_tip"
        assert each.parameters("plant")["end_effector_frame"] == "tool_tip"
    other = scenario.with_settings(["plant.end_effector_frame=wrist_roll_link"])
    assert other.parameters("plant")["end_effector_frame"] == "wrist_roll_link"
    found, wanted = (fly_scenario(each).summary() for each in (scenario, packaged))
    assert 0 < found["end_effector_position_error_m"] < 5e-4
    for key in ("end_effector_position_error_m", "end_effector_attitude_error_rad", "verdict"):
        assert found[key] == wanted[key]


def test_overrides_go_before_the_file_and_have_the_declared_types() -> None:
    scenario = load_scenario("sliding_masses").with_settings(
        ["plant.tick_rate=10", "plant.initial_position=[1, 2.5, 0]"]
    )
    assert scenario.parameters("plant") == {
        "robot": "sliding_masses",
        "actuation": "velocity",
        "base_pose_period": 1.0,
        "marker_period": 10.0,
        "tf_period": 1.0,
        "diagnostics_period": 20.0,
        "time_mode": "lockstep",
        "tick_rate": 10.0,
        "initial_position": (1.0, 2.5, 0.0),
    }
    with pytest.raises(ParameterError, match=r"'plant' has no parameter 'tick_rte'.*'tick_rate'"):
        scenario.with_settings(["plant.tick_rte=10"]).parameters("plant")


def test_overrides_of_a_scenario_that_is_known_are_those_of_a_new_one() -> None:
    """What was checked before is not checked again, and what is replaced does not stay."""
    steps: list[tuple[str, dict[str, Any]]] = [
        ("plant", {"sensors.seed": 4, "initial_position": [1, 2, 3]}),
        ("planner", {"optimal.starts": 3, "resume_file": "x"}),
        ("plant", {"sensors.seed": 5}),
        ("plant", {"tick_rate": "40"}),
    ]
    for look_between in (False, True):
        fresh = scenario = load_scenario("sliding_masses")
        before = scenario.plant, scenario.planner
        for node, values in steps:
            fresh = replace(fresh.with_overrides(node, values))  # Knows nothing.
            scenario = scenario.with_overrides(node, values)
            if look_between:
                assert scenario.config(node) == fresh.config(node)
        assert scenario.plant == fresh.plant
        assert scenario.planner == fresh.planner
        assert scenario.plant.sensors.seed == 5
        assert scenario.plant.tick_rate == 40.0
        assert (load_scenario("sliding_masses").plant, scenario.plant.faults) == (before[0], ())
        for bad, words in (
            ({"sensors.sed": 1}, "no parameter"),
            ({"tick_rate": -1}, "'plant': .*'tick_rate' is -1"),
        ):
            with pytest.raises(ParameterError, match=words):
                _ = scenario.with_overrides("plant", bad).plant


def test_another_goal_has_no_published_figures() -> None:
    scenario = load_scenario("sliding_masses")
    assert scenario.published
    assert scenario.with_goal() is scenario
    other = scenario.with_goal(rotvec=(0.0, 0.0, 0.1))
    assert not other.published
    assert other.goal.position.tolist() == scenario.goal.position.tolist()


def test_a_bag_holds_published_figures_of_the_method_that_is_flown_only() -> None:
    scenario = load_scenario("sliding_masses")
    papers_own = scenario.with_overrides("planner", {"method": "lie_bracket"})
    assert json.loads(scenario.records(["plant"])["scenario"]["published"]) == []
    kept = json.loads(papers_own.records(["plant"])["scenario"]["published"])
    assert [row["quantity"] for row in kept][:3] == ["zf", "c", "alpha"]
    assert kept[1] == {"quantity": "c", "printed": [-0.0476, 0.0337, -0.0275], "note": ""}
    other = papers_own.with_goal(pose=(0.0, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0))
    assert json.loads(other.records(["plant"])["scenario"]["published"]) == []


def test_another_pose_keeps_the_shape_that_is_wanted() -> None:
    scenario = load_scenario("planar_chain")
    shape = scenario.goal.joint_positions
    assert shape is not None
    for words in ({"pose": (0.0, 0.1, 0.2, 0.0, 0.0, 0.0, 1.0)}, {"rotvec": (0.0, 0.0, 0.1)}):
        kept = scenario.with_goal(**words).goal.joint_positions
        assert kept is not None
        assert kept.tolist() == shape.tolist()


def test_kills_are_read_in_order_of_time() -> None:
    lines = ["plant  at 20", "planner at 0 until 7", "coordinated_control at 6"]
    assert parse_kills(lines, "a test") == (
        Kill("planner", 0.0, 7.0),
        Kill("coordinated_control", 6.0, math.inf),
        Kill("plant", 20.0, math.inf),
    )


@pytest.mark.parametrize("prefix", ["", "/", "/**/", "/robot_1/", "/*/"])
def test_sections_are_found_whatever_namespace_they_are_for(tmp_path: Path, prefix: str) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text(
        f"""
scenario: {{ros__parameters: {{}}}}
/**: {{ros__parameters: {{robot: planar_chain, tick_rate: 5.0, method: square_path}}}}
{prefix}plant: {{ros__parameters: {{tick_rate: 10.0, sensors: {{seed: 7}}}}}}
{prefix}coordinated_control: {{ros__parameters: {{robot: servicer}}}}
""",
        encoding="utf-8",
    )
    scenario = load_scenario(str(path))
    assert scenario.commanders == ("coordinated_control",)
    assert scenario.plant.tick_rate == 10.0
    assert scenario.plant.sensors.seed == 7
    assert scenario.plant.robot == "planar_chain"
    assert scenario.controller.robot == "servicer"
    assert scenario.controller.tick_rate == 5.0


@pytest.mark.parametrize("name", scenario_names())
def test_nodes_of_any_namespace_take_the_parameters_of_a_file(name: str) -> None:
    content = yaml.safe_load((share_directory() / "config" / f"{name}.yaml").read_text("utf-8"))
    assert {key for key in content if key != "scenario"} <= {f"/**/{node}" for node in CONFIGS}


def test_a_robot_beside_its_scenario_is_found_and_integers_go_with_floats(tmp_path: Path) -> None:
    (tmp_path / "mine.urdf").write_text(robot_file("planar_chain").read_text("utf-8"), "utf-8")
    file = tmp_path / "mine.yaml"
    file.write_text(
        "scenario: {ros__parameters: {goal_rotvec: [0, 0, 0.1]}}\n"
        "plant: {ros__parameters: {robot: mine.urdf, initial_joint_positions: [0, 0.5]}}\n",
        "utf-8",
    )
    scenario = load_scenario(str(file))
    assert PlanningProblem.of(scenario).robot.n == 2
    assert scenario.goal.position.tolist() == [0.0, 0.0, 0.0], "unless it is given"
    given = scenario.parameters("plant")
    assert given["robot"] == str(tmp_path / "mine.urdf")
    assert given["initial_joint_positions"] == (0.0, 0.5)


def test_files_beside_a_scenario_come_before_those_of_the_present_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, here = tmp_path / "mine", tmp_path / "here"
    for each in (folder, here):
        each.mkdir()
        for name in ("pairs.srdf", "jets.yaml"):
            (each / name).touch()
    monkeypatch.chdir(here)
    file = folder / "mine.yaml"
    file.write_text(
        "scenario: {ros__parameters: {goal_rotvec: [0, 0, 0.1]}}\n"
        "plant: {ros__parameters: {robot: planar_chain, thrusters: jets.yaml}}\n"
        "planner: {ros__parameters: {robot: planar_chain, srdf: pairs.srdf}}\n",
        "utf-8",
    )
    scenario = load_scenario(str(file))
    assert scenario.parameters("plant")["thrusters"] == str(folder / "jets.yaml")
    assert scenario.parameters("planner")["srdf"] == str(folder / "pairs.srdf")


def test_a_robot_alone_is_a_scenario_without_a_goal(tmp_path: Path) -> None:
    alone = scenario_or_robot("three_joint_arm")
    with pytest.raises(ParameterError) as refused:
        alone.require_goal()
    assert str(refused.value) == (
        "'three_joint_arm' has no goal: give one, for instance --goal-rpy-deg 0 0 10, or "
        "write a scenario with a goal (`spacerobot new` writes one for a robot)."
    )
    assert not written(tmp_path, text_of("description: Without a goal")).has_goal
    there = alone.with_goal(rpy_deg=(0.0, 0.0, 90.0))
    there.require_goal()
    half = np.sqrt(0.5)
    assert there.goal.quaternion == pytest.approx([0.0, 0.0, half, half])
    assert there.commanders == ("planner",)


def test_a_robot_alone_without_joints_is_flown_by_its_thrusters(tmp_path: Path) -> None:
    box = tmp_path / "box.urdf"
    inertia = '<inertia ixx="0.2" iyy="0.25" izz="0.3" ixy="0" ixz="0" iyz="0"/>'
    body = f'<link name="box"><inertial><mass value="16"/>{inertia}</inertial></link>'
    box.write_text(f'<robot name="box">{body}</robot>', "utf-8")
    goal = [0.2, -0.1, 0.05]
    flight = fly(box, position=goal, rotvec=[0.0, 0.1, 0.2])
    assert flight.scenario.commanders == ("coordinated_control",)
    np.testing.assert_allclose(flight.pose[-1, :3], goal, atol=1e-3)
    with pytest.raises(PlanningError, match="no joints"):
        fly(box, position=goal, method="auto")


def test_degrees_are_roll_pitch_and_yaw_about_fixed_axes() -> None:
    """Against scipy's rotations, lower case: about the axes of the world, x first."""
    angles = (30.0, -50.0, 100.0)
    goal = load_scenario("arm_attitude").with_goal(rpy_deg=angles).goal
    expected = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    assert np.allclose(Rotation.from_quat(goal.quaternion).as_matrix(), expected, atol=1e-14)


def test_parameters_that_differ_between_scenarios() -> None:
    first = load_scenario("sliding_masses")
    second = first.with_overrides("planner", {"position_tolerance": 0.125, "max_corrections": 7})
    second = second.with_overrides("plant", {"sensors.position_bias": [0.25, 0, 1e-3]})
    third = second.with_overrides("plant", {"robot_description": "<robot/>"})
    base = str(first.parameters("planner")["position_tolerance"])
    assert different_parameters([first, second, third]) == [
        ("planner.position_tolerance (m)", base, "0.125", "0.125"),
        ("planner.max_corrections", "3", "7", "7"),
        ("plant.sensors.position_bias (m)", "–", "0.25, 0, 0.001", "0.25, 0, 0.001"),
    ]
    assert different_parameters([first, first]) == []
    # What one alone gives, as its default, is no difference.
    usual = first.with_overrides("plant", {"orbit.altitude": 0, "sensors.position_bias": [0, 0, 0]})
    assert different_parameters([first, usual]) == []


# -- files, settings and what is refused ---------------------------------------------------------


def text_of(*goal: str, **nodes: Any) -> str:
    """Return a scenario file of lines of its goal and parameters by node."""
    plant = {"robot": "sliding_masses", **nodes.pop("plant", {})}
    content = {"plant": {"ros__parameters": plant}, **nodes}
    lines = "".join(f"    {line}\n" for line in goal or ("goal_position: [1, 2, 3]",))
    return f"scenario:\n  ros__parameters:\n{lines}{yaml.safe_dump(content)}"


def written(folder: Path, text: str) -> Scenario:
    path = folder / "own.yaml"
    path.write_text(text)
    return load_scenario(str(path))


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        ("planner at 1", "'kills' in here is 'planner at 1', not a list of lines NODE at SECONDS."),
        *(
            ([line], f"The kill in here '{line}' is refused: {reason}.")
            for line, reason in {
                "planner": "it must be NODE at SECONDS [until SECONDS]",
                "planner until 5": "it must be NODE at SECONDS [until SECONDS]",
                "recorder at 5": "its node is one of plant, planner, coordinated_control",
                "viewer at 1": "its node is one of plant, planner, coordinated_control",
                "plant at x": "'x' is not a finite number",
                "plant at inf": "'inf' is not a finite number",
                "plant at nan": "'nan' is not a finite number",
                "plant at -1": "its time is -1 s but must be from 0 to 1e+09 s",
                "plant at 2 until 2": "it ends at 2 s but begins at 2 s",
                "plant at 2 until 1": "it ends at 1 s but begins at 2 s",
            }.items()
        ),
    ],
)
def test_kills_that_are_refused(lines: Any, sentence: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_kills(lines, "here")
    assert str(refused.value) == sentence


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("plant.tick_rate=1e-3", ("plant", "tick_rate", 1e-3)),
        (" planner.method =optimal", ("planner", "method", "optimal")),
        ("plant.a.b=[1, 2]", ("plant", "a.b", [1, 2])),
        ("plant.a=b=c", ("plant", "a", "b=c")),
        ("plant.autostart=false", ("plant", "autostart", False)),
    ],
)
def test_settings(text: str, found: tuple[str, str, Any]) -> None:
    assert parse_setting(text) == found


@pytest.mark.parametrize("text", ["plant.a", "plant=1", "nobody.a=1", "plant.=1", "=1"])
def test_settings_that_are_none(text: str) -> None:
    with pytest.raises(ParameterError) as refused:
        parse_setting(text)
    assert str(refused.value) == (
        f"'{text}' is not node.parameter=value with one of the nodes plant, planner, "
        "coordinated_control, recorder, viewer."
    )
    with pytest.raises(ParameterError) as refused:
        parse_setting("plant.a=[")
    assert str(refused.value) == "The value in 'plant.a=[' cannot be read."
    assert (number_in("1e3"), number_in("a")) == (1000.0, "a")


def test_files_without_sections(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "a.yaml"
    for under in ("[1]", "{ros__parameters: 3}", "{ros__parameters: null}"):
        path.write_text(f"plant: {under}")
        with pytest.raises(ParameterError) as refused:
            read_sections(path)
        assert str(refused.value) == (
            f"The section 'plant' of the scenario file {path} is not 'ros__parameters:' with "
            "parameters under it."
        )
    path.write_text("[1]")
    assert read_sections(path) == {}
    path.write_text("camera: {}\n/**/recoder: {ros__parameters: {compression: zstd}}\nszenario: {}")
    assert read_sections(path) == {}
    every = "{camera_gain: 2.0, law: model_based, tick_rte: 50.0, use_sim_time: true}"
    path.write_text(f"/**: {{ros__parameters: {every}}}\nplant: {{}}")
    assert read_sections(path) == {"plant": {}}
    said, other, again = caplog.messages
    assert said.endswith(" Did you mean 'recorder'?")
    assert other.endswith(" Did you mean 'scenario'?")
    assert_one_sentence(again, "'tick_rte'", "Did you mean 'tick_rate'?")
    with pytest.raises(ParameterError, match="cannot be read"):
        read_sections(tmp_path / "none.yaml")


@pytest.mark.parametrize(
    ("goal", "sentence"),
    [
        (("goal_positon: [1, 2, 3]",), "has an unknown key 'goal_positon' in its scenario section"),
        (("goal_position: [1, 2]",), "The goal in the scenario file"),
        (("goal_rotvec: [1, 2]",), "The goal in the scenario file"),
        (("goal_rotvec: [0, 0, 1]", "goal_orientation: [0, 0, 0, 1]"), "both given: remove one."),
        (("goal_rotvec: [0, 0, 1]", "goal_rotvec: [0, 0, 2]"), "'goal_rotvec' appears twice"),
        (
            ("published: {a: 3}",),
            "The section 'published' in the scenario file FILE is not quantity: {printed: "
            "[numbers], note: text}: ",
        ),
        (("kills: 3",), "'kills' in the file FILE is 3, not a list of lines NODE at SECONDS."),
        (("world: none.urdf",), "The world in the scenario file FILE is invalid: "),
        ((), "The scenario file FILE has no 'scenario: ros__parameters:' section with a goal."),
    ],
)
def test_scenarios_that_are_refused(goal: tuple[str, ...], sentence: str, tmp_path: Path) -> None:
    with pytest.raises(ParameterError) as refused:
        written(tmp_path, text_of(*goal) if goal else "plant: {ros__parameters: {}}")
    assert sentence.replace("FILE", str(tmp_path / "own.yaml")) in str(refused.value)


def test_a_scenario_is_read_and_written(tmp_path: Path) -> None:
    found = written(
        tmp_path,
        text_of(
            *("description: It is", "goal_position: [1, 2, 3]", "goal_rotvec: [0, 0, 0.5]"),
            *("goal_joint_positions: [0.1, 0.2, 0.3]", "published_method: optimal"),
            *("published: {a: {printed: [1, 2.5], note: so}, b: {printed: [3]}}",),
            planner={"ros__parameters": {"method": "lie_bracket"}},
        ),
    )
    assert (found.name, found.description, found.commanders) == ("own", "It is", ("planner",))
    assert found.path == (tmp_path / "own.yaml").resolve()
    assert found.goal.position.tolist() == [1.0, 2.0, 3.0]
    assert found.goal.quaternion == pytest.approx([0, 0, math.sin(0.25), math.cos(0.25)])
    assert found.goal.joint_positions is not None
    first, second = found.published
    assert (first.quantity, first.printed, first.note) == ("a", [1.0, 2.5], "so")
    assert (second.quantity, second.printed, second.note) == ("b", [3.0], "")
    assert found.comparable == ()
    assert found.with_method("optimal").comparable == found.published
    assert replace(found, published_method="").comparable == found.published
    assert (found.end_effector_goal, found.kills, found.has_goal) == (None, (), True)
    text = scenario_text(found.with_overrides("planner", {"averaging": 3}))
    content = yaml.safe_load(text)
    assert list(content) == ["scenario", "/**/plant", "/**/planner"]
    about = content["scenario"]["ros__parameters"]
    assert about["description"] == "It is"
    assert about["goal_position"] == [1.0, 2.0, 3.0]
    assert about["goal_joint_positions"] == [0.1, 0.2, 0.3]
    planner = content["/**/planner"]["ros__parameters"]
    assert planner == {"method": "lie_bracket", "averaging": 3}
    recorded = scenario_text(found.with_overrides("recorder", {"tf_period": 0.5}))
    assert list(yaml.safe_load(recorded)) == [
        *("scenario", "/**/plant", "/**/planner", "/**/recorder")
    ]
    again = written(tmp_path, text)
    assert again.goal.joint_positions is not None
    assert again.planner.averaging == 3


def test_what_a_scenario_needs_is_said(tmp_path: Path) -> None:
    found = written(tmp_path, text_of(planner={"ros__parameters": {}}))
    with pytest.raises(ParameterError) as refused:
        found.with_method("transposed_jacobian")
    assert str(refused.value) == (
        "'transposed_jacobian' is a control law, and the scenario 'own' has no section "
        "'coordinated_control' that could use it: this scenario flies with planner."
    )
    with pytest.raises(ParameterError) as unused:
        found.with_settings(["coordinated_control.law=model_based"])
    assert str(unused.value) == (
        "'coordinated_control.law=model_based' is for the node 'coordinated_control', which is "
        "not running: the scenario 'own' flies with planner."
    )
    with pytest.raises(GoalError) as twice:
        found.with_goal(None, (0.0, 0.0, 1.0), (0.0, 0.0, 1.0))
    assert str(twice.value) == "The goal attitude is given twice, in radians and in degrees."
    assert found.with_goal() is found
    bare = written(tmp_path, text_of(plant={"robot": ""}, planner={"ros__parameters": {}}))
    with pytest.raises(ParameterError) as refused:
        PlanningProblem.of(bare)
    assert str(refused.value) == "The scenario 'own' has no robot; see plant.robot."


def test_a_scenario_of_a_robot_flies_that_robot() -> None:
    description = SpaceRobot.from_file(robot_file("sliding_masses")).description
    found = scenario_of(description)
    assert (found.name, found.has_goal, found.path) == (description.name, False, Path())
    assert found.plant.robot_description == found.planner.robot_description == description.urdf
    shape = Goal.checked([0, 0, 0], [0, 0, 0, 1], [0.0])
    with pytest.raises(GoalError) as refused:
        replace(found, goal=shape).require_shape_of(SpaceRobot(description))
    assert str(refused.value) == (
        f"The goal has 1 joint position; robot '{description.name}' has 3 joints."
    )


def test_parameters_of_a_scenario_have_their_types(tmp_path: Path) -> None:
    found = written(
        tmp_path,
        text_of(
            planner={"ros__parameters": {"averaging": "3", "use_sim_time": 1, "method": "auto"}}
        ),
    )
    assert found.parameters("planner") == {"averaging": 3, "method": "auto", "use_sim_time": True}
    assert found.planner.averaging == 3
    assert found.lockstep
    fast = found.in_real_time(0.25)
    assert (fast.plant.time_mode, fast.plant.real_time_factor) == ("realtime", 0.25)
    assert fast.planner.plan_in_background
    recorder = fast.config("recorder")
    assert recorder.diagnostics_period == 1.0
    assert recorder.tf_period == pytest.approx(min(found.config("recorder").tf_period, 0.025))
    silent = found.with_overrides("recorder", {"tf_period": 0.0}).in_real_time(2.0)
    assert silent.config("recorder").tf_period == 0.0
    assert not fast.lockstep
    assert isinstance(fast.planner, PlannerConfig)
