"""Train a policy that rotates a spacecraft with its arm, all on a GPU: PPO in torch.

Run it with ``python examples/train_on_device.py [DEVICE] [STEPS] [FILE]``; DEVICE is ``cuda``,
``cuda:single``, or ``host``: the same program on the processor. FILE is for ``compare_policy.py``
and ``fly_policy.py``.
"""

import sys
import time
from pathlib import Path

import gymnasium
import torch
from gymnasium.vector import AutoresetMode
from policies.ppo import LENGTH, Agent, fly, learn

import spacerobot_ros.environments  # noqa: F401 - registers the environments

ROBOTS, RATE, SEED = 1024, 1e-3, 1


def main(device: str, steps: int, file: Path) -> None:
    """Train, print the share of goals reached, and write the network."""
    torch.manual_seed(SEED)
    arguments = {"device": device, "hold": 5, "time_limit": 30.0}
    env = gymnasium.make_vec(
        "spacerobot/ReorientArm-v0", ROBOTS, autoreset_mode=AutoresetMode.SAME_STEP, **arguments
    )
    seen = torch.as_tensor(env.reset(seed=SEED)[0])
    agent = Agent(seen.shape[1], env.single_action_space.shape[0]).to(seen.device)
    adam, rounds = torch.optim.Adam(agent.parameters(), RATE), max(1, steps // (ROBOTS * LENGTH))
    began = time.perf_counter()
    for k in range(rounds):
        flown, seen, reached = fly(env, agent, seen)
        adam.param_groups[0]["lr"] = RATE * (1.0 - k / rounds)
        learn(agent, adam, flown)
        done, took = (k + 1) * ROBOTS * LENGTH, time.perf_counter() - began
        print(f"{done:12,} steps {took:8.1f} s {reached:8.1%} of the goals reached", flush=True)
    agent.policy().save(file)


if __name__ == "__main__":
    given = sys.argv[1:] + ["cuda", "6000000", "policy.npz"][len(sys.argv) - 1 :]
    main(given[0], int(given[1]), Path(given[2]))
