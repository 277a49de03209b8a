"""Read a recorded flight as numpy arrays and plot it.

Run it with ``python examples/read_bag_and_plot.py [BAG] [PICTURE]``; the default is a short flight
of paper 4's example, included in the package.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from spacerobot_ros import read_bag

BAG = Path(__file__).parents[1] / "bags" / "coordinated_control.mcap"


def main(source: Path = BAG, picture: Path = Path("flight.png")) -> None:
    """Print the contents of a bag; plot base, joints and momentum over time."""
    bag = read_bag(source)
    odom, joints, momentum = bag["/odom"], bag["/joint_states"], bag["/momentum"]
    base = np.column_stack([odom.field(f"pose.pose.position.{axis}") for axis in "xyz"])
    q = joints.field("position")  # (N, n)
    total = momentum.field("data")[:, :6]  # linear, angular
    print(f"{source.name}: {len(odom.time)} states in {odom.time[-1] - odom.time[0]:.2f} s")
    print(f"the base goes from {base[0].round(3).tolist()} to {base[-1].round(3).tolist()} m")
    print(f"largest momentum {np.abs(total).max():.3g} kg m/s or kg m^2/s")

    figure = Figure(figsize=(7, 7), layout="constrained")
    above, middle, below = figure.subplots(3, 1, sharex=True)
    above.plot(odom.time, base, label=["x", "y", "z"])
    above.set_ylabel("base (m)")
    above.legend()
    middle.plot(joints.time, q)
    middle.set_ylabel("joints (m or rad)")
    below.plot(momentum.time, total)
    below.set_ylabel("momentum")
    below.set_xlabel("time (s)")
    figure.savefig(picture)
    print(f"drawn into {picture}")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:]))
