"""Train a policy that turns a spacecraft by its arm, and compare it with planned manoeuvres.

Run it with ``python examples/train_policy.py [ITERATIONS] [FILE]``: 60 iterations take minutes. The
policy is linear in the observation; an evolution strategy gives each SIMD lane its own.
"""

import sys
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

import spacerobot_ros
import spacerobot_ros.environments
from spacerobot_ros.model.description import Array
from spacerobot_ros.scenario import load_scenario

LANES, HOLD, NOISE, RATE = 256, 10, 0.3, 0.5
ARGUMENTS = {"hold": HOLD, "time_limit": 30.0, "tolerance": 0.01, "spread": 0.15}


def episode_returns(env: Any, weights: Array, seed: int) -> tuple[Array, Array, Array]:
    """Return the returns, whether the goals are reached, and the durations (s) of one episode each.

    ``weights`` (lanes, actions, observations) are those of each lane's policy.
    """
    observation, _ = env.reset(seed=[seed + lane // 2 for lane in range(env.num_envs)])
    total, duration = np.zeros(env.num_envs), np.zeros(env.num_envs)
    running, reached = np.ones(env.num_envs, bool), np.zeros(env.num_envs, bool)
    while running.any():
        action = np.tanh(np.einsum("lao,lo->la", weights, observation))
        observation, reward, terminated, truncated, _ = env.step(action)
        total += running * reward
        duration += running * env.unwrapped.episodes.step_duration
        reached |= running & terminated
        running &= ~(terminated | truncated)
    return total, reached, duration


def main(iterations: int, file: Path) -> None:
    """Train, write the policy, and print the return curve and the comparison."""
    env = gymnasium.make_vec("spacerobot/ReorientArm-v0", num_envs=LANES, **ARGUMENTS)
    shape = env.single_action_space.shape[0], env.single_observation_space.shape[0]
    rng, mean = np.random.default_rng(1), np.zeros(shape)
    size = np.array([10.0] * 3 + [1.0] * (shape[1] - 3))  # Errors of attitude are small numbers.
    for iteration in range(iterations + 1):
        # Two lanes fly the same goal with opposite changes of the policy.
        change = np.repeat(rng.normal(size=(LANES // 2, *shape)), 2, axis=0)
        change[1::2] *= -1.0
        returns, reached, _ = episode_returns(env, size * (mean + NOISE * change), 1000 * iteration)
        if iteration % max(1, iterations // 10) == 0:
            print(f"{iteration}: return {returns.mean():.2f}, reached {reached.mean():.0%}")
        rank = returns[0::2] - returns[1::2]
        step = np.einsum("l,lao->ao", rank / (rank.std() + 1e-9), change[0::2]) / len(rank)
        mean += RATE * NOISE * step
    np.savetxt(file, size * mean, header="actions x observations of spacerobot/ReorientArm-v0")
    returns, reached, duration = episode_returns(env, np.tile(size * mean, (LANES, 1, 1)), 999_999)
    print(f"policy: return {returns.mean():.2f}, reached {reached.mean():.0%} of the goals")
    print(f"policy: median of these {np.median(duration[reached]) if reached.any() else 0:.1f} s")
    for method in ("optimal", "area_loop") if iterations >= 10 else ():
        scenario = load_scenario("arm_attitude").with_method(method)
        goals = [np.array([0, 0, 0, *goal]) for goal in env.unwrapped.episodes.goals[:20:4]]
        flights = [spacerobot_ros.fly(scenario, goal) for goal in goals]
        count = sum(flight.succeeded for flight in flights)
        seconds = np.median([flight.manoeuvre_time for flight in flights])
        print(f"{method}: reached {count} of {len(goals)}, median {seconds:.1f} s")


if __name__ == "__main__":
    words = sys.argv[1:]
    main(int(words[0]) if words else 2, Path(words[1] if words[1:] else "policy.txt"))
