"""What an estimator made of a recording, frame by frame, and what it cost."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import EvaluationError
from dronevio.models.imu import Times
from dronevio.models.protocols import Recording
from dronevio.models.state import Estimate, FeatureTracks, Health, Trajectory

Array = npt.NDArray[np.float64]

POSE_IS_VALID = frozenset({Health.TRACKING, Health.INERTIAL_ONLY})
"""The healths in which an estimator stands by its pose."""


@dataclass(frozen=True, eq=False)
class EstimatorRun:
    """An estimator's answers to all frames of a recording, in time order."""

    estimates: tuple[Estimate, ...]
    """(M) One for each frame, also for those without a pose."""
    cpu_ms: Array
    """(M,) Processor time of all threads for each frame and the IMU samples before it [ms]."""
    wall_ms: Array
    """(M,) The same by the clock on the wall [ms]."""

    def __post_init__(self) -> None:
        """Check the lengths.

        Raises:
            EvaluationError: The costs do not belong to the estimates.
        """
        m = len(self.estimates)
        if self.cpu_ms.shape != (m,) or self.wall_ms.shape != (m,):
            raise EvaluationError(
                f"a run of {m} estimates with costs of shapes {self.cpu_ms.shape}, {self.wall_ms.shape};"
                f" expected ({m},), ({m},)"
            )

    @property
    def t_ns(self) -> Times:
        """(M,) Time stamps of the frames [ns]."""
        return np.array([estimate.t_ns for estimate in self.estimates], dtype=np.int64)

    @property
    def trajectory(self) -> Trajectory:
        """The poses that the estimator stands by: what is scored."""
        return Trajectory.from_states(
            estimate.state
            for estimate in self.estimates
            if estimate.health in POSE_IS_VALID and estimate.state is not None
        )

    @property
    def real_time_factor(self) -> float:
        """How many seconds of flight are estimated in one second of processor time; above 1 keeps up on one core."""
        span_s = float(np.ptp(self.t_ns)) * 1e-9 if len(self.estimates) else 0.0
        spent_s = float(self.cpu_ms.sum()) * 1e-3
        return span_s / spent_s if spent_s > 0.0 else float("inf")

    @property
    def n_tracks(self) -> npt.NDArray[np.int64]:
        """(M,) How many features were followed into each frame."""
        return np.array([len(tracks_of(estimate).ids) for estimate in self.estimates], dtype=np.int64)

    def check_belongs_to(self, recording: Recording) -> None:
        """Check that this run answers the frames of a recording.

        Raises:
            EvaluationError: The estimates' time stamps are not those of the frames.
        """
        if not np.array_equal(self.t_ns, recording.frame_times_ns):
            raise EvaluationError(
                f"{len(self.estimates)} estimates that are not stamped like the {len(recording.frame_times_ns)} frames"
                f" of {recording.name}"
            )


def tracks_of(estimate: Estimate) -> FeatureTracks:
    """Return an estimate's tracks, none of them where it has none."""
    if estimate.tracks is not None:
        return estimate.tracks
    return FeatureTracks(np.zeros(0, np.int64), np.zeros((0, 2)), np.zeros(0, np.int64))
