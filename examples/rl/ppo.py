"""Proximal policy optimization (PPO) in one file.

The algorithm is that of Schulman et al., "Proximal Policy Optimization Algorithms" (arXiv:1707.06347), with generalized
advantage estimation (arXiv:1506.02438). Observations are scaled to zero mean and unit variance, and rewards by the
standard deviation of the discounted return, as in CleanRL and Stable-Baselines3.

```console
python ppo.py hover --seed 1
python ppo.py race --samples 20000000 --out runs/race
```
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
import tyro
from progress import Progress, Selection, finish
from torch import nn
from trainings import TRAININGS, Training, training_envs

import dronevio as dv
from dronevio.models.policies import Scaling
from dronevio.sim.envs import policy_from_torch, provenance_of

Array32 = npt.NDArray[np.float32]

LIMIT = 10.0
"""Largest magnitude of a scaled observation."""
LARGEST_GRADIENT = 0.5
"""Norm to which larger gradients are scaled down."""
VALUE_WEIGHT = 0.5
"""Weight of the error of the value function in the loss."""


class Moments:
    """Mean and variance of all values so far, by the parallel algorithm of Chan et al. (1979)."""

    def __init__(self, shape: tuple[int, ...]) -> None:
        self.mean, self.variance, self.count = np.zeros(shape), np.ones(shape), 1e-4

    def update(self, values: npt.NDArray[Any]) -> None:
        """Add values (n, …)."""
        mean, variance, count = values.mean(axis=0), values.var(axis=0), len(values)
        total, change = self.count + count, mean - self.mean
        self.mean = self.mean + change * count / total
        squares = self.variance * self.count + variance * count + change**2 * self.count * count / total
        self.variance, self.count = squares / total, total

    def scaling(self) -> Scaling:
        """Return the scaling to zero mean and unit variance."""
        return Scaling.of_statistics(self.mean, self.variance, limit=LIMIT)


def perceptron(inputs: int, hidden: tuple[int, ...], outputs: int, gain: float) -> nn.Sequential:
    """Return a multilayer perceptron with orthogonal weights, of the given gain in the last layer."""
    widths, layers = (inputs, *hidden, outputs), []
    for k in range(len(widths) - 1):
        last = k == len(widths) - 2
        linear = nn.Linear(widths[k], widths[k + 1])
        nn.init.orthogonal_(linear.weight, gain if last else 2.0**0.5)
        nn.init.zeros_(linear.bias)
        layers += [linear] if last else [linear, nn.Tanh()]
    return nn.Sequential(*layers)


class Agent(nn.Module):
    """A normal distribution of actions and a value function, of scaled observations."""

    def __init__(self, training: Training, inputs: int, actions: int) -> None:
        super().__init__()
        self.actor = perceptron(inputs, training.hidden, actions, 0.01)
        self.critic = perceptron(inputs, training.hidden, 1, 1.0)
        self.log_std = nn.Parameter(torch.full((actions,), training.log_std))

    def log_probability(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Return the logarithms (n,) of the probability densities of actions (n, 4)."""
        standard = (actions - self.actor(observations)) * torch.exp(-self.log_std)
        return (-0.5 * standard**2 - self.log_std - 0.5 * np.log(2.0 * np.pi)).sum(dim=1)

    @torch.no_grad()
    def value(self, observations: Array32) -> Array32:
        """Return the values (n,) of scaled observations."""
        return self.critic(torch.from_numpy(observations))[:, 0].numpy()

    @torch.no_grad()
    def sample(self, observations: Array32) -> tuple[Array32, Array32]:
        """Return random actions (n, 4) and the logarithms (n,) of their probability densities."""
        inputs = torch.from_numpy(observations)
        mean = self.actor(inputs)
        actions = mean + torch.exp(self.log_std) * torch.randn(mean.shape)
        return actions.numpy(), self.log_probability(inputs, actions).numpy()


@dataclass(frozen=True, eq=False)
class Rollout:
    """T steps of n environments."""

    observations: Array32
    """(T, n, N) Scaled observations before the steps."""
    actions: Array32
    """(T, n, 4) Actions of the steps."""
    log_probabilities: Array32
    """(T, n) Logarithms of the probability densities of the actions."""
    rewards: Array32
    """(T, n) Scaled rewards, with the discounted value of the last state of an episode that the time limit ends."""
    values: Array32
    """(T + 1, n) Values of the states before the steps and of the last state."""
    ended: Array32
    """(T, n) 1 for steps that end an episode, and 0 for others."""

    def advantages(self, gamma: float, gae_lambda: float) -> Array32:
        """Return the advantages (T, n), estimated by exponentially weighted sums of temporal differences."""
        go_on = gamma * (1.0 - self.ended)
        differences = self.rewards + go_on * self.values[1:] - self.values[:-1]
        advantages, following = np.zeros_like(differences), np.zeros_like(differences[0])
        for t in reversed(range(len(differences))):
            advantages[t] = following = differences[t] + gae_lambda * go_on[t] * following
        return advantages


