"""Train a policy with Stable-Baselines3, by the settings of `ppo.py`.

```console
python train_sb3.py hover --seed 1
```
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from progress import Progress, Selection, finish
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from trainings import TRAININGS, Training, training_envs

from dronevio.sim.envs import policy_from_sb3
from dronevio.sim.envs.stable_baselines import StableBaselinesVecEnv


class Curve(BaseCallback):
    """Learning curve of a model, from the unscaled rewards of the environments, with the selection of its best policy.

    It also limits the standard deviation of the actions, for which Stable-Baselines3 has no setting.
    """

    def __init__(self, progress: Progress, selection: Selection, envs: Any, least_log_std: float) -> None:
        super().__init__()
        self._progress, self._selection, self._envs = progress, selection, envs
        self._least_log_std = least_log_std

    def _on_rollout_start(self) -> None:
        if self._selection.is_due(self._progress.samples):
            self._selection.offer(policy_from_sb3(self.model, self._envs))
        with torch.no_grad():
            self.model.policy.log_std.clamp_(min=self._least_log_std)

    def _on_step(self) -> bool:
        ended = self.locals["dones"]
        infos = [self.locals["infos"][row] for row in np.flatnonzero(ended)]
        final = {name: np.zeros(len(ended)) for name in ("success", "distance_m")}
        for name, values in final.items():
            values[ended] = [info[name] for info in infos]
        self._progress.add(self.training_env.get_original_reward(), ended, {"final_info": final})
        return True

    def _on_rollout_end(self) -> None:
        self._progress.report()


def model_of(training: Training, envs: Any, seed: int) -> PPO:
    """Return an untrained model with the settings of a training."""
    scaled = VecNormalize(StableBaselinesVecEnv(envs), gamma=training.gamma)
    layers = list(training.hidden)
    return PPO(
        "MlpPolicy",
        scaled,
        n_steps=training.rollout_steps,
        batch_size=training.minibatch,
        n_epochs=training.epochs,
        learning_rate=lambda remaining: training.learning_rate * remaining,
        gamma=training.gamma,
        gae_lambda=training.gae_lambda,
        clip_range=training.clip,
        policy_kwargs={"log_std_init": training.log_std, "net_arch": {"pi": layers, "vf": layers}},
        seed=seed,
        device="cpu",
    )


@dataclass(frozen=True)
class TrainCommand:
    """Train a policy with Stable-Baselines3."""

    training: tyro.conf.Positional[str]
    """Name of the training: hover, hover-imu, waypoints or race."""
    seed: int = 0
    """Seed of environments and agent."""
    samples: int | None = None
    """Number of steps of environments; that of the training by default."""
    out: Path | None = None
    """Folder for the policy, the learning curve and the evaluation; runs/TRAINING-sb3-SEED by default."""


def main(command: TrainCommand) -> None:
    """Train, write the policy, and evaluate it in unseen episodes."""
    training = TRAININGS[command.training]
    torch.set_num_threads(1)  # the networks are too small for more
    envs = training_envs(training)
    samples = command.samples or training.samples
    progress, selection = Progress(training.num_envs, samples), Selection(training, samples)
    model = model_of(training, envs, command.seed)
    model.learn(samples, callback=Curve(progress, selection, envs, training.least_log_std))
    policy = selection.result(policy_from_sb3(model, envs))
    finish(policy, training, progress, command.out or Path("runs") / f"{command.training}-sb3-{command.seed}")


if __name__ == "__main__":
    main(tyro.cli(TrainCommand, description=__doc__))
