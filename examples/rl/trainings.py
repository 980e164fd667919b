"""Settings of the trainings: environment, episodes and algorithm of each policy.

Both trainers, `ppo.py` and `train_sb3.py`, use them.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import gymnasium

import dronevio as dv
from dronevio.sim.envs import MODERATE, Race

EVALUATION_SEED, VALIDATION_SEED = 1_000_000, 2_000_000
"""Seeds of the episodes in which the result of a training is evaluated, and from which it is selected."""


@dataclass(frozen=True)
class Training:
    """Training of a policy by proximal policy optimization (PPO)."""

    environment: str
    """Id of the environment."""
    samples: int
    """Number of steps of environments, all together."""
    arguments: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the environment, in training and evaluation."""
    of_training: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments in training only."""
    of_evaluation: Mapping[str, Any] = field(default_factory=dict)
    """Further arguments in evaluation only."""
    num_envs: int = 256
    """Number of environments that are stepped together."""
    rollout_steps: int = 32
    """Number of steps of each environment between two updates of the policy."""
    minibatch: int = 2048
    """Number of samples of a step of the optimizer."""
    epochs: int = 5
    """Number of passes through the samples of a rollout."""
    learning_rate: float = 1e-3
    """Step size of Adam at the beginning, which decreases linearly to 0."""
    gamma: float = 0.98
    """Discount factor of a step."""
    gae_lambda: float = 0.95
    """Exponential weight of generalized advantage estimation."""
    clip: float = 0.2
    """Range of the ratio of probabilities of the new and the old policy around 1."""
    log_std: float = -1.0
    """Logarithm of the standard deviation of the actions at the beginning."""
    least_log_std: float = -math.inf
    """Smallest logarithm of the standard deviation of the actions during training."""
    validations: int = 1
    """Number of times at which the policy is validated, at equal intervals up to the end of the training. The result is
    the best of these policies."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of policy and value function."""


# Lower rates of the physics and of the inner loops cost half as much. Policies are evaluated at 200 Hz.
_FASTER = {"imu_rate_hz": 100.0}

TRAININGS: dict[str, Training] = {
    "hover": Training(
        "dronevio/Hover-v0",
        samples=800_000,
        arguments={"action": "rotors", "observations": ("position", "rotation", "velocity", "rate")},
        of_training={"max_episode_steps": 150, **_FASTER},
    ),
    "hover-imu": Training(
        "dronevio/Hover-v0",
        samples=1_500_000,
        arguments={
            "action": "rotors",
            "observations": ("position", "rotation", "velocity", "imu", "last_action"),
            "randomization": MODERATE,
        },
        of_training={"max_episode_steps": 150},
    ),
    "waypoints": Training("dronevio/Waypoints-v0", samples=4_000_000, of_training=_FASTER, gamma=0.99),
    "race": Training(
        "dronevio/Race-v0",
        samples=8_000_000,
        of_training={"max_episode_steps": 500, **_FASTER},
        of_evaluation={"task": Race(on_course=0.0)},
        num_envs=512,
        gamma=0.99,
        least_log_std=-1.2,  # otherwise exploration ends before all gates are passed
        validations=16,  # the share of finished races rises and falls by some percent until the end
    ),
}
"""Trainings by name."""


def training_envs(training: Training) -> Any:
    """Return the vector of environments of a training, which resets environments in the step that ends an episode."""
    arguments = {**training.arguments, **training.of_training}
    return gymnasium.make_vec(
        f"dronevio.envs:{training.environment}", training.num_envs, autoreset_mode="SAME_STEP", flat=True, **arguments
    )


def evaluate(
    policy: dv.Policy, training: Training, episodes: int = 100, seed: int = EVALUATION_SEED
) -> dv.PolicyEvaluation:
    """Return the results of a policy in unseen episodes of the environment of a training."""
    arguments = {name: value for name, value in training.arguments.items() if name != "observations"}
    return dv.evaluate_policy(
        policy, episodes, seed, environment=training.environment, **arguments, **training.of_evaluation
    )
