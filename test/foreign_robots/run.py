"""Plan many random goals for robots that are in none of the papers, and count what becomes of them.

`make foreign-robots` runs it. Every plan is integrated again by Pinocchio, from the conservation of
momentum, and its end compared with the goal. What is done is kept in ``out/foreign_robots``, goal
by goal: a run that was ended goes on where it was. The table of the documents is written from it.
"""

from __future__ import annotations

import argparse
import json
import resource
import statistics
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from support.hand_motion import attitude_after
from support.oracles import PinocchioOracle
from support.planners import Planner

from spacerobot_ros.errors import NotFoundError, PlanningError, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.model.integration import DEFAULT_INTEGRATION_STEP
from spacerobot_ros.planning import (
    GaitMethod,
    GaitSchedule,
    Goal,
    RobotState,
    Tolerance,
    build_method,
    method_options,
)
from spacerobot_ros.resources import robot_file

PROJECT = Path(__file__).parents[2]
KEPT = PROJECT / "out" / "foreign_robots"
TABLE = PROJECT / "docs" / "foreign_robots.json"

ROBOTS = {
    "free_flyer": "a cabin free-flyer with an arm and a gripper",
    "solar_booms": "a satellite with six solar booms",
    "seven_joint_arm": "an arm of seven joints on a small satellite",
    "station_arm": "a manipulator of a space station on a platform",
    "quadruped": "a robot dog in the air",
    "dual_arm": "a servicing satellite with two arms",
}

OUT_OF_REACH = "out of reach by a long search"

PERIOD = 0.05
TOLERANCE = Tolerance(1e-3, 1e-3, 1e-3)

_STRAIGHT = 0.1
"""Longest straight piece of the path of the shape that is integrated in one go, rad or m."""


@dataclass(frozen=True)
class Task:
    """A goal, where it is reached from, and what is asked of the base.

    ``kind`` is ``attitude``, ``shape`` (and attitude) or ``position`` (and attitude); ``size`` is
    the angle to turn by, rad.
    """

    number: int
    kind: str
    size: float
    state: RobotState
    goal: Goal


@dataclass(frozen=True)
class Outcome:
    """What became of a goal.

    ``result`` is ``met``, ``missed`` (by the second integration), or the class of the refusal.
    ``beyond`` is how far a position that was not found lies from the nearest one of a long search
    for shapes, m; -1: there was none.
    """

    number: int
    kind: str
    size: float
    result: str
    method: str = ""
    duration: float = 0.0
    cpu: float = 0.0
    error: float = -1.0
    sentence: str = ""
    beyond: float = -1.0


def tasks(robot: SpaceRobot, count: int) -> Iterator[Task]:
    """Return goals of three kinds in turn, small and large, always the same ones.

    Positions are those that the base has in a random shape, some of them put farther away: up to
    some of these are out of reach. One shape in ten is beyond the joint limits.
    """
    lower, upper = robot.description.shape_box
    for number in range(count):
        rng = np.random.default_rng([2026, number])
        start = lower + (upper - lower) * rng.uniform(0.1, 0.9, robot.n)
        final = lower + (upper - lower) * rng.uniform(0.1, 0.9, robot.n)
        attitude = Rotation.random(random_state=rng)
        kind = ("attitude", "shape", "position")[number % 3]
        size = float(np.exp(rng.uniform(np.log(0.02), np.log(3.1))))
        axis = rng.normal(size=3)
        turned = attitude * Rotation.from_rotvec(size * axis / np.linalg.norm(axis))
        state = RobotState(np.zeros(3), attitude.as_quat(), start)
        goal = Goal.checked(np.zeros(3), turned.as_quat())
        if kind == "shape":
            # Small turns go with small changes of the shape.
            final = start + (final - start) * min(1.0, size)
            if rng.uniform() < 0.1:
                joint = int(rng.integers(robot.n))
                final[joint] = robot.upper[joint] + rng.uniform(0.01, 1.0)
            goal = replace(goal, joint_positions=final)
        elif kind == "position":
            final = start + (final - start) * min(1.0, size)
            moved = attitude.apply(robot.center_of_mass(start)) - turned.apply(
                robot.center_of_mass(final)
            )
            if rng.uniform() < 0.3:
                moved = moved * rng.uniform(1.0, 6.0)
            goal = replace(goal, position=moved)
        yield Task(number, kind, size, state, goal)


