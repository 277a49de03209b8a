"""Plan a gait without ROS with two methods, and print their predictions.

Run it with ``python examples/plan_without_ros.py``.
"""

import numpy as np

from spacerobot_ros import plan
from spacerobot_ros.errors import PlanningError

POSITION, ROTVEC = (0.1, 0.0, 0.05), (0.0, 0.0, 0.2)  # m, rad


def main() -> None:
    """Plan the same goal with two methods, and a goal that no configuration can reach."""
    # Paper 1's small loops, and the fastest manoeuvre within the URDF limits.
    for method in ("lie_bracket", "optimal"):
        schedule = plan("sliding_masses", position=POSITION, rotvec=ROTVEC, method=method)
        fastest = np.abs(schedule.velocities).max(axis=0)
        print(f"{method}: {schedule.duration:.2f} s, {schedule.ticks} commands")
        print(f"  fastest sliders {np.round(fastest, 3).tolist()} m/s")
        print(f"  the base ends at {np.round(schedule.path.position[-1], 4).tolist()} m")

    try:
        plan("sliding_masses", position=(9.0, 0.0, 0.0))
    except PlanningError as refusal:
        print(f"refused: {refusal}")


if __name__ == "__main__":
    main()
