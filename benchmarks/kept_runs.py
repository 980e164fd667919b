"""Runs of the odometry that are kept in files: health, causes and poses with covariances, without measurements."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from dronevio.eval.run import EstimatorRun
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.state import Trajectory

Texts = npt.NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class KeptRun:
    """What a run has published."""

    t_ns: Times
    """(M,) Time stamps of all frames [ns]."""
    health: Texts
    """(M,) Health of all frames."""
    cause: Texts
    """(M,) Names of its causes."""
    nis: Array
    """(M,) NIS of all frames; NaN where there is none."""
    trajectory: Trajectory
    """The valid poses, with covariances."""
    warnings: tuple[str, ...]
    """Warnings."""

    @classmethod
    def of(cls, run: EstimatorRun) -> "KeptRun":
        """Return what is kept of a run."""
        reports = [e.health_report for e in run.estimates]
        causes = [getattr(r.cause, "name", "") if r is not None else "" for r in reports]
        nis = [r.innovation_nis if r is not None and r.innovation_nis is not None else np.nan for r in reports]
        health = np.array([str(e.health) for e in run.estimates])
        warnings = tuple(text for _, text in run.warnings)
        return cls(run.t_ns, health, np.array(causes), np.array(nis), run.trajectory, warnings)

    def rows(self) -> npt.NDArray[np.int64]:
        """Return the indices (N,) of the frames of the poses."""
        return np.searchsorted(self.t_ns, self.trajectory.t_ns)

    def save(self, file: Path) -> None:
        """Write to a file."""
        kept = self.trajectory
        parts: dict[str, Any] = {
            "t_ns": self.t_ns,
            "health": self.health,
            "cause": self.cause,
            "nis": self.nis,
            "warnings": np.array(self.warnings, dtype=str),
            "pose_t_ns": kept.t_ns,
            "p": kept.p_world_imu,
            "quat": kept.quat_wxyz,
            "velocity": kept.velocity_m_s,
            "gyro_bias": kept.gyro_bias_rad_s,
            "accel_bias": kept.accel_bias_m_s2,
            "covariance": kept.covariance,
        }
        np.savez_compressed(file, **{name: value for name, value in parts.items() if value is not None})

    @classmethod
    def load(cls, file: Path) -> "KeptRun":
        """Read from a file."""
        with np.load(file) as parts:
            names = ("pose_t_ns", "p", "quat", "velocity", "gyro_bias", "accel_bias", "covariance")
            poses = [parts.get(name) for name in names]
            trajectory = Trajectory(*poses)
            warnings = tuple(map(str, parts["warnings"]))
            return cls(parts["t_ns"], parts["health"], parts["cause"], parts["nis"], trajectory, warnings)


def joined(arrays: Sequence[Array]) -> Array:
    """Return arrays (N, …) in succession, empty without any."""
    return np.concatenate(arrays) if len(arrays) else np.zeros(0)
