"""A recording that is repeated several times without a break, as a long flight."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.rig import Rig
from dronevio.models.rotation import log_so3
from dronevio.models.state import CameraFrame, Trajectory


@dataclass(frozen=True)
class RepeatedRecording:
    """A recording that is repeated several times; is a `Recording`."""

    inner: Recording
    """Recording of one lap, which begins and ends at the same pose at rest."""
    laps: int
    """Number of repetitions."""

    @property
    def name(self) -> str:
        """Name of the recording with the number of laps."""
        return f"{self.inner.name} × {self.laps}"

    @property
    def rig(self) -> Rig:
        """Calibration of the recording."""
        return self.inner.rig

    @property
    def lap_ns(self) -> int:
        """Duration of a lap: from the first frame to the last, and one frame interval [ns]."""
        t_ns = self.inner.frame_times_ns
        return int(t_ns[-1] - t_ns[0] + np.median(np.diff(t_ns)))

    @property
    def imu(self) -> ImuSamples:
        """IMU samples of all laps, whose biases continue their random walk from lap to lap."""
        one, truth = self.inner.imu, self.inner.ground_truth
        first_ns = int(self.inner.frame_times_ns[0])
        first, last = np.searchsorted(one.t_ns, [first_ns, first_ns + self.lap_ns])
        one = one[int(first) : int(last)]
        change = np.zeros((2, 3))
        if truth is not None and truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None:
            change = np.array([b[-1] - b[0] for b in (truth.gyro_bias_rad_s, truth.accel_bias_m_s2)])
        laps = range(self.laps)
        return ImuSamples(
            np.concatenate([one.t_ns + lap * self.lap_ns for lap in laps]),
            np.concatenate([one.gyro_rad_s + lap * change[0] for lap in laps]),
            np.concatenate([one.accel_m_s2 + lap * change[1] for lap in laps]),
            one.sampling,
        )

    @property
    def frame_times_ns(self) -> npt.NDArray[np.int64]:
        """(N,) Time stamps of the frames of all laps [ns]."""
        return np.concatenate([self.inner.frame_times_ns + lap * self.lap_ns for lap in range(self.laps)])

    @property
    def ground_truth(self) -> Trajectory | None:
        """Ground truth of the first lap."""
        return self.inner.ground_truth

    def frame(self, index: int) -> CameraFrame:
        """Return a frame of the recording with the time stamp of its lap."""
        lap, row = divmod(index, len(self.inner.frame_times_ns))
        frame = self.inner.frame(row)
        return CameraFrame(frame.t_ns + lap * self.lap_ns, frame.images)

    def discontinuity(self) -> tuple[float, float]:
        """Return the distance [m] and the angle [°] between the last pose of a lap and the first pose."""
        truth = self.inner.ground_truth
        if truth is None:
            return float("nan"), float("nan")
        R = truth.rotations
        angle_rad = np.linalg.norm(log_so3(R[0].T @ R[-1]))
        return float(np.linalg.norm(truth.p_world_imu[-1] - truth.p_world_imu[0])), float(np.degrees(angle_rad))
