"""URDFs with elements and attributes changed: a robot whose numbers are finite, or a refusal."""

from __future__ import annotations

import copy
import random
import xml.etree.ElementTree as ET

import numpy as np
from hypothesis import strategies as st
from support.fuzzing import attempt, damaged, fuzz

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.thrusters import thrusters_of_urdf
from spacerobot_ros.model.urdf import parse_robot
from spacerobot_ros.resources import resource_names, robot_file

TEXTS = [robot_file(name).read_text(encoding="utf-8") for name in resource_names("urdf", ".urdf")]
VALUES = ["nan", "inf", "-inf", "-1", "0", "x", "", "1e308", "-1e308", "1e-320", "1e12", "1 2",
          "1 2 3", "0 0 0", "1e308 1e308 1e308", "1 2 3 4", "base_link", "revolute", "prismatic",
          "floating", "planar", "continuous", "fixed", "0x10", "1,5", "é",
          "a b\nc", "1_0"]  # fmt: skip


def changed(text: str, seed: int, changes: int) -> str:
    """Return a URDF with some elements dropped, doubled, moved or given other attributes."""
    draw = random.Random(seed)
    root = ET.fromstring(text)
    for _ in range(changes):
        parent = draw.choice([e for e in root.iter() if len(e)])
        element = draw.choice(list(parent))
        kind = draw.choice(["attribute"] * 5 + ["swap", "drop", "double", "strip", "move"])
        if kind in ("attribute", "swap", "strip"):
            carriers = [e for e in element.iter() if e.attrib]
            if not carriers:
                continue
            carrier = draw.choice(carriers)
            name = draw.choice(list(carrier.attrib))
            if kind == "strip":
                del carrier.attrib[name]
            elif kind == "swap":
                values = [e.attrib[name] for e in root.iter() if name in e.attrib]
                carrier.attrib[name] = draw.choice(values)
            else:
                carrier.attrib[name] = draw.choice(VALUES)
        elif kind == "drop":
            parent.remove(element)
        elif kind == "double":
            parent.append(copy.deepcopy(element))
        else:
            parent.remove(element)
            draw.choice(list(root.iter())).append(element)
        if not any(len(e) for e in root.iter()):
            break
    return ET.tostring(root, encoding="unicode")


MUTANTS = st.builds(
    changed, st.sampled_from(TEXTS), st.integers(0, 2**32), st.sampled_from([1, 1, 2, 4])
)


@fuzz("URDF", MUTANTS, fast=50, long=1800)
def test_a_changed_urdf(text: str) -> None:
    robot = attempt("URDF", parse_robot, text)
    if robot is None:
        return
    for body in robot.bodies:
        assert np.all(np.isfinite(body.inertia.about_com))
        assert np.all(np.isfinite(body.inertia.com))
    for link in robot.links:
        for shape in link.shapes:
            assert np.all(np.isfinite([*shape.size, *shape.rgba]))
    attempt("URDF", thrusters_of_urdf, robot)


@fuzz("model", MUTANTS, fast=8, long=150)
def test_a_model_of_a_changed_urdf(text: str) -> None:
    robot = attempt("model", SpaceRobot.from_urdf, text)
    if robot is None:
        return
    assert robot.total_mass > 0
    q = np.clip(np.zeros(robot.n), robot.lower, robot.upper)
    assert np.all(np.isfinite(robot.center_of_mass(q)))


@fuzz(
    "damaged URDF",
    st.sampled_from(TEXTS).flatmap(lambda text: damaged(text.encode())),
    fast=30,
    long=800,
)
def test_a_damaged_urdf(raw: bytes) -> None:
    attempt("damaged URDF", parse_robot, raw.decode(errors="replace"))
