"""Progress of a training: the learning curve, and the results that are written at its end."""

import json
import time
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from trainings import VALIDATION_SEED, Training, evaluate

import dronevio as dv

POLICY = "policy.safetensors"
"""Name of the file of the policy in the folder of a training."""
RESULT = "result.json"
"""Name of the file with learning curve and evaluation."""
REPORTS = 60
"""Number of reports of a training."""
IMU_RATE_HZ = 200.0
"""Rate of the IMU and of the inner loops with which policies are flown [Hz]."""


@dataclass(frozen=True)
class Report:
    """Results of the episodes that ended between two reports."""

    samples: int
    """Number of steps of environments since the start."""
    wall_s: float
    """Time since the start [s]."""
    cpu_s: float
    """Processor time since the start [s]."""
    episodes: int
    """Number of episodes that ended."""
    mean_return: float
    """Mean sum of the rewards of an episode."""
    mean_length: float
    """Mean number of steps of an episode."""
    success_rate: float
    """Share of the episodes that ended with success."""
    error_m: float
    """Mean distance from the current goal at the end of an episode [m]."""


class Progress:
    """Learning curve of n environments that are stepped together."""

    def __init__(self, num_envs: int, samples: int) -> None:
        """Start the clocks.

        Args:
            num_envs: Number of environments.
            samples: Number of samples of the training.
        """
        self.samples = 0
        self.reports: list[Report] = []
        self._every = samples // REPORTS
        self._reported = 0
        self._returns, self._lengths = np.zeros(num_envs), np.zeros(num_envs)
        self._ended: list[npt.NDArray[np.float64]] = []
        self._wall_s, self._cpu_s = time.perf_counter(), time.process_time()

    def add(self, rewards: npt.NDArray[Any], ended: npt.NDArray[np.bool_], infos: dict[str, Any]) -> None:
        """Add a step of all environments.

        Args:
            rewards: (n,) Rewards.
            ended: (n,) Whether the episodes end.
            infos: Infos of a vector with autoreset in the same step.
        """
        self.samples += len(rewards)
        self._returns += rewards
        self._lengths += 1
        if ended.any():
            final = infos["final_info"]
            columns = (self._returns, self._lengths, final["success"], final["distance_m"])
            self._ended.append(np.stack([column[ended] for column in columns], axis=1))
            self._returns[ended], self._lengths[ended] = 0.0, 0.0

    def report(self) -> None:
        """Report the episodes since the last report, if there are some and enough samples have been added."""
        if self.samples < self._reported + self._every or not self._ended:
            return
        rows = np.concatenate(self._ended)
        self._ended, self._reported = [], self.samples
        latest = Report(self.samples, *self.elapsed_s, len(rows), *map(float, rows.mean(axis=0)))
        self.reports.append(latest)
        print(
            f"{latest.samples:10,} samples  {latest.wall_s:6.0f} s  return {latest.mean_return:8.2f}  "
            f"success {latest.success_rate:4.0%}  error {latest.error_m:6.3f} m",
            flush=True,
        )

    @property
    def elapsed_s(self) -> tuple[float, float]:
        """Time and processor time since the start [s]."""
        return time.perf_counter() - self._wall_s, time.process_time() - self._cpu_s


class Selection:
    """The best policy of a training, by episodes that are neither those of the training nor those of the evaluation."""

    def __init__(self, training: Training, samples: int) -> None:
        """Begin before the training.

        Args:
            training: The training.
            samples: Number of samples of the training.
        """
        self._training = training
        self._due = [round(samples * k / training.validations) for k in range(1, training.validations)]
        self._best: tuple[tuple[float, float], dv.Policy] | None = None

    def is_due(self, samples: int) -> bool:
        """Return whether the policy after a number of samples should be offered."""
        return bool(self._due) and samples >= self._due[0]

    def offer(self, policy: dv.Policy) -> None:
        """Validate a policy, and keep it if it succeeds more often than those before, or as often with more reward."""
        samples = policy.provenance.samples
        self._due = [due for due in self._due if due > samples]
        found = evaluate(replace(policy, imu_rate_hz=IMU_RATE_HZ), self._training, seed=VALIDATION_SEED)
        rank = float(found.success.mean()), float(found.reward.mean())
        print(f"{samples:10,} samples  validation: success {rank[0]:4.0%}  reward {rank[1]:8.2f}", flush=True)
        if self._best is None or rank >= self._best[0]:
            self._best = rank, policy

    def result(self, last: dv.Policy) -> dv.Policy:
        """Return the best of the policies offered and the last one, which is the result without validations between."""
        if self._best is None:
            return last
        self.offer(last)
        return self._best[1]


def finish(policy: dv.Policy, training: Training, progress: Progress, folder: Path) -> None:
    """Write a policy, evaluate it in unseen episodes, and write learning curve and evaluation."""
    wall_s, cpu_s = progress.elapsed_s
    policy = replace(policy, imu_rate_hz=IMU_RATE_HZ)
    folder.mkdir(parents=True, exist_ok=True)
    dv.save_policy(folder / POLICY, policy)
    evaluation = evaluate(policy, training)
    result = {
        "environment": training.environment,
        "algorithm": policy.provenance.algorithm,
        "seed": policy.provenance.seed,
        "samples": progress.samples,
        "policy_samples": policy.provenance.samples,
        "wall_s": round(wall_s, 1),
        "cpu_s": round(cpu_s, 1),
        "versions": dict(policy.provenance.versions),
        "evaluation": {"episodes": len(evaluation.ends), **evaluation.figures(), "ends": evaluation.counts()},
        "curve": columns_of(progress.reports),
    }
    (folder / RESULT).write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(f"{folder}: {result['evaluation']}")


def columns_of(reports: list[Report]) -> dict[str, str]:
    """Return the values of reports by name, separated by spaces."""
    rows = [asdict(report) for report in reports]
    return {one.name: " ".join(f"{row[one.name]:.6g}" for row in rows) for one in fields(Report)}
