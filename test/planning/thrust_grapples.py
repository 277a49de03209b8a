"""Random meetings with a tumbling satellite under thrust: `make thrust-grapples`.

A servicer meets the satellite's grapple fixture, which turns about two axes, at any time. Every
motion is compared with the target's by scipy, and looked at by coal at 400 instants. With
`--flown`, draws of the scenario `servicing` are flown with pulses of thrusters and noise of
sensors, by planned approaches and by one that holds the base.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation
from support.thrust_flights import FOLDED, distance_from_target, tumbled

from spacerobot_ros import fly
from spacerobot_ros.errors import PlanningError
from spacerobot_ros.model import SpaceRobot, load_robot
from spacerobot_ros.model.grasp import BodyMotion, RobotMotion, TargetBody
from spacerobot_ros.model.target_motion import TorqueFreeMotion
from spacerobot_ros.planning.methods.thrust.problem import Grapple, ThrustOptions
from spacerobot_ros.planning.methods.thrust.search import ThrustPlanner
from spacerobot_ros.resources import robot_file, share_directory

TARGET = share_directory() / "config" / "targets" / "satellite.urdf"
SENSORS = ("position", "attitude", "velocity", "angular_velocity")


def tumbling(rate: float, rng: np.random.Generator) -> BodyMotion:
    """Return a satellite 3.5 m to 6 m away that turns at a rate (deg/s) about two of its axes."""
    way, axis = rng.normal(size=3), np.append(rng.normal(size=2), 0.0)
    way *= rng.uniform(3.5, 6.0) / np.linalg.norm(way)
    R = Rotation.random(random_state=rng).as_matrix()
    omega = R @ axis * np.deg2rad(rate) / np.linalg.norm(axis)
    return BodyMotion(R, way, 0.002 * rng.normal(size=3), omega)


def planned(rate: float, count: int, seed: int, *, detumbles: bool, bare: bool) -> str:
    """Return a line about plans to targets of a rate."""
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
        X, r = tumbled(target, free, np.array([0.0, motion.duration]))
        fixture = r[1] + Rotation.from_quat(X[1]).apply(body.grapple.r)
        missed.append(np.linalg.norm(motion.at(motion.duration).end_effector.position - fixture))
        if bare:
            careless = planner.plan(start, replace(grapple, clearance=0.0))
            touching += distance_from_target(robot.description, target, careless, free) <= 0
        print(f"{number}: {cpu[-1]:.2f} s of CPU, {motion.duration:.1f} s", flush=True)
    line = (
        f"{rate:g} deg/s: {len(nearest)} of {count}, CPU median {np.median(cpu):.2f} s, most "
        f"{max(cpu):.2f} s, nearest {1e3 * min(nearest):.1f} mm, off {1e3 * max(missed):.3f} mm"
    )
    if detumbles:
        return f"{line}, left {max(left):.2%} of the target's, {max(longer):.3f} of the time"
    return f"{line}, {touching} touch it without rows" if bare else line


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
    """Print a line for every rate."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--only", default="")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--detumbles", action="store_true")
    parser.add_argument("--bare", action="store_true")
    parser.add_argument("--flown", action="store_true")
    given = parser.parse_args()
    for rate in (1.0, 3.0, 6.0):
        if given.only not in ("", f"{rate:g}"):
            continue
        if given.flown:
            ways = ("planned", "before"), ("planned", "after"), ("quintic", "after")
            for profile, detumble in ways:
                print(flown(rate, given.goals, given.seed, profile, detumble), flush=True)
            few = given.goals // 2
            print(flown(rate, few, given.seed, "planned", "before", 0.05), flush=True)
        else:
            asked = {"detumbles": given.detumbles, "bare": given.bare}
            print(planned(rate, given.goals, given.seed, **asked), flush=True)


if __name__ == "__main__":
    main()
