"""Random goals of base and joints under thrust, past boxes or not: `make thrust-goals`.

Boxes float on the straight way; past two there are half as many goals. Every motion that is planned
is looked at by coal at 400 instants, and without boxes the first one of each robot is flown by
Pinocchio under its wrenches and efforts alone.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
from scipy.spatial.transform import Rotation
from support.thrust_flights import FOLDED, beyond, flown_by_pinocchio

from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.grasp import RobotMotion
from spacerobot_ros.model.urdf import parse_world
from spacerobot_ros.planning.methods.thrust.problem import ThrustGoal, ThrustOptions
from spacerobot_ros.planning.methods.thrust.search import ThrustPlanner
from spacerobot_ros.resources import robot_file

ROBOTS = ("jet_cube", "free_flyer", "servicer", "servicer_wheels")


def box(number: int, place: np.ndarray, rng: np.random.Generator, size: float) -> str:
    """Return the elements of a box of a random size and attitude."""
    numbers = [size * rng.uniform(0.6, 1.4, 3), place, rng.uniform(-1, 1, 3)]
    texts = [" ".join(map(str, each)) for each in numbers]
    return (
        f'<link name="box_{number}"><collision><geometry><box size="{texts[0]}"/></geometry>'
        f'</collision></link><joint name="j_{number}" type="fixed"><parent link="w"/>'
        f'<child link="box_{number}"/><origin xyz="{texts[1]}" rpy="{texts[2]}"/></joint>'
    )


def measure(name: str, count: int, boxes: int, seed: int) -> str:
    """Return a line about goals of one robot."""
    free = SpaceRobot.from_file(robot_file(name))
    folded = np.zeros(free.n)
    if name.startswith("servicer"):
        folded[-6:] = FOLDED  # After its wheels.
    far, size = (8.0, 0.7) if name.startswith("servicer") else (3.0, 0.35)
    table = "" if name == "free_flyer" else "urdf"
    options = ThrustOptions(clearance=0.01 if boxes else 0.0, thrusters=table)
    planner = ThrustPlanner(free, options, force=0.5, torque=0.05)
    rng = np.random.default_rng(seed)
    cpu, nearest, planned, error = [], [], 0, np.nan
    for _ in range(count):
        place, attitude = rng.uniform(-1, 1, 3), Rotation.random(random_state=rng)
        begin = np.concatenate([place, attitude.as_quat()])
        way = rng.normal(size=3)
        way *= (far if boxes else rng.uniform(0.3, 3.0)) / np.linalg.norm(way)
        axis = rng.normal(size=3)
        goal = beyond(begin, way, axis / np.linalg.norm(axis) * rng.uniform(0.2, 2.5))
        # With boxes the arm keeps its shape, so that they alone are in the way.
        bend = 0.0 if boxes else rng.uniform(-1, 1, free.n)
        shape = np.clip(folded + bend, free.lower, free.upper)
        if boxes:
            middle = np.linspace(begin[:3], goal[:3], boxes + 2)[1:-1]
            links = "".join(box(k, at, rng, size) for k, at in enumerate(middle))
            world = parse_world(f'<robot name="world"><link name="w"/>{links}</robot>')
            planner.use_obstacles(world)
        start = RobotMotion.at_rest(begin, folded)
        began = time.process_time()
        try:
            motion = planner.plan(start, ThrustGoal(goal, shape=shape))
        except PlanningError as refusal:
            print(f"{name}: {refusal}", flush=True)
            continue
        finally:
            cpu.append(time.process_time() - began)
        planned += 1
        if boxes and planner.clearance is not None:
            samples = [motion.at(t) for t in np.linspace(0, motion.duration, 400)]
            base = BasePoses(*(np.array([s.base[i] for s in samples]) for i in (0, 1)))
            shapes = np.array([s.q for s in samples])
            nearest.append(planner.clearance.geometry.nearest_along(shapes, base)[0].min())
        elif np.isnan(error):
            ended = flown_by_pinocchio(free, motion, start)
            apart = Rotation.from_quat(goal[3:]).inv() * Rotation.from_quat(ended[3:7])
            error = max(float(np.linalg.norm(ended[:3] - goal[:3])), float(apart.magnitude()))
    line = f"{name:<16}{boxes} boxes: {planned} of {count}, "
    line += f"CPU median {np.median(cpu):.2f} s, most {max(cpu):.2f}"
    if nearest:
        return f"{line} s, nearest {1e3 * min(nearest):.2f} mm"
    return f"{line} s, Pinocchio ends {error:.1e} m or rad from the goal"


def main() -> None:
    """Print a line for every robot."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--boxes", type=int, nargs="+", default=[0])
    parser.add_argument("--only", default="")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    for name in ROBOTS:
        for boxes in given.boxes if given.only in ("", name) else []:
            goals = given.goals if boxes < 2 else (given.goals + 1) // 2
            print(measure(name, goals, boxes, given.seed), flush=True)


if __name__ == "__main__":
    main()
