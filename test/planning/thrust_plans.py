"""Random goals of base and joints under thrust, and meetings with a tumbling satellite.

`make thrust-goals` and `thrust-obstacles`: boxes float on the straight way; past two there are half
as many goals. Every motion past boxes is looked at by coal at 400 instants, and without boxes the
first one of each robot is flown by Pinocchio under its wrenches and efforts alone.

`make thrust-grapples` and `thrust-detumbles`: a servicer meets the satellite's grapple fixture,
which turns about two axes, at any time. Every motion is compared with the target's by scipy, and
looked at by coal at 400 instants. With `--flown` (`make thrust-captures`), draws of the scenario
`servicing` are flown with pulses of thrusters and noise of sensors, by planned approaches and by
one that holds the base.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from support.oracles.integrated import tumbled_body
from support.thrust_flights import (
    FOLDED,
    beyond,
    box,
    distance_from_target,
    flown_by_pinocchio,
    obstacles,
)

from spacerobot_ros import fly
from spacerobot_ros.collision import BasePoses
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.grasp import BodyMotion, RobotMotion, TargetBody
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.methods.thrust.problem import Grapple, ThrustGoal, ThrustOptions
from spacerobot_ros.planning.methods.thrust.search import ThrustPlanner
from spacerobot_ros.resources import robot_file, share_directory

ROBOTS = ("jet_cube", "free_flyer", "servicer", "servicer_wheels")
TARGET = share_directory() / "config" / "targets" / "satellite.urdf"
SENSORS = ("position", "attitude", "velocity", "angular_velocity")


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
            solids = {
                f"box_{k}": (box(size * rng.uniform(0.6, 1.4, 3)), at, rng.uniform(-1, 1, 3))
                for k, at in enumerate(middle)
            }
            planner.use_obstacles(obstacles(**solids))
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


def tumbling(rate: float, rng: np.random.Generator) -> BodyMotion:
    """Return a satellite 3.5 m to 6 m away that turns at a rate (deg/s) about two of its axes."""
    way, axis = rng.normal(size=3), np.append(rng.normal(size=2), 0.0)
    way *= rng.uniform(3.5, 6.0) / np.linalg.norm(way)
    R = Rotation.random(random_state=rng).as_matrix()
    omega = R @ axis * np.deg2rad(rate) / np.linalg.norm(axis)
    return BodyMotion(R, way, 0.002 * rng.normal(size=3), omega)


def planned(rate: float, count: int, seed: int, *, detumbles: bool) -> str:
    """Return a line about plans to targets of a rate; some may touch it if nothing keeps apart."""
    robot = SpaceRobot.from_file(robot_file("servicer"))
    target = load_robot(TARGET)
    body = TargetBody.of(target, "grapple")
    planner = ThrustPlanner(robot, ThrustOptions(thrusters="urdf"), "end_effector")
    start = RobotMotion.at_rest(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]), FOLDED)
    rng, cpu, nearest, missed, left = np.random.default_rng(seed), [], [], [], []
    longer, touching = [], 0
    for number in range(count):
        free = tumbling(rate, rng)
        grapple = Grapple(TorqueFreeMotion(body, free), target, 0.02)
        began = time.process_time()
        try:
            motion = plain = planner.plan(start, grapple)
            if detumbles:
                began = time.process_time()
                motion = planner.plan(start, replace(grapple, detumbles=True))
                longer.append(motion.duration / plain.duration)
                spins = np.linalg.norm(body.inertia.about_com @ free.R_WT.T @ free.omega)
                joined = motion.joined_momentum(grapple.motion)
                left.append(float(np.linalg.norm(joined) / spins))
        except PlanningError as refusal:
            print(f"{number}: {refusal}", flush=True)
            continue
        finally:
            cpu.append(time.process_time() - began)
        nearest.append(distance_from_target(robot.description, target, motion, free))
        R, r, _ = tumbled_body(body.inertia, free, np.array([0.0, motion.duration]))
        fixture = r[1] + R[1].apply(body.grapple.r)
        missed.append(np.linalg.norm(motion.at(motion.duration).end_effector.position - fixture))
        if not detumbles:
            careless = planner.plan(start, replace(grapple, clearance=0.0))
            touching += distance_from_target(robot.description, target, careless, free) <= 0
        print(f"{number}: {cpu[-1]:.2f} s of CPU, {motion.duration:.1f} s", flush=True)
    line = (
        f"{rate:g} deg/s: {len(nearest)} of {count}, CPU median {np.median(cpu):.2f} s, most "
        f"{max(cpu):.2f} s, nearest {1e3 * min(nearest):.1f} mm, off {1e3 * max(missed):.3f} mm"
    )
    if detumbles:
        little = f"{np.sum(np.array(left) <= 0.01)} leave 1 % of the target's momentum at most"
        return f"{line}, {little} (most {max(left):.2%}), {max(longer):.3f} of the time"
    return f"{line}, {touching} touch it without rows"


def flown(
    rate: float, draws: int, seed: int, profile: str, detumble: str, mass_error: float = 0.0
) -> str:
    """Return a line about flights of the scenario `servicing` up to the grasp.

    Masses and inertias that the controller believes are wrong by up to ``mass_error``.
    """
    rng, propellant, left, took, cpu = np.random.default_rng(seed), [], [], [], []
    for number in range(draws):
        axis = rng.normal(size=2)
        omega = np.append(0.0, np.deg2rad(rate) * axis / np.linalg.norm(axis))
        began = time.process_time()
        try:
            flight = fly(
                "servicing",
                seed=seed + number,
                parameters={
                    **{f"plant.sensors.{name}_noise": 3e-4 for name in SENSORS},
                    **{f"plant.target.sensors.{name}_noise": 5e-4 for name in SENSORS},
                    "plant.target.angular_velocity": omega.tolist(),
                    "coordinated_control.profile": profile,
                    "coordinated_control.plan.thrusters": "urdf",
                    "coordinated_control.target.horizon": 60.0,
                    "coordinated_control.plan.duration": 60.0,
                    "coordinated_control.target.detumble": detumble,
                    "coordinated_control.model_error": mass_error,
                    "coordinated_control.model_error_seed": number,
                    # Flights end soon after the grasp: the time for detumbling is over.
                    "coordinated_control.time_limit": 0.1,
                },
            )
        except PlanningError as refusal:
            print(f"{number}: {refusal}", flush=True)
            continue
        cpu.append(time.process_time() - began)
        capture = flight.capture
        if not capture["captured"]:
            print(f"{number}: {flight.message}", flush=True)
            continue
        propellant.append(flight.propellant or 0.0)
        left.append(float(np.linalg.norm(capture["angular_momentum_Nms"])))
        took.append(capture["time_s"])
        print(f"{number}: captured after {took[-1]} s, {cpu[-1]:.1f} s of CPU", flush=True)
    line = f"{rate:g} deg/s, {profile}, {detumble}, masses wrong by up to {mass_error:.0%}: "
    line += f"{len(took)} of {draws} captured"
    if took:
        line += (
            f" after {np.median(took):.1f} s with {1e3 * np.median(propellant):.1f} g, "
            f"{np.median(left):.3f} N m s left (95 %: {np.quantile(left, 0.95):.3f}); "
            f"{np.median(cpu):.1f} s of CPU"
        )
    return line


def main() -> None:
    """Print a line for every robot, or for every rate of the satellite."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--boxes", type=int, nargs="+", help="none: meetings")
    parser.add_argument("--only", default="")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--detumbles", action="store_true")
    parser.add_argument("--flown", action="store_true")
    given = parser.parse_args()
    for name in ROBOTS if given.boxes else ():
        for boxes in given.boxes if given.only in ("", name) else []:
            goals = given.goals if boxes < 2 else (given.goals + 1) // 2
            print(measure(name, goals, boxes, given.seed), flush=True)
    for rate in () if given.boxes else (1.0, 3.0, 6.0):
        if given.only not in ("", f"{rate:g}"):
            continue
        if given.flown:
            ways = ("planned", "before"), ("planned", "after"), ("quintic", "after")
            for profile, detumble in ways:
                print(flown(rate, given.goals, given.seed, profile, detumble), flush=True)
            few = given.goals // 2
            print(flown(rate, few, given.seed, "planned", "before", 0.05), flush=True)
        else:
            print(planned(rate, given.goals, given.seed, detumbles=given.detumbles), flush=True)


if __name__ == "__main__":
    main()
