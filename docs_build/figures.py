"""The numbers of the documents: computed here, kept in ``docs/figures.json``, put into the pages.

``make figures`` writes the file, a test computes the numbers again.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from docs_build.integration import integration_figures
from docs_build.singularities import singularity_figures
from spacerobot_ros.control import ControlState, PoseReference
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.flight.trials import PlanningProblem, robot_state_of, try_method
from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.rotations import (
    attitude_error,
    matrix_from_quaternion,
    rotvec_from_quaternion,
)
from spacerobot_ros.planning import GaitSchedule, PlanRequest
from spacerobot_ros.resources import robot_file
from spacerobot_ros.scenario import load_scenario
from spacerobot_ros.simulation.actuators import build_plant

FIGURES = Path(__file__).resolve().parents[1] / "docs" / "figures.json"

_CYCLES = 30
"""Of paper 2's manoeuvre."""


def figures() -> dict[str, str]:
    """Return every number of the documents by key, with the digits that are shown."""
    return {
        **_lie_bracket(),
        **_square_path(),
        **_area_loop(),
        **_coordinated_control(),
        **singularity_figures(),
        **integration_figures(),
    }


def _lie_bracket() -> dict[str, str]:
    """Paper 1's manoeuvre, planned and flown in the plant."""
    trial = try_method(PlanningProblem.of(load_scenario("sliding_masses")), "lie_bracket")
    schedule = trial.pieces[0]
    error = trial.error
    return {
        "lie_bracket.zf": _vector(schedule.notes["zf"], 4),
        "lie_bracket.c": _vector(schedule.notes["c"], 4),
        "lie_bracket.alpha": _vector(schedule.notes["alpha"], 4),
        "lie_bracket.duration": f"{schedule.duration:g}",
        "lie_bracket.final_position": _vector(trial.pose[:3], 4),
        "lie_bracket.final_attitude": _vector(rotvec_from_quaternion(trial.pose[3:]), 4),
        "lie_bracket.position_error": f"{error.distance:.3f}",
        "lie_bracket.attitude_error": f"{error.angle:.3f}",
        "lie_bracket.attitude_error_deg": f"{np.degrees(error.angle):.2f}",
    }


def _square_path() -> dict[str, str]:
    """Paper 3's manoeuvre."""
    problem = PlanningProblem.of(load_scenario("planar_chain"))
    notes = _planned(problem, "square_path").notes
    return {
        "square_path.turn_of_step_1": f"{notes['turn_of_step_1']:.6f}",
        "square_path.wanted_phase": f"{notes['wanted_phase']:.6f}",
        "square_path.z_star": f"{notes['z_star']:.6f}",
    }


def _area_loop() -> dict[str, str]:
    """Paper 2's manoeuvre, cycle by cycle in the plant: what is left about each axis."""
    problem = PlanningProblem.of(load_scenario("arm_attitude"))
    method, plant = problem.method("area_loop"), problem.plant()
    found, previous = {}, None
    for cycle in range(1, _CYCLES + 1):
        state = robot_state_of(plant)
        previous = method.plan(
            PlanRequest(
                state,
                problem.goal,
                problem.config.tolerance,
                correction=previous is not None,
                previous=previous,
            )
        )
        for rates in previous.velocities:
            plant.step(rates)
        if cycle in (20, _CYCLES):
            left = attitude_error(plant.pose[3:], problem.goal.quaternion)
            digits = 3 if cycle == 20 else 4
            found[f"area_loop.left_after_{cycle}"] = _vector(np.degrees(left), digits)
    return found


def _coordinated_control() -> dict[str, str]:
    """Paper 4's example under both laws, commands held for a tick."""
    found = {}
    for law in ("transposed_jacobian", "model_based"):
        scenario = load_scenario("coordinated_control").with_overrides(
            "coordinated_control", {"law": law}
        )
        robot = SpaceRobot.from_file(robot_file(scenario.plant.robot))
        plant = build_plant(robot, scenario.plant)
        controller = build_controller(robot, scenario.controller)
        base, end_effector = scenario.goal, scenario.end_effector_goal
        assert end_effector is not None
        period, key = scenario.plant.control_period, f"coordinated_control.{law}"
        for tick in range(round(12.0 / period) + 1):
            state = ControlState(
                plant.pose[:3].copy(),
                plant.pose[3:].copy(),
                plant.twist[:3].copy(),
                plant.twist[3:].copy(),
                plant.q.copy(),
                plant.qdot.copy(),
            )
            if tick == 0:
                controller.set_goals(
                    0.0,
                    state,
                    base=PoseReference(base.position, base.quaternion),
                    end_effector=PoseReference(end_effector.position, end_effector.quaternion),
                )
            command = controller.command(tick * period, state, state.q, state.qdot).realised
            error = controller.law.error
            if tick == 0:
                force = matrix_from_quaternion(state.quaternion_WB) @ command.wrench_B[:3]
                found[f"{key}.force_at_start"] = _vector(force[:2], 2)
                efforts = (command.wrench_B[5], *command.tau)
                found[f"{key}.efforts_at_start"] = ", ".join(f"{x:.3f}" for x in efforts)
            elif tick == round(5.0 / period):
                found[f"{key}.errors_at_5_s"] = _vector(error, 4)
            plant.step(command.tau, command.wrench_B)
        found[f"{key}.largest_error_at_12_s"] = f"{np.abs(error).max():.4f}"
    return found


def _planned(problem: PlanningProblem, method: str) -> GaitSchedule:
    state = robot_state_of(problem.plant())
    return problem.method(method).plan(PlanRequest(state, problem.goal, problem.config.tolerance))


def _vector(values: object, digits: int) -> str:
    """Return numbers as ``(1.00, 2.00)``, and never as -0.00."""
    rounded = np.round(np.asarray(values, dtype=float), digits) + 0.0
    return "(" + ", ".join(f"{x:.{digits}f}" for x in rounded) + ")"


if __name__ == "__main__":
    FIGURES.write_text(json.dumps(figures(), indent=2) + "\n", encoding="utf-8")
