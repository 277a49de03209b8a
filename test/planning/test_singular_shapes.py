"""The parts of the search for singular shapes: equations, steps within bounds, and unions."""

from __future__ import annotations

from spacerobot_ros.planning.core.workspaces import (
    Workspaces,
)

TOOL = "end_effector"


def test_path_independent_distances_are_the_rest_of_the_reach_but_for_slivers() -> None:
    found = Workspaces(TOOL, True, (0.2, 2.0), ((0.2, 0.5), (0.9, 1.4), (1.4039, 1.6)), 3, 7)
    # Gaps of 0.2 % of 2 m are closed.
    assert found.path_independent == ((0.5, 0.9), (1.6, 2.0))
    wider = Workspaces(TOOL, True, (0.2, 2.0), ((0.2, 0.5), (0.9, 1.4), (1.4041, 2.0)), 3, 7)
    assert wider.path_independent == ((0.5, 0.9), (1.4, 1.4041))
    assert Workspaces(TOOL, True, (0.2, 2.0), (), 3, 7).path_independent == ((0.2, 2.0),)
