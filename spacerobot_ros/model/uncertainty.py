"""A robot as somebody believes it to be who has not weighed it exactly."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from spacerobot_ros.model.description import Inertia, RobotDescription


def with_model_error(robot: RobotDescription, error: float, seed: int) -> RobotDescription:
    """Return the robot with every mass and every inertia off by a factor of its own.

    The factors are drawn uniformly from ``[1 - error, 1 + error]``, two a link in the order of the
    links, with ``0 <= error < 1``. A tensor of inertia stays a possible one, since its principal
    moments keep their ratios; centres of mass stay where they are.
    """
    if not 0.0 <= error < 1.0:
        raise ValueError(f"a relative error of {error} leaves no mass positive")
    factors = np.random.default_rng(seed).uniform(1 - error, 1 + error, (len(robot.links), 2))
    links = []
    for link, (mass, moment) in zip(robot.links, factors, strict=True):
        true = link.inertia
        believed = Inertia(true.mass * float(mass), true.com, true.about_com * moment)
        links.append(replace(link, inertia=believed))
    return robot.with_links(tuple(links))