def out_of_reach(robot: SpaceRobot, task: Task, starts: int = 100) -> float:
    """Return how far the position of a goal is from the nearest one that any shape brings, m.

    Without thrust the centre of mass stays. The shapes are those to which a minimisation comes from
    many random ones, which knows nothing of the planner's own search.
    """
    from scipy.optimize import minimize

    turned, state = Rotation.from_quat(task.goal.quaternion), task.state
    center = Rotation.from_quat(state.quaternion).apply(robot.center_of_mass(state.q))
    wanted = turned.inv().apply(state.position + center - task.goal.position)
    rng, scale = np.random.default_rng(task.number), float(np.linalg.norm(wanted)) + 1e-3

    def beside(q: Array) -> float:
        return float(np.sum((robot.center_of_mass(q) - wanted) ** 2)) / scale**2

    lower, upper = robot.description.shape_box
    found = [
        minimize(
            beside,
            rng.uniform(lower, upper),
            method="L-BFGS-B",
            bounds=list(zip(lower, upper, strict=True)),
            options={"maxiter": 300, "ftol": 1e-15, "gtol": 1e-10},
        ).fun
        for _ in range(starts)
    ]
    return scale * float(np.sqrt(min(found)))


def corners(positions: Array) -> Array:
    """Return the indices of shapes (N + 1, n) between which the way is straight, and short."""
    steps = np.diff(positions, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    directions = steps / np.maximum(lengths, 1e-300)[:, np.newaxis]
    turned = np.einsum("ki,ki->k", directions[1:], directions[:-1]) < 1 - 1e-12
    chosen, gone = [0], 0.0
    for k, length in enumerate(lengths[:-1]):
        gone += length
        if turned[k] or gone + lengths[k + 1] > _STRAIGHT:
            chosen.append(k + 1)
            gone = 0.0
    return np.array([*chosen, len(positions) - 1])


def integrated(oracle: PinocchioOracle, state: RobotState, schedule: GaitSchedule) -> RobotState:
    """Return where Pinocchio has the base at the end of a schedule, at zero momentum.

    The attitude depends on the path of the shape alone, not on how fast it is travelled.
    """
    start, end = Rotation.from_quat(state.quaternion), schedule.positions[-1]
    path = schedule.positions[corners(schedule.positions)]
    attitude = attitude_after(oracle, path, start, parts=2)
    center = state.position + start.apply(oracle.center_of_mass(state.q))
    position = center - attitude.apply(oracle.center_of_mass(end))
    return RobotState(position, attitude.as_quat(), end)


def worst_error(end: RobotState, goal: Goal, schedule: GaitSchedule) -> float:
    """Return the largest error of what the schedule controls, in parts of its tolerance."""
    errors = [0.0]
    if "attitude" in schedule.controls:
        turn = Rotation.from_quat(end.quaternion).inv() * Rotation.from_quat(goal.quaternion)
        errors.append(float(turn.magnitude()) / TOLERANCE.attitude)
    if "position" in schedule.controls:
        errors.append(float(np.linalg.norm(goal.position - end.position)) / TOLERANCE.position)
    if "shape" in schedule.controls and goal.joint_positions is not None:
        errors.append(float(np.abs(goal.joint_positions - end.q).max()) / TOLERANCE.shape)
    return max(errors)


def cpu_seconds() -> float:
    """Return the processor time of this process and of those that it has waited for, s."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


class Trials:
    """Plans the goals of one robot by ``auto``."""

    def __init__(self, name: str) -> None:
        path = robot_file(name)
        self.robot = SpaceRobot.from_file(path)
        self._oracle = PinocchioOracle(path.read_text("utf-8"), self.robot.joint_names)
        self._methods: dict[bool, GaitMethod] = {}

    def _method(self, *, position: bool) -> GaitMethod:
        if position not in self._methods:
            options = method_options("optimal", {"base_position": 2 - position, "cache": 0})
            self._methods[position] = build_method(
                "auto", self.robot, PERIOD, DEFAULT_INTEGRATION_STEP, {"optimal": options}
            )
        return self._methods[position]

    def outcome(self, task: Task) -> Outcome:
        """Plan one goal, and go on where a schedule is partial."""
        planner = Planner(self._method(position=task.kind == "position"), TOLERANCE)
        began, state = cpu_seconds(), task.state
        pieces: list[GaitSchedule] = []
        refusal: PlanningError | None = None
        try:
            while not pieces or pieces[-1].partial:
                pieces.append(planner.plan(state, task.goal, correction=bool(pieces)))
                path, q = pieces[-1].path, pieces[-1].positions[-1]
                state = RobotState(path.position[-1], path.quaternion[-1], q)
        except PlanningError as reason:
            refusal = reason
        done = Outcome(task.number, task.kind, task.size, "met", cpu=cpu_seconds() - began)
        match refusal:
            case None:
                error = self._checked(task, pieces)
                result = "met" if error <= 1.0 else "missed"
                duration = sum(piece.duration for piece in pieces)
                method = pieces[0].method
                return replace(done, result=result, method=method, duration=duration, error=error)
            case UnreachableError():
                result = refusal.proof.value
            case NotFoundError():
                result = "not found"
            case _:
                result = "refused"
        return replace(done, result=result, sentence=str(refusal))

    def _checked(self, task: Task, pieces: Sequence[GaitSchedule]) -> float:
        """Return the worst error at the end, in tolerances; infinite where a limit is exceeded."""
        robot, state = self.robot, task.state
        for piece in pieces:
            beyond = np.maximum(robot.lower - piece.positions, piece.positions - robot.upper)
            fast = np.abs(piece.velocities) / robot.velocity_limit
            if beyond.max() > 1e-8 or fast.max(initial=0.0) > 1 + 1e-8:
                return float("inf")
        for piece in pieces:
            state = integrated(self._oracle, state, piece)
        return worst_error(state, task.goal, pieces[-1])


def kept(name: str) -> list[Outcome]:
    """Return what is done of a robot's goals."""
    file = KEPT / f"{name}.jsonl"
    lines = file.read_text("utf-8").splitlines() if file.is_file() else []
    # What was looked at again stands below.
    latest = {each.number: each for each in (Outcome(**json.loads(line)) for line in lines)}
    return list(latest.values())


def keep(name: str, outcome: Outcome) -> None:
    with (KEPT / f"{name}.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(asdict(outcome)) + "\n")


def confirm(name: str, robot: SpaceRobot) -> None:
    """Look for the positions that were not found by a long search of another kind."""
    lost = {each.number: each for each in kept(name) if each.result == "not found"}
    for task in tasks(robot, max(lost, default=-1) + 1):
        outcome = lost.get(task.number)
        if outcome is not None and task.kind == "position" and outcome.beyond < 0:
            keep(name, replace(outcome, beyond=out_of_reach(robot, task)))


def run(name: str, count: int) -> None:
    """Plan the goals of a robot that are not done, and show each."""
    KEPT.mkdir(parents=True, exist_ok=True)
    done = {outcome.number for outcome in kept(name)}
    trials = Trials(name)
    for task in tasks(trials.robot, count):
        if task.number in done:
            continue
        outcome = trials.outcome(task)
        keep(name, outcome)
        flown = f"{outcome.duration:.6g} s by {outcome.method}" if outcome.method else ""
        print(
            f"{name} {task.number + 1}/{count}: {task.kind}, {task.size:.3g} rad: {outcome.result} "
            f"{flown}{outcome.sentence} ({outcome.cpu:.1f} s CPU)",
            flush=True,
        )
    confirm(name, trials.robot)


def classes(outcomes: Sequence[Outcome]) -> Counter[str]:
    """Return how many goals came to what; positions that no search reaches count apart."""
    return Counter(
        OUT_OF_REACH if each.beyond > TOLERANCE.position else each.result for each in outcomes
    )


def row(name: str, count: int) -> dict[str, Any] | None:
    """Return the row of the table of a robot, None where nothing is done."""
    outcomes = [outcome for outcome in kept(name) if outcome.number < count]
    if not outcomes:
        return None
    robot = SpaceRobot.from_file(robot_file(name))
    base = robot.description.bodies[0].inertia.mass
    results = classes(outcomes)
    met = [outcome for outcome in outcomes if outcome.result == "met"]
    return {
        "robot": name,
        "what": ROBOTS[name],
        "joints": robot.n,
        "mass_ratio": (robot.total_mass - base) / base,
        "goals": len(outcomes),
        "met": len(met),
        "refused": {why: number for why, number in sorted(results.items()) if why != "met"},
        "methods": dict(sorted(Counter(outcome.method for outcome in met).items())),
        "median_duration": statistics.median([outcome.duration for outcome in met] or [0.0]),
        "median_cpu": statistics.median(outcome.cpu for outcome in outcomes),
    }


def main() -> None:
    """Run what is not done, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--goals", type=int, default=100, help="goals a robot")
    parser.add_argument("--only", default="", help="robots whose name contains this")
    given = parser.parse_args()
    for name in ROBOTS:
        if given.only in name:
            run(name, given.goals)
    earlier = {each["robot"]: each for each in json.loads(TABLE.read_text("utf-8"))}
    rows = [row(name, given.goals) or earlier[name] for name in ROBOTS]
    print(json.dumps(rows, indent=1))
    TABLE.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
