"""Plan, fly and plot in Python, without ROS."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

import spacerobot_ros
from spacerobot_ros import fly, load_scenario, plan
from spacerobot_ros.errors import GoalError, ParameterError

QUICK = {"planner.lie_bracket.t1": 2.0, "planner.lie_bracket.cycle_period": 1.0}

EIGHT_LINES = """
from spacerobot_ros import fly, plan
schedule = plan("faults/stuck_slider", method="lie_bracket")
flight = fly("faults/stuck_slider", seed=3, parameters={"plant.faults": []})
figure = flight.plot()
table = flight.to_pandas()
print(schedule.duration, flight)
"""


def test_plan_fly_and_plot_in_eight_lines_without_ros() -> None:
    """In a process of its own, which must not have loaded ROS."""
    assert len(EIGHT_LINES.strip().splitlines()) <= 8
    check = (
        "import sys; assert 'rclpy' not in sys.modules\n"
        "assert figure._repr_png_()[:4] == b'\\x89PNG'\n"
        "assert table.loc[flight.time[-1], 'q.slider_2'] == flight.q[-1, 1]\n"
        "assert abs(flight.time[-1] - schedule.duration) < 1e-9\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", EIGHT_LINES + check], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert "<Flight of stuck_slider by lie_bracket: reached after" in done.stdout


@pytest.mark.slow
def test_a_scenario_plans_with_its_own_limits() -> None:
    """The same goal of the robot alone is reached five times faster: its URDF allows for more."""
    scenario = load_scenario("sliding_masses")
    at, turned = scenario.goal.position, (0.5, -0.15, 0.1)
    own = plan(scenario)
    assert own.duration == plan("sliding_masses").duration == 39.45
    assert plan(scenario, position=at, rotvec=turned).duration == own.duration
    assert plan("sliding_masses", position=at, rotvec=turned).duration < 10.0
    assert fly(scenario).manoeuvre_time == own.duration


def test_goals_are_given_in_many_ways() -> None:
    short = (0.01, 0.02, -0.01)
    flights = [
        fly("faults/stuck_slider", short, rotvec=(0.01, 0.0, 0.0), parameters=QUICK),
        fly("faults/stuck_slider", [*short, np.sin(0.005), 0, 0, np.cos(0.005)], parameters=QUICK),
    ]
    np.testing.assert_allclose(flights[0].pose[-1], flights[1].pose[-1], atol=1e-12)
    alone = fly(
        "sliding_masses", short, rotvec=(0.01, 0, 0), method="lie_bracket", parameters=QUICK
    )
    assert alone.succeeded
    np.testing.assert_allclose(alone.pose[-1, :3], short, atol=0.02)
    with pytest.raises(GoalError, match="3 or 7 numbers"):
        fly("sliding_masses", (1.0, 2.0))
    with pytest.raises(ParameterError, match=r"no parameter 'sensors\.position'"):
        fly("sliding_masses", parameters={"plant.sensors.position": 1.0})
    with pytest.raises(ParameterError, match="'position_noise' is no parameter"):
        fly("sliding_masses", parameters={"position_noise": 1.0})


def test_seeds_repeat_a_flight_and_change_it() -> None:
    noise: dict[str, object] = {"plant.sensors.position_noise": 1e-3, "plant.faults": [], **QUICK}
    flights = [fly("faults/stuck_slider", seed=k, parameters=noise) for k in (1, 1, 2)]
    one, same, other = flights
    np.testing.assert_array_equal(one.pose, same.pose)
    assert not np.array_equal(
        one.quantities["measured_pose"][0], other.quantities["measured_pose"][0]
    )


def test_arrays_are_copies() -> None:
    flight = fly("faults/stuck_slider", parameters=QUICK)
    assert not np.shares_memory(flight.q, fly("faults/stuck_slider", parameters=QUICK).q)
    assert len(np.unique(flight.q[:20, 0])) > 5  # Not the last state again and again.
    assert flight.summary()["final_joint_positions"] == flight.q[-1].tolist()


def test_an_animation_shows_every_frame() -> None:
    flight = fly("faults/stuck_slider", parameters=QUICK)
    shown = flight.animate(seconds=1.0, frames=3)
    assert shown._repr_html_().count("data:image/png") == 3
    assert "show it in a notebook" in repr(shown)
    # Nothing is asked of a server, and every button has a sign.
    assert "http" not in shown._repr_html_().replace("http://www.w3.org", "")
    assert "fa-" not in shown._repr_html_()


def test_the_package_names_what_it_offers() -> None:
    for name in spacerobot_ros.__all__:
        assert getattr(spacerobot_ros, name)
