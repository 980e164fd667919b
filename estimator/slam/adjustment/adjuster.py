"""Bundle adjustment of a map during the flight, in a process of its own or in that of the map.

It takes many times the interval between two keyframes. Its result takes effect a number of keyframes later, which
depends on numbers of keyframes alone (`schedule`).
"""

import os
import signal
import threading
import time
from collections.abc import Mapping
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import connection, get_context, parent_process
from typing import Protocol

from dronevio.estimator.slam.adjustment.agreement import differences
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentConfig, AdjustmentInputs, Scale, adjust
from dronevio.estimator.slam.adjustment.odometry_scale import with_scale_of_odometry
from dronevio.models.arrays import Array

MAX_NOISE_RATIO = 1.4
"""Ratio of the accelerometer's estimated noise to its data sheet up to which the IMU may determine the scale. It is
0.75 to 1.26 for IMUs that keep their data sheet, 1.6 to 2 for three times its noise, and 8 to 17 on EuRoC's flights."""


@dataclass(frozen=True, eq=False)
class AdjustmentOutcome:
    """The outcome of a bundle adjustment of a map."""

    poses: Mapping[int, Array] | None
    """Adjusted poses (4, 4) by the numbers of the keyframes; None if the adjusted map is not used."""
    text: str
    """Source of the scale, or the reason why the adjusted map is not used."""


class Adjuster(Protocol):
    """Adjusts one map at a time."""

    @property
    def cpu_s(self) -> float:
        """Processor time of the results so far, if it is not that of this process [s]."""

    def start(self, inputs: AdjustmentInputs, /) -> None:
        """Begin an adjustment."""

    def result(self) -> AdjustmentOutcome | None:
        """Return the outcome, once; None if no adjustment has been started."""


class LocalAdjuster:
    """Adjusts a map when the result is due, in the same process."""

    def __init__(self, config: AdjustmentConfig) -> None:
        """Wait for the first adjustment.

        Args:
            config: Settings.
        """
        self._config = config
        self._inputs: AdjustmentInputs | None = None

    @property
    def cpu_s(self) -> float:
        """Zero: the processor time is that of this process."""
        return 0.0

    def start(self, inputs: AdjustmentInputs) -> None:
        """Keep the measurements."""
        self._inputs = inputs

    def result(self) -> AdjustmentOutcome | None:
        """Return the outcome; see `Adjuster`."""
        inputs, self._inputs = self._inputs, None
        return None if inputs is None else solved(inputs, self._config)


class ProcessAdjuster:
    """Adjusts a map in another process, which starts with the first adjustment and ends with this one."""

    def __init__(self, config: AdjustmentConfig) -> None:
        """Prepare the process.

        Args:
            config: Settings.
        """
        self._config = config
        self._pool = ProcessPoolExecutor(1, get_context("spawn"), initializer=_end_with_parent)
        self._future: Future[tuple[AdjustmentOutcome, float]] | None = None
        self._cpu_s = 0.0

    @property
    def cpu_s(self) -> float:
        """Processor time of the results so far [s]."""
        return self._cpu_s

    def start(self, inputs: AdjustmentInputs) -> None:
        """Begin an adjustment in the other process."""
        self._future = self._pool.submit(_timed, inputs, self._config)

    def result(self) -> AdjustmentOutcome | None:
        """Return the outcome, and wait for it if it is not ready; see `Adjuster`."""
        future, self._future = self._future, None
        if future is None:
            return None
        adjustment, cpu_s = future.result()
        self._cpu_s += cpu_s
        return adjustment


def solved(inputs: AdjustmentInputs, config: AdjustmentConfig) -> AdjustmentOutcome:
    """Return the adjusted map that agrees with the odometry and a loaded map, with the scale by the IMU if possible.

    With one camera, the IMU determines the scale of the map where its noise is that of its data sheet and the result
    agrees with the odometry; otherwise the odometry does. See `bundle_adjustment` and `agreement`.

    Args:
        inputs: The measurements.
        config: Settings.
    """
    is_mono = len(inputs.calibration.Ts_imu_cam) == 1
    scales = (Scale.ODOMETRY,) if is_mono and is_noisy(inputs) else (Scale.IMU, Scale.ODOMETRY)
    reasons = []
    for scale in scales:
        try:
            adjusted = adjust(inputs, config, scale)
        except RuntimeError:  # by GTSAM
            reasons.append("the linear system is singular")
            continue
        contradicting = [str(each) for each in differences(inputs, adjusted) if not each.agrees]
        if not contradicting:
            saved = "" if inputs.saved is None else " and the loaded map"
            is_scaled = is_mono and scale is Scale.ODOMETRY
            poses = with_scale_of_odometry(inputs, adjusted.poses) if is_scaled else adjusted.poses
            return AdjustmentOutcome(poses, f"scale by the {scale}{saved}")
        reasons += contradicting
    return AdjustmentOutcome(None, f"not used: {reasons[-1]}")


def is_noisy(inputs: AdjustmentInputs) -> bool:
    """Return whether the accelerometer is too noisy in this flight to determine the scale."""
    sheet = inputs.imu_model.accel_noise_density
    return inputs.params.accel_variance > (MAX_NOISE_RATIO * sheet) ** 2


def _timed(inputs: AdjustmentInputs, config: AdjustmentConfig) -> tuple[AdjustmentOutcome, float]:
    """Return the outcome and the processor time [s]."""
    start_s = time.process_time()
    return solved(inputs, config), time.process_time() - start_s


def _end_with_parent() -> None:
    """Let this process end with the one that has started it, and only then."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=_wait_and_end, args=(parent.sentinel,), daemon=True).start()


def _wait_and_end(sentinel: int) -> None:
    connection.wait([sentinel])
    os._exit(1)
