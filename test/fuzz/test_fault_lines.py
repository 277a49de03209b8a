"""Lines of faults made of the grammar's words, and of none of them."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import strategies as st
from support.fuzzing import NUMBERS, TEXTS, attempt, fuzz

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation.actuators import build_plant
from spacerobot_ros.simulation.config import PlantConfig
from spacerobot_ros.simulation.faults import (
    FAULT_KINDS,
    POSE_AXES,
    SENSOR_GROUPS,
    WRENCH_AXES,
    FaultTargets,
    fault_timeline,
    parse_fault,
)

JOINTS = ("slider_1", "slider_2", "slider_3")
TARGETS = (*JOINTS, *WRENCH_AXES, *POSE_AXES, *SENSOR_GROUPS, "odom", "all", "nozzle_1")
WORDS = st.one_of(
    st.sampled_from([*FAULT_KINDS, *TARGETS, "at", "until", "clear"]), NUMBERS.map(str), TEXTS
)
LINES = st.one_of(
    st.lists(WORDS, max_size=8).map(" ".join),
    st.tuples(
        st.sampled_from(list(FAULT_KINDS)), st.sampled_from(TARGETS), st.lists(WORDS, max_size=5)
    ).map(lambda parts: " ".join([parts[0], parts[1], *parts[2]])),
    st.builds(
        "{} {} at {}".format,
        st.sampled_from(["joint_stuck", "joint_slow", "actuator_bias", "actuator_noise"]),
        st.builds("{} {}".format, st.sampled_from(JOINTS), st.floats(0.0, 1.0)),
        st.floats(0.0, 1.0),
    ),
    st.builds(
        "{} {} {} until {}".format,
        st.sampled_from(["thruster_weak", "thruster_stuck"]),
        st.sampled_from(WRENCH_AXES),
        st.floats(0.0, 1.0) | NUMBERS,
        st.floats(3.5, 9.0) | NUMBERS,
    ),
    st.builds(
        "{} {} {} at {} until {}".format,
        st.sampled_from(list(FAULT_KINDS)),
        st.sampled_from(TARGETS),
        NUMBERS,
        NUMBERS,
        NUMBERS,
    ),
    TEXTS,
)


@fuzz("fault line", LINES, st.booleans(), fast=50, long=1500)
def test_a_line_is_refused_or_says_the_same_when_written_again(line: str, wrench: bool) -> None:
    targets = FaultTargets(JOINTS, wrench, ("nozzle_1",) if wrench else ())
    fault = attempt("fault line", parse_fault, line, targets, 3.0)
    if fault is not None:
        assert math.isfinite(fault.value)
        assert fault.start < fault.end
        assert parse_fault(str(fault), targets).kind == fault.kind


@fuzz(
    "fault timeline", st.lists(LINES, max_size=4), st.lists(NUMBERS, max_size=4), fast=20, long=400
)
def test_a_timeline_of_lines(lines: list[str], times: list[float]) -> None:
    timeline = attempt("fault timeline", fault_timeline, lines, FaultTargets(JOINTS, True))
    if timeline is not None:
        for time in sorted(t for t in times if math.isfinite(t)):
            assert all(f.start <= time < f.end for f in timeline.at(time))


_ROBOT: list[SpaceRobot] = []


@fuzz(
    "faulty plant",
    st.lists(LINES, max_size=3),
    st.sampled_from(["velocity", "effort"]),
    fast=15,
    long=300,
)
def test_a_plant_under_any_faults_stays_finite_or_says_why_it_stops(
    lines: list[str], actuation: str
) -> None:
    if not _ROBOT:
        _ROBOT.append(SpaceRobot.from_file(robot_file("sliding_masses")))
    plant = build_plant(_ROBOT[0], PlantConfig(actuation=actuation))
    for line in lines:
        attempt("faulty plant", plant.inject, line)
    commands = [np.full(3, 0.1), *([np.zeros(6)] if actuation == "effort" else [])]

    def fly() -> None:
        for _ in range(5):
            plant.step(*commands)
            for numbers in (plant.pose, plant.twist, plant.q, plant.qdot, plant.momentum):
                assert np.all(np.isfinite(numbers)), lines

    attempt("faulty plant", fly)
