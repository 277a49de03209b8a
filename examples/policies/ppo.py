"""PPO in torch for environments whose arrays are on a device, where they stay."""

from typing import Any

import torch
from policies.network import Policy
from torch import Tensor, nn
from torch.distributions import Normal

LENGTH, EPOCHS, BATCHES = 64, 5, 8
DISCOUNT, TRACE, CLIP = 0.99, 0.95, 0.2


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Return a network with two hidden layers of 64."""
    layers = nn.Linear(inputs, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, outputs)
    return nn.Sequential(*layers)


class Agent(nn.Module):
    """Networks for the mean action and for the value of normalised observations."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        self.mean, self.value = network(inputs, outputs), network(inputs, 1)
        self.log_std = nn.Parameter(torch.full((outputs,), -0.5))
        with torch.no_grad():
            self.mean[-1].weight *= 0.01
        self.register_buffer("sums", torch.zeros(3, inputs, dtype=torch.float64))

    def forward(self, inputs: Tensor) -> tuple[Normal, Tensor]:
        """Return the distribution of the actions, and the values."""
        return Normal(self.mean(inputs), self.log_std.exp()), self.value(inputs)[:, 0]

    def count(self, seen: Tensor) -> None:
        """Include observations in their mean and standard deviation."""
        self.sums += torch.stack([torch.ones_like(seen), seen, seen**2]).double().sum(1)

    def offset_and_scale(self) -> tuple[Tensor, Tensor]:
        """Return the mean and the standard deviation of the observations."""
        count, total, squares = self.sums
        mean = total / count
        return mean, (squares / count - mean**2 + 1e-8).sqrt()

    def normalised(self, seen: Any) -> Tensor:
        """Return an array of the environment as network inputs."""
        offset, scale = self.offset_and_scale()
        return ((torch.as_tensor(seen) - offset) / scale).float().clamp(-10.0, 10.0)

    def policy(self) -> Policy:
        """Return the network for the mean action, with observations as they are."""
        layers = [self.mean[k] for k in (0, 2, 4)]
        weights = [each.weight.detach().cpu().double().numpy() for each in layers]
        biases = [each.bias.detach().cpu().double().numpy() for each in layers]
        offset, scale = (each.cpu().numpy() for each in self.offset_and_scale())
        weights[0] = weights[0] / scale
        biases[0] = biases[0] - weights[0] @ offset
        return Policy(weights, biases)


@torch.no_grad()
def fly(env: Any, agent: Agent, seen: Tensor) -> tuple[list[Tensor], Tensor, float]:
    """Fly LENGTH steps; return inputs, actions, their log probabilities, values and advantages,
    the observations after them, and the share of ended episodes that reached their goals.
    """
    steps, ended, reached = list[list[Tensor]](), 0, 0
    for _ in range(LENGTH):
        agent.count(seen)
        inputs = agent.normalised(seen)
        drawn, value = agent(inputs)
        actions = drawn.sample()
        # Arrays of the device become tensors without a copy, and tensors become its arrays.
        after, rewards, *ends, infos = env.step(actions)
        gain, (terminated, truncated) = torch.as_tensor(rewards).float(), map(torch.as_tensor, ends)
        if "final_obs" in infos:  # If time is over, the value of the rest is not lost.
            gain = gain + truncated * DISCOUNT * agent(agent.normalised(infos["final_obs"]))[1]
            reached += torch.as_tensor(infos["final_info"]["is_success"]).sum()
        over = terminated | truncated
        steps.append([inputs, actions, drawn.log_prob(actions).sum(1), value, gain, over])
        seen, ended = torch.as_tensor(after), ended + over.sum()
    following, advantage = agent(agent.normalised(seen))[1], torch.zeros_like(value)
    for step in reversed(steps):
        *_, value, gain, over = step
        surprise = gain + DISCOUNT * following * ~over - value
        advantage = surprise + DISCOUNT * TRACE * advantage * ~over
        step[4:], following = [advantage], value
    joined = [torch.cat(each) for each in zip(*steps, strict=True)]
    return joined, seen, float(reached) / max(1.0, float(ended))


def learn(agent: Agent, adam: torch.optim.Optimizer, flown: list[Tensor]) -> None:
    """Improve the policy by clipped policy gradients, and the values by least squares."""
    advantages = flown[4]
    returns = advantages + flown[3]
    flown = [*flown[:4], (advantages - advantages.mean()) / (advantages.std() + 1e-8)]
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(returns), device=returns.device).chunk(BATCHES):
            inputs, actions, before, _, advantage = (each[rows] for each in flown)
            drawn, value = agent(inputs)
            ratio = (drawn.log_prob(actions).sum(1) - before).exp()
            gain = torch.minimum(ratio * advantage, ratio.clamp(1 - CLIP, 1 + CLIP) * advantage)
            adam.zero_grad()
            (0.5 * (value - returns[rows]).square().mean() - gain.mean()).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            adam.step()
