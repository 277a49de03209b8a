"""What users' files and earlier flights rely on: parameters, plans of some goals, and reports.

``test/expected`` keeps them; a test compares. Where a change is wanted, ``make expected`` writes
them anew, and the difference shows what has changed for users.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click
import numpy as np
from support.figure_prints import analysis_prints, report_prints
from support.page_prints import CAMPAIGNS
from support.planar_trees import random_tree
from support.viewer_prints import SITUATIONS, viewer_prints

from spacerobot_ros.bag import RecorderConfig, ReplayConfig
from spacerobot_ros.cli.main import main as spacerobot
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.parameters import Parameter, declared
from spacerobot_ros.planning import (
    GaitSchedule,
    Goal,
    PlanRequest,
    RobotState,
    Tolerance,
    method_options,
    plan,
)
from spacerobot_ros.planning.analysis import analyze
from spacerobot_ros.planning.execution.config import PlannerConfig
from spacerobot_ros.planning.methods.registry import RemainingJointsGait
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.topics import TOPICS
from spacerobot_ros.viewer.server import ViewerConfig

FOLDER = Path(__file__).parents[1] / "expected"
PARAMETERS, PLANS = FOLDER / "parameters.json", FOLDER / "plans.json"
REPORTS, CAMPAIGN_PAGES = FOLDER / "reports.json", FOLDER / "campaigns.json"
VIEWER = FOLDER / "viewer.json"
COMMAND_TABLE, TOPIC_TABLE = FOLDER / "commands.json", FOLDER / "topics.json"
BAGS = ("arm_attitude", "planar_chain", "servicer_thrusters", "sliding_masses")
ANALYSED = ("planar_chain", "three_joint_arm")

_CONFIGURATIONS = {
    "plant": PlantConfig,
    "planner": PlannerConfig,
    "coordinated_control": ControllerConfig,
    "recorder": RecorderConfig,
    "replay": ReplayConfig,
    "viewer": ViewerConfig,
}

ARM, SERVICER = (0.0, -0.8, 1.5), (0.0, -1.2, 2.0, 0.0, 0.8, 0.0)

_PLANS: dict[str, dict[str, Any]] = {
    "slide and turn": {
        "robot": "sliding_masses",
        "method": "lie_bracket",
        "position": (0.05, -0.03, 0.02),
        "rotvec": (0.04, -0.02, 0.03),
    },
    "large turn by sliders": {
        "robot": "sliding_masses",
        "method": "lie_bracket",
        "position": (0.1, 0.2, -0.1),
        "rotvec": (0.3, -0.1, 0.2),
        "tolerance": Tolerance(1e-3, 1e-3),
        "n1": 2,
        "t1": 3.0,
        "cycle_period": 1.0,
        "cycles": 0,
    },
    "square": {
        "robot": "planar_chain",
        "method": "square_path",
        "rotvec": (0.0, 0.0, 0.5),
        "start": (0.3, -0.4),
    },
    "two squares and a shape": {
        "robot": "planar_chain",
        "method": "square_path",
        "rotvec": (0.0, 0.0, -2.5),
        "start": (0.9, 0.4),
        "joint_positions": (0.2, 0.7),
    },
    "small square": {
        "robot": "planar_chain",
        "method": "square_path",
        "rotvec": (0.0, 0.0, 1e-3),
        "start": (0.0, 0.0),
        "tolerance": Tolerance(1.0, 1e-5),
    },
    "box": {
        "robot": "three_joint_arm",
        "method": "area_loop",
        "rotvec": (0.1, -0.05, 0.08),
        "start": ARM,
    },
    "cycles ahead and a shape": {
        "robot": "three_joint_arm",
        "method": "area_loop",
        "rotvec": (0.02, -0.05, 0.0),
        "start": (1.0, -0.8, -1.5),
        "joint_positions": (0.2, -0.3, 0.4),
        "cycles_per_plan": 3,
        "k": 0.5,
    },
    "to the shape alone": {
        "robot": "three_joint_arm",
        "method": "area_loop",
        "start": ARM,
        "joint_positions": (0.3, -0.4, 1.0),
        "tolerance": Tolerance(1.0, 0.9, 1e-6),
    },
    "few large loops": {
        "robot": "three_joint_arm",
        "method": "area_loop",
        "rotvec": (0.3, 0.2, -0.1),
        "start": ARM,
        "tolerance": Tolerance(1.0, 0.35),
        "largest_edge": 0.4,
        "nominal": (0.2, -0.9, 1.2),
        "k": 1.0,
    },
    "squares round a centre": {
        "robot": "planar_chain",
        "method": "square_path",
        "rotvec": (0.0, 0.0, 0.8),
        "start": (0.1, -0.2),
        "given_centre": 1,
        "centre_1": 0.4,
        "centre_2": -0.9,
        "t1": 2.0,
        "t2": 5.0,
        "t3": 13.0,
        "t4": 17.0,
    },
    "along lines": {
        "robot": "three_joint_arm",
        "method": "resolved_rate",
        "start": (0.4, -0.9, 1.1),
        "end_effector_position": (1.3, 0.9, 0.8),
        "waypoints": (1.4, 0.8, 1.2),
        "max_velocity": (0.5, 0.3, 0.4),
    },
    "as far as possible": {
        "robot": "planar_manipulator",
        "method": "resolved_rate",
        "start": (0.9, 0.7),
        "end_effector_position": (1.5, 1.5, 0.0),
        "as_far_as_possible": 1,
        "max_velocity": (2.0, 2.0),
        "max_acceleration": (4.0, 3.0),
    },
    "three of six joints": {
        "robot": "servicer",
        "method": "area_loop",
        "rotvec": (0.02, -0.05, 0.01),
        "start": SERVICER,
    },
}


def parameters() -> dict[str, dict[str, Any]]:
    """Return what is declared of every parameter but its description, by node and name."""
    return {
        node: {each.name: _declaration(each) for each in declared(config)}
        for node, config in _CONFIGURATIONS.items()
    }


def plans() -> dict[str, dict[str, Any]]:
    """Return numbers of the plans of some goals by every method but ``optimal``."""
    found = {name: _numbers(plan(**options)) for name, options in _PLANS.items()}
    servicer = SpaceRobot.from_file(robot_file("servicer"))
    stuck = RemainingJointsGait(
        servicer,
        0.05,
        0.01,
        stuck={servicer.joint_names[2]: 1.9, servicer.joint_names[5]: 0.1},
        method="area_loop",
        options={
            "area_loop": method_options(
                "area_loop", {"joints": " ".join(servicer.joint_names[i] for i in (0, 1, 4))}
            )
        },
    )
    shape = np.array(SERVICER)
    shape[[2, 5]] = 1.9, 0.1
    state = RobotState(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), shape)
    goal = Goal.checked([0, 0, 0], [0.01, 0.0, -0.02, 1.0])
    request = PlanRequest(state, goal, Tolerance(1.0, 1e-4))
    found["without two joints"] = _numbers(stuck.plan(request))
    tree = replace(random_tree(np.random.default_rng(3), 4, branched=True), plane=np.eye(3))
    planar = SpaceRobot.from_urdf(tree.urdf)
    for turn in (0.3, -1.2):
        schedule = plan(
            planar, rotvec=(0.0, 0.0, turn), method="square_path", start=(0.2, -0.4, 0.5)
        )
        found[f"planar tree by {turn}"] = _numbers(schedule)
    for robot in ("sliding_masses", "planar_chain", "three_joint_arm", "servicer"):
        result = analyze(SpaceRobot.from_file(robot_file(robot)))
        conditions = result.conditions[np.isfinite(result.conditions)]
        found[f"analysis of {robot}"] = {
            "chosen": result.chosen,
            "shape": result.shape.tolist(),
            "objections": dict(result.objections),
            "ranks": [
                [each.rank, each.required_rank]
                for each in (result.at_shape, result.anywhere, result.planar, result.sliding)
            ],
            "singular_values": result.anywhere.singular_values.tolist(),
            "conditions": [len(conditions), *np.percentile(conditions, [0, 50, 90]).tolist()]
            if conditions.size
            else [],
        }
    return found


def _declaration(parameter: Parameter) -> dict[str, Any]:
    found: dict[str, Any] = {"default": parameter.default}
    if isinstance(parameter.default, tuple):
        found["default"] = list(parameter.default)
    if math.isfinite(parameter.minimum):
        found["minimum"] = parameter.minimum
    if math.isfinite(parameter.maximum):
        found["maximum"] = parameter.maximum
    if parameter.choices:
        found["choices"] = list(parameter.choices)
    if parameter.length is not None:
        found["length"] = parameter.length
    if parameter.unit:
        found["unit"] = parameter.unit
    for flag in ("read_only", "texts", "of_joints"):
        if getattr(parameter, flag):
            found[flag] = True
    return found


def _numbers(schedule: GaitSchedule) -> dict[str, Any]:
    ticks = np.linspace(0, schedule.ticks, 9).round().astype(int)
    path = schedule.path
    return {
        "method": schedule.method,
        "ticks": schedule.ticks,
        "partial": schedule.partial,
        "controls": sorted(schedule.controls),
        "shapes": schedule.positions[ticks].tolist(),
        "fastest": np.abs(schedule.velocities).max(axis=0).tolist(),
        "poses_of_the_path": len(path.time),
        "end": [*path.position[-1].tolist(), *path.quaternion[-1].tolist()],
        "notes": {key: _plain(note) for key, note in schedule.notes.items()},
    }


def _plain(note: Any) -> Any:
    return note if isinstance(note, (str, float)) else [float(x) for x in note]


def command_prints() -> dict[str, Any]:
    """Return every command by its words, with its parameters by name."""
    context = click.Context(spacerobot)
    found: dict[str, Any] = {}
    for name in spacerobot.list_commands(context):
        command = spacerobot.get_command(context, name)
        assert command is not None
        found |= dict(_prints_of(name, command))
    return found


def topic_prints() -> dict[str, Any]:
    """Return every topic by its name, without its texts, in their order."""
    texts = ("meaning", "when")
    return {
        name: {key: value for key, value in asdict(topic).items() if key not in texts}
        for name, topic in TOPICS.items()
    }


def _prints_of(words: str, command: click.Command) -> list[tuple[str, Any]]:
    parameters = {each.name: _parameter(each) for each in command.params if each.name is not None}
    found: list[tuple[str, Any]] = [(words, parameters)]
    if isinstance(command, click.Group):
        for name, part in command.commands.items():
            found += _prints_of(f"{words} {name}", part)
    return found


def _parameter(parameter: click.Parameter) -> dict[str, Any]:
    kind: Any = parameter.type
    found = {
        "names": [*parameter.opts, *parameter.secondary_opts],
        "type": type(kind).__name__,
        "numbers": parameter.nargs,
        "metavar": parameter.metavar,
        "required": parameter.required,
    }
    default = parameter.default
    # Versions of click differ in what stands for no default.
    if isinstance(default, str | bool | int | float | tuple):
        found["default"] = str(default)
    if isinstance(kind, click.Choice):
        found["choices"] = list(kind.choices)
    if isinstance(kind, click.IntRange | click.FloatRange):
        found["range"] = [str(kind.min), str(kind.max), kind.min_open, kind.max_open]
    if isinstance(parameter, click.Option):
        found |= {"multiple": parameter.multiple, "flag": parameter.is_flag}
        if isinstance(parameter.flag_value, str | int | float):
            found["flag_value"] = str(parameter.flag_value)
    return found


def differences(found: Any, kept: Any, where: str = "") -> list[str]:
    """Return where two trees of values differ; numbers may by rounding."""
    if isinstance(kept, dict) and isinstance(found, dict):
        lines = [
            f"{where}/{key}: {'gone' if key in kept else 'new'}" for key in found.keys() ^ kept
        ]
        for key in found.keys() & kept.keys():
            lines += differences(found[key], kept[key], f"{where}/{key}")
        return sorted(lines)
    if isinstance(kept, list) and isinstance(found, list) and len(kept) == len(found):
        return [
            line
            for i, (a, b) in enumerate(zip(found, kept, strict=True))
            for line in differences(a, b, f"{where}/{i}")
        ]
    if isinstance(kept, float) and isinstance(found, (int, float)):
        close = abs(found - kept) <= 1e-6 * abs(kept) + 1e-7
        return [] if close else [f"{where}: {found}, not {kept}"]
    return [] if found == kept else [f"{where}: {found!r}, not {kept!r}"]


def main() -> None:
    """Write the files."""
    reports = {name: report_prints(name) for name in BAGS}
    reports |= {f"analysis of {name}": analysis_prints(name) for name in ANALYSED}
    pages = {name: print_of() for name, print_of in CAMPAIGNS.items()}
    for path, content in (
        (COMMAND_TABLE, command_prints()),
        (TOPIC_TABLE, topic_prints()),
        (PARAMETERS, parameters()),
        (PLANS, plans()),
        (REPORTS, reports),
        (CAMPAIGN_PAGES, pages),
        (VIEWER, {name: viewer_prints(name) for name in SITUATIONS}),
    ):
        path.write_text(json.dumps(content, indent=1) + "\n", "utf-8")
        print(path)


if __name__ == "__main__":
    main()