class Sampler:
    """Environments that an agent steps, with the statistics by which observations and rewards are scaled."""

    def __init__(self, training: Training, seed: int, progress: Progress) -> None:
        self.training, self.progress = training, progress
        self.envs = training_envs(training)
        self.seen = Moments(self.envs.single_observation_space.shape)
        self._returned = Moments(())
        self._returns = np.zeros(training.num_envs)
        self._observations, _ = self.envs.reset(seed=seed)
        self.seen.update(self._observations)

    def rollout(self, agent: Agent) -> Rollout:
        """Step all environments by the actions of an agent."""
        gamma, scaling = self.training.gamma, self.seen.scaling()
        rows, raw = [], []
        for _ in range(self.training.rollout_steps):
            raw.append(self._observations)
            scaled = scaling.apply(self._observations)
            actions, log_probabilities = agent.sample(scaled)
            values = agent.value(scaled)
            self._observations, rewards, terminated, truncated, infos = self.envs.step(actions)
            ended = terminated | truncated
            self.progress.add(rewards, ended, infos)
            self._returns = gamma * self._returns + rewards
            self._returned.update(self._returns)
            self._returns[ended] = 0.0
            rewards = rewards / np.sqrt(self._returned.variance + 1e-8)
            cut = truncated & ~terminated
            if cut.any():
                rewards[cut] += gamma * agent.value(scaling.apply(np.stack(infos["final_obs"][cut])))
            rows.append((scaled, actions, log_probabilities, rewards, values, ended))
        columns = [np.stack(column).astype(np.float32) for column in zip(*rows, strict=True)]
        columns[4] = np.concatenate([columns[4], agent.value(scaling.apply(self._observations))[None]])
        self.seen.update(np.concatenate(raw))
        return Rollout(*columns)


def update(agent: Agent, optimizer: torch.optim.Optimizer, rollout: Rollout, training: Training) -> None:
    """Improve an agent by the samples of a rollout."""
    advantages = rollout.advantages(training.gamma, training.gae_lambda)
    returns = advantages + rollout.values[:-1]
    columns = (rollout.observations, rollout.actions, rollout.log_probabilities, advantages, returns)
    samples = [torch.from_numpy(column.reshape(advantages.size, *column.shape[2:])) for column in columns]
    for _ in range(training.epochs):
        for chosen in torch.randperm(advantages.size).split(training.minibatch):
            observations, actions, old, advantage, wanted = (column[chosen] for column in samples)
            advantage = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            ratio = torch.exp(agent.log_probability(observations, actions) - old)
            clipped = ratio.clamp(1.0 - training.clip, 1.0 + training.clip)
            surrogate = torch.min(ratio * advantage, clipped * advantage).mean()
            value_error = ((agent.critic(observations)[:, 0] - wanted) ** 2).mean()
            optimizer.zero_grad()
            (VALUE_WEIGHT * value_error - surrogate).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), LARGEST_GRADIENT)
            optimizer.step()
    with torch.no_grad():
        agent.log_std.clamp_(min=training.least_log_std)


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy by PPO."""

    training: tyro.conf.Positional[str]
    """Name of the training: hover, hover-imu, waypoints or race."""
    seed: int = 0
    """Seed of environments and agent."""
    samples: int | None = None
    """Number of steps of environments; that of the training by default."""
    out: Path | None = None
    """Folder for the policy, the learning curve and the evaluation; runs/TRAINING-ppo-SEED by default."""


def policy_of(agent: Agent, sampler: Sampler, seed: int) -> dv.Policy:
    """Return the policy of an agent without noise, and with its scaling of the observations."""
    origin = provenance_of("PPO", sampler.progress.samples, seed)
    return policy_from_torch(agent.actor, sampler.envs, origin, scaling=sampler.seen.scaling())


def main(command: TrainCommand) -> None:
    """Train, write the policy, and evaluate it in unseen episodes."""
    training = TRAININGS[command.training]
    torch.set_num_threads(1)  # the networks are too small for more
    torch.manual_seed(command.seed)
    samples = command.samples or training.samples
    progress, selection = Progress(training.num_envs, samples), Selection(training, samples)
    sampler = Sampler(training, command.seed, progress)
    agent = Agent(training, *sampler.envs.single_observation_space.shape, *sampler.envs.single_action_space.shape)
    optimizer = torch.optim.Adam(agent.parameters(), lr=training.learning_rate, eps=1e-5)
    while progress.samples < samples:
        optimizer.param_groups[0]["lr"] = training.learning_rate * (1.0 - progress.samples / samples)
        update(agent, optimizer, sampler.rollout(agent), training)
        progress.report()
        if selection.is_due(progress.samples):
            selection.offer(policy_of(agent, sampler, command.seed))
    policy = selection.result(policy_of(agent, sampler, command.seed))
    finish(policy, training, progress, command.out or Path("runs") / f"{command.training}-ppo-{command.seed}")


if __name__ == "__main__":
    main(tyro.cli(TrainCommand, description=__doc__))
