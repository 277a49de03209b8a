"""Train a policy that rotates a spacecraft with its arm: stable-baselines3 PPO on SIMD lanes.

Run it with ``python examples/train_policy.py [STEPS] [FILE]``: FILE.png is the return curve.
"""

import sys
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from policies.network import Policy
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from spacerobot_ros.environments.stable_baselines import SpaceRobotVecEnv

LANES, LENGTH, WINDOW, SEED = 1024, 64, 1000, 1


def main(steps: int, file: Path) -> None:
    """Train, and write the network and the return curve."""
    lanes = SpaceRobotVecEnv("spacerobot/ReorientArm-v0", LANES, hold=5, time_limit=30.0)
    lanes.seed(SEED)
    env = VecNormalize(VecMonitor(lanes), norm_reward=False)
    curve: list[list[float]] = []

    def note(known: dict[str, Any], _: Any) -> bool:
        trained = known["self"]
        if len(trained.ep_info_buffer) == WINDOW and trained.num_timesteps % (LANES * LENGTH) == 0:
            ended = [each["r"] for each in trained.ep_info_buffer], trained.ep_success_buffer
            curve.append([trained.num_timesteps, *np.mean(ended, axis=1)])
        return True

    network = {"net_arch": [32, 32], "log_std_init": -0.5}
    ppo = PPO("MlpPolicy", env, lambda left: 1e-3 * left, LENGTH, 8192, 5, policy_kwargs=network,
              seed=SEED, device="cpu", stats_window_size=WINDOW, verbose=1)  # fmt: skip
    ppo.learn(steps, callback=note)
    layers = [ppo.policy.mlp_extractor.policy_net[k] for k in (0, 2)] + [ppo.policy.action_net]
    weights, biases = ([getattr(each, part).detach().double().numpy() for each in layers]
                       for part in ("weight", "bias"))  # fmt: skip
    weights[0] = weights[0] / np.sqrt(env.obs_rms.var + env.epsilon)  # It has seen normalised ones.
    biases[0] = biases[0] - weights[0] @ env.obs_rms.mean
    Policy(weights, biases).save(file.with_suffix(".npz"))
    count, *means = np.array(curve).T
    plt.plot(count, np.transpose(means), label=["mean return", "share of goals reached"])
    plt.xlabel("steps")
    plt.legend()
    plt.savefig(file.with_suffix(".png"), dpi=100)


if __name__ == "__main__":
    main(int((sys.argv[1:] or ["6000000"])[0]), Path((sys.argv[2:] or ["policy.npz"])[0]))
