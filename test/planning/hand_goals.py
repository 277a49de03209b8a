"""Random goals of end-effectors, planned, and checked by Pinocchio: the table of `make hand-goals`.

Each goal is where the last links are after a straight way of the joints to a random shape: their
positions or poses, with the base free or with its attitude at the end given.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter

import numpy as np
from scipy.spatial.transform import Rotation
from support.hand_motion import end_of_motion

from spacerobot_ros.errors import NotFoundError, PlanningError, UnreachableError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.planning import Goal, RobotState, Tolerance, build_method, method_options
from spacerobot_ros.planning.core.goal import EndEffectorGoal
from spacerobot_ros.planning.core.method import PlanRequest
from spacerobot_ros.resources import robot_file

ROBOTS = {
    "three_joint_arm": ["end_effector"],
    "servicer": ["end_effector"],
    "seven_joint_arm": ["link_7"],
    "surveyor": ["end_effector"],
    "dual_arm": ["left_link_7", "right_link_7"],
}
PERIOD = 0.05


def measure(name: str, count: int, seed: int) -> str:
    """Return a line about goals of one robot: a quarter each is a position or a pose, the base free
    or its attitude given. Proofs are listed at its end.
    """
    urdf, links = robot_file(name).read_text("utf-8"), ROBOTS[name]
    robot = SpaceRobot.from_file(robot_file(name))
    options = {"optimal": method_options("optimal", {"cache": 0})}
    method = build_method("optimal", robot, PERIOD, 0.01, options)
    rng = np.random.default_rng(seed)
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    planned, not_found, refused = 0, 0, 0
    proofs = Counter[str]()
    errors, durations, cpu = [0.0], [], []
    for k in range(count):
        q, end = (lower + (upper - lower) * rng.uniform(a, 1 - a, robot.n) for a in (0.3, 0.1))
        way = q + np.linspace(0, 1, 60)[:, np.newaxis] * (end - q)
        place, attitude = rng.normal(size=3), Rotation.from_rotvec(rng.normal(size=3))
        found = end_of_motion(
            urdf, robot.joint_names, way, [*links, robot.base_link], place, attitude
        )
        goals = [
            EndEffectorGoal(link, found[link][0], found[link][1].as_quat() if k % 2 else None)
            for link in links
        ]
        given = found[robot.base_link][1].as_quat() if k % 4 > 1 else None
        goal = Goal.of_end_effectors(goals, quaternion=given)
        state = RobotState(place, attitude.as_quat(), q)
        began = time.process_time()
        try:
            schedule = method.plan(PlanRequest(state, goal, Tolerance(1e-6, 1e-6)))
        except UnreachableError as refusal:
            proofs[refusal.proof.value] += 1
        except NotFoundError:
            not_found += 1
        except PlanningError:
            refused += 1
        else:
            planned += 1
            durations.append(schedule.duration)
            ends = end_of_motion(
                urdf, robot.joint_names, schedule.positions, links, place, attitude
            )
            for each in goals:
                r, R = ends[each.link]
                errors.append(float(np.linalg.norm(r - each.position)))
                if each.quaternion is not None:
                    turn = R.inv() * Rotation.from_quat(each.quaternion)
                    errors.append(float(turn.magnitude()))
        cpu.append(time.process_time() - began)
    return (
        f"{name:<18}{count:>6}{planned:>9}{proofs.total():>8}{not_found:>11}{refused:>9}"
        f"{np.median(durations or [np.nan]):>9.3g}{np.median(cpu):>9.3g}{max(cpu):>9.3g}"
        f"{max(errors):>10.1e}  {', '.join(f'{n} by {proof}' for proof, n in proofs.items())}"
    ).rstrip()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--goals", type=int, default=40, help="Goals of each robot.")
    parser.add_argument("--only", default="", help="Robots whose names hold this.")
    parser.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    print(
        f"{'robot':<18}{'goals':>6}{'planned':>9}{'proved':>8}{'not found':>11}{'refused':>9}"
        f"{'median s':>9}{'CPU s':>9}{'at most':>9}{'error':>10}"
    )
    for name in ROBOTS:
        if chosen.only in name:
            print(measure(name, chosen.goals, chosen.seed), flush=True)


if __name__ == "__main__":
    main()
