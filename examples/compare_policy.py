"""Compare a policy for ``spacerobot/ReorientArm-v0`` with planned manoeuvres to the same goals.

Run it with ``python examples/compare_policy.py [FILE] [GOALS]``; the policy comes
from ``train_policy.py``. Manoeuvres are planned and flown for the first GOALS of 1024 goals.
"""

import sys
from pathlib import Path

import gymnasium
import numpy as np
from policies.network import Policy

import spacerobot_ros
import spacerobot_ros.environments
from spacerobot_ros.model.description import Array
from spacerobot_ros.scenario import load_scenario

LANES, HOLD, SEED = 1024, 5, 7


def fly(policy: Policy) -> tuple[Array, Array, Array]:
    """Return goals (N, 4), whether the policy reaches each, and the durations, s."""
    env = gymnasium.make_vec("spacerobot/ReorientArm-v0", LANES, hold=HOLD, time_limit=30.0)
    seen, _ = env.reset(seed=SEED)
    goals = env.unwrapped.episodes.goals.copy()
    running, reached = np.ones(LANES, bool), np.zeros(LANES, bool)
    durations = np.zeros(LANES)
    while running.any():
        seen, _, terminated, truncated, _ = env.step(policy(seen))
        durations += running * env.unwrapped.episodes.step_duration
        reached |= running & terminated
        running &= ~(terminated | truncated)
    return goals, reached, durations


def main(file: Path, count: int) -> None:
    """Print which goals each method reaches, and how fast."""
    goals, reached, durations = fly(Policy.load(file))
    print(f"{'way':12}{'goals':>8}{'reached':>10}{'median':>10}{'longest':>10}")
    tell("policy", reached, durations)
    tell("policy", reached[:count], durations[:count])
    for method in ("optimal", "area_loop"):
        scenario = load_scenario("arm_attitude").with_method(method)
        poses = [[np.nan, np.nan, np.nan, *q] for q in goals[:count]]  # Any position.
        flights = [spacerobot_ros.fly(scenario, pose) for pose in poses]
        succeeded = np.array([flight.succeeded for flight in flights])
        tell(method, succeeded, np.array([flight.manoeuvre_time for flight in flights]))


def tell(way: str, reached: Array, durations: Array) -> None:
    """Print a table row; durations are those of reached goals."""
    told = f"{way:12}{len(reached):8}{reached.mean():10.1%}"
    if reached.any():
        told += "".join(f"{of(durations[reached]):8.2f} s" for of in (np.median, np.max))
    print(told)


if __name__ == "__main__":
    given, own = sys.argv[1:], Path(__file__).parent / "policies/reorient_arm.npz"
    main(Path(given[0]) if given else own, int(given[1]) if given[1:] else 3)
