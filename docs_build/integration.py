"""The order of accuracy of both plants, computed and drawn for ``docs/theory/model.md``.

``make figures`` draws the picture again.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spacerobot_ros.model import SpaceRobot
from spacerobot_ros.model.description import Array
from spacerobot_ros.report.figures import (
    PALETTE,
    SECONDARY_COLOUR,
    PictureFormat,
    drawing,
    new_figure,
    panel,
    picture_of,
)
from spacerobot_ros.resources import robot_file
from spacerobot_ros.simulation import InitialState
from spacerobot_ros.simulation.effort_plant import EffortPlant
from spacerobot_ros.simulation.velocity_plant import VelocityPlant

PICTURE = Path(__file__).resolve().parents[1] / "docs" / "images" / "integration_order.png"

STEPS = np.array([0.08, 0.04, 0.02, 0.01, 0.005])
"""Steps, s; the error is the deviation from steps of ``_EXACT``."""

_EXACT, _DURATION = 0.00125, 1.28
_RATES = np.array([0.5, -0.4, 0.6, 0.3, -0.5, 0.7])
_EFFORTS = np.array([8.0, -6.0, 5.0, 1.0, -0.8, 0.5])


def errors() -> dict[str, Array]:
    """Return the errors of pose and joints of the tumbling servicer, by actuation and step."""
    robot = SpaceRobot.from_file(robot_file("servicer"))
    initial = InitialState(
        joint_positions=np.array([0.3, -0.6, 0.9, 0.2, 0.4, -0.3]),
        angular_momentum=np.array([40.0, -30.0, 50.0]),
    )

    def end(actuation: str, step: float) -> Array:
        if actuation == "velocity":
            servos = VelocityPlant(robot, _DURATION, initial, step)
            servos.step(_RATES)
            return np.concatenate([servos.pose, servos.q])
        motors = EffortPlant(robot, _DURATION, initial, step)
        motors.step(_EFFORTS, np.zeros(6))
        return np.concatenate([motors.pose, motors.q])

    return {
        actuation: np.array(
            [np.linalg.norm(end(actuation, step) - end(actuation, _EXACT)) for step in STEPS]
        )
        for actuation in ("velocity", "effort")
    }


def integration_figures() -> dict[str, str]:
    """Return the observed orders: the slopes of the errors over the steps, both logarithmic."""
    return {
        f"integration.{actuation}_order": f"{np.polyfit(np.log(STEPS), np.log(error), 1)[0]:.2f}"
        for actuation, error in errors().items()
    }


def draw() -> bytes:
    """Return the picture: errors against steps, and a line of fourth order."""
    with drawing():
        figure = new_figure(3.2)
        axes = panel(figure, 0.9, 0.6, 8.0, 2.4)
        for (actuation, error), colour in zip(errors().items(), PALETTE, strict=False):
            axes.loglog(STEPS, error, "o-", color=colour, label=f"{actuation} actuation")
        slope = error[0] * (STEPS / STEPS[0]) ** 4
        axes.loglog(STEPS, slope, "--", color=SECONDARY_COLOUR, label="fourth order")
        axes.set(xlabel="step (s)", ylabel="error after 1.28 s (m, rad)")
        axes.set_xticks(STEPS, [f"{step:g}" for step in STEPS])
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(lambda value, _: f"{value:.0e}")
        axes.legend()
        return picture_of(figure, PictureFormat.PNG)


if __name__ == "__main__":
    PICTURE.write_bytes(draw())
