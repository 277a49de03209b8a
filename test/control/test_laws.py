"""What all laws have in common: references, gains, options, attitudes, compiled code."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from control.flights import (
    END_EFFECTOR,
    INVERTIBLE,
    PLANAR_GAINS,
    PLANAR_GOAL,
    fly,
    law_of,
    load,
    planar_start,
    plant_of,
    pose,
    random_state,
)
from control.servicer_motion import (
    GAINS,
    POSES,
    random_reference,
    well_conditioned_state,
)
from scipy.spatial.transform import Rotation
from support.random_robots import random_chain_urdf

from spacerobot_ros.control import (
    LAWS,
    ControlLaw,
    ControlState,
    GainPair,
    Gains,
    LawOptions,
    OutputSelection,
    PoseReference,
    Reference,
    TargetNotSetError,
)
from spacerobot_ros.control.config import ControllerConfig
from spacerobot_ros.control.controller import build_controller
from spacerobot_ros.control.outputs import AXES
from spacerobot_ros.errors import ParameterError
from spacerobot_ros.model import SpaceRobot, compilation
from spacerobot_ros.parameters import configured, declared, parameter


@pytest.mark.parametrize("name", INVERTIBLE)
def test_sign_of_a_quaternion_does_not_matter(name: str) -> None:
    rng = np.random.default_rng(10)
    state, reference = well_conditioned_state(rng), random_reference(rng)
    law = law_of(name, load("servicer"), GAINS)
    one = law.command(state, reference)
    other = law.command(replace(state, quaternion_WB=-state.quaternion_WB), reference)
    np.testing.assert_allclose(one.tau, other.tau, rtol=1e-12)
    np.testing.assert_allclose(one.wrench_B, other.wrench_B, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", INVERTIBLE)
@pytest.mark.parametrize("degrees", [179.9, 180.0, 180.1])
def test_half_a_turn_of_the_spacecraft(name: str, degrees: float) -> None:
    robot = load("planar_manipulator")
    law = law_of(name, robot, PLANAR_GAINS)
    start = planar_start()
    turned = Rotation.from_euler("z", degrees, degrees=True)
    attitude = turned * Rotation.from_quat(start.quaternion_WB)
    end = np.array([0.2, -0.1, 0.0]) + turned.apply(
        plant_of(robot, start).frame(END_EFFECTOR)[0] - start.r_WB
    )
    goal = Reference(PoseReference(np.array([0.2, -0.1, 0.0]), attitude.as_quat()), pose(end))
    flight = fly(plant_of(robot, start), law, lambda _: goal, 16.0, rate=50.0, every=10)
    assert np.abs(flight.errors[0]).max() > 3.0
    assert np.abs(flight.errors[-1]).max() < 5e-3


def test_a_law_without_its_reference_says_which() -> None:
    law = law_of("transposed_jacobian", load("servicer"), GAINS)
    state = random_state(np.random.default_rng(1), 6)
    with pytest.raises(TargetNotSetError, match="the end-effector"):
        law.command(state, Reference(base=pose([0, 0, 0])))


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf])
def test_gains_that_are_refused(value: float) -> None:
    with pytest.raises(ParameterError, match=r"base_position\.kp"):
        Gains.uniform(value, 1.0)
    with pytest.raises(ParameterError, match=r"end_effector_attitude\.kd"):
        replace(GAINS, end_effector_attitude=GainPair(1.0, value))


def test_gains_change_between_commands() -> None:
    rng = np.random.default_rng(14)
    state, reference = well_conditioned_state(rng), random_reference(rng)
    for name in INVERTIBLE:
        changed = LAWS[name](load("servicer"), POSES, PLANAR_GAINS)
        changed.command(state, reference)
        changed.set_gains(GAINS)
        expected = LAWS[name](load("servicer"), POSES, GAINS).command(state, reference)
        np.testing.assert_array_equal(changed.command(state, reference).tau, expected.tau)


def test_registry_and_options() -> None:
    assert set(LAWS) == {"transposed_jacobian", "model_based", "computed_torque"}
    robot = load("planar_manipulator")
    for name, law in LAWS.items():
        assert law.name == name
        built = law(robot, law.default_outputs(robot, END_EFFECTOR), PLANAR_GAINS, law.Options())
        assert isinstance(built, ControlLaw)
        for option in declared(law.Options):
            for value in (option.minimum - 1.0, np.nan):
                options = law.Options(**{option.name: value})
                with pytest.raises(ParameterError, match=f"'{option.name}'"):
                    law(robot, built.outputs.selection, PLANAR_GAINS, options)


@pytest.mark.slow
def test_compiled_law_gives_the_numbers_of_the_interpreted(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    robot = load("planar_manipulator")
    interpreted = {name: law_of(name, robot, PLANAR_GAINS) for name in INVERTIBLE}
    monkeypatch.setenv("SPACEROBOT_COMPILE", "1")
    monkeypatch.setenv("SPACEROBOT_CACHE_DIR", str(tmp_path))
    if compilation.c_compiler() is None:
        pytest.skip("no C compiler")
    for name, law in interpreted.items():
        fast = law_of(name, robot, PLANAR_GAINS)
        one = law.command(planar_start(), PLANAR_GOAL)
        other = fast.command(planar_start(), PLANAR_GOAL)
        np.testing.assert_allclose(one.wrench_B, other.wrench_B, rtol=1e-12)
        np.testing.assert_allclose(one.tau, other.tau, rtol=1e-12)


@pytest.mark.slow
def test_a_random_chain_flies_both_poses() -> None:
    """Six turning joints with axes and masses anyhow, the base's centre of mass off its origin."""
    rng = np.random.default_rng(4)
    robot = SpaceRobot.from_urdf(random_chain_urdf(rng, 6))
    q = rng.uniform(-0.8, 0.8, 6)
    start = ControlState.at_rest(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), q)
    tip = "link_6"
    end = ControlState.at_rest(
        np.array([0.3, -0.2, 0.1]), pose([0] * 3, [0.2, 0.1, -0.3]).quaternion, q + 0.2
    )
    present = Reference.present(robot, end, tip)
    goal = Reference(present.base, present.end_effector)
    law = LAWS["model_based"](robot, OutputSelection(AXES, AXES, (), tip), Gains.uniform(2.0, 3.0))
    plant = plant_of(robot, start)
    for _ in range(600):
        plant.step(law.command(plant.state, goal), 0.02)
    law.command(plant.state, goal)
    assert np.abs(law.error).max() < 1e-4


@dataclass(frozen=True)
class _DampingOptions(LawOptions):
    strength: float = parameter(2.0, "how strongly joints are damped", minimum=0.0)


class _Damping(ControlLaw):
    """A law as somebody else may write it: it brakes the joints, and knows one option."""

    name = "damping"
    gain_units = ("N m/rad", "N m s/rad")
    Options = _DampingOptions

    def _inputs(self) -> dict[str, float]:
        return {"strength": self.options.strength}

    def _results(self, symbols: dict[str, ca.SX]) -> dict[str, ca.SX]:
        tau = -symbols["strength"] * self.outputs.qdot
        return {"actuation": ca.vertcat(ca.SX(6, 1), tau)}


def test_a_new_law_is_one_class_and_one_line_in_the_registry(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert "damping.strength" not in {each.name for each in declared(ControllerConfig)}
    monkeypatch.setitem(LAWS, "damping", _Damping)
    assert "damping.strength" in {each.name for each in declared(ControllerConfig)}
    options = configured(ControllerConfig, {"damping.strength": 3.0}).options
    config = ControllerConfig(law="damping", options=options)
    controller = build_controller(load("planar_manipulator"), config)
    state = replace(planar_start(), qdot=np.array([0.5, -0.25]))
    result = controller.command(0.0, state, state.q, state.qdot)
    np.testing.assert_allclose(result.realised.tau, [-1.5, 0.75])


@pytest.mark.parametrize(
    "chosen",
    [
        {},
        {"law": "model_based"},
        {"law": "model_based", "model_based.posture_stiffness": 2.0, "end_effector_outputs": "x"},
    ],
)
def test_on_its_way_to_a_goal_the_law_is_given_the_reference_of_that_time(
    chosen: dict[str, str | float],
) -> None:
    config = configured(
        ControllerConfig, {"profile": "quintic", "max_force": 0.0, "max_torque": 0.0, **chosen}
    )
    robot = load("planar_manipulator")
    controller, state = build_controller(robot, config), planar_start()
    controller.command(2.0, state, state.q, state.qdot)
    shape = state.q + np.array([0.4, -0.3])
    hand = PLANAR_GOAL.end_effector
    controller.set_goals(2.0, state, base=PLANAR_GOAL.base, end_effector=hand, joints=shape)
    assert controller.profile is not None
    alone = build_controller(robot, config).law
    for share in (0.2, 0.5, 0.9, 1.0):
        time = 2.0 + share * controller.profile.duration
        result = controller.command(time, state, state.q, state.qdot)
        wanted = alone.command(state, controller.profile.at(time - 2.0))
        found = result.realised.tau + result.excess.tau
        assert np.abs(wanted.tau).max() > 1e-3
        np.testing.assert_allclose(found, wanted.tau, rtol=1e-9, atol=1e-12)
        found = result.realised.wrench_B + result.excess.wrench_B
        np.testing.assert_allclose(found, wanted.wrench_B, rtol=1e-9, atol=1e-12)


def test_the_units_of_gains_in_the_parameters_are_those_of_the_laws() -> None:
    for name, law in LAWS.items():
        for gain, unit in zip(("kp", "kd"), law.gain_units, strict=True):
            (described,) = (
                each.description
                for each in declared(ControllerConfig)
                if each.name == f"gains.base_position.{gain}"
            )
            stated = next(part for part in described.split(" with ")[1:] if name in part)
            before = described.split(stated)[0]
            assert before.endswith(f"{unit} with ")


@pytest.mark.parametrize("law", list(LAWS))
def test_gains_are_bounded_so_that_commands_are_numbers(law: str) -> None:
    names = [f"gains.{group}.{gain}" for group in vars(Gains()) for gain in ("kp", "kd")]
    for name in names:
        with pytest.raises(ParameterError, match=name.replace(".", r"\.")):
            configured(ControllerConfig, {"law": law, name: 1e300})
    largest = configured(ControllerConfig, {"law": law, **dict.fromkeys(names, 1e9)})
    controller = build_controller(load("planar_manipulator"), largest)
    state = replace(planar_start(), qdot=np.array([0.5, -0.25]))
    controller.command(0.0, state, state.q, state.qdot)
    result = controller.command(0.01, replace(state, r_WB=np.full(3, 100.0)), state.q, state.qdot)
    for part in (result.realised, result.excess):
        assert np.isfinite(part.wrench_B).all()
        assert np.isfinite(part.tau).all()
