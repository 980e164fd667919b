"""Between keyframes: the newest keyframe's state, carried forward by the IMU."""

import gtsam

from dronevio.estimator.covariance import propagate
from dronevio.estimator.inertial import Increments, integrate
from dronevio.models.imu import ImuModel
from dronevio.models.state import NavState


class Propagation:
    """Preintegrates the IMU from a keyframe on, and dead-reckons the keyframe's state over it."""

    def __init__(
        self,
        params: gtsam.PreintegrationCombinedParams,
        imu: ImuModel,
        state: NavState,
        gtsam_state: tuple[gtsam.NavState, gtsam.imuBias.ConstantBias],
    ) -> None:
        """Begin at a keyframe.

        Args:
            params: How to preintegrate.
            imu: Noise densities.
            state: The keyframe's state.
            gtsam_state: The same, and its biases, for GTSAM.
        """
        self._imu, self._start = imu, state
        self._nav, self._bias = gtsam_state
        self._preintegrated = gtsam.PreintegratedCombinedMeasurements(params, self._bias)

    def add(self, increments: Increments) -> None:
        """Take the IMU since the last call."""
        integrate(self._preintegrated, increments)

    @property
    def preintegrated(self) -> gtsam.PreintegratedCombinedMeasurements:
        """The IMU since the keyframe."""
        return self._preintegrated

    @property
    def elapsed_s(self) -> float:
        """Time since the keyframe [s]."""
        return float(self._preintegrated.deltaTij())

    def state_at(self, t_ns: int) -> NavState:
        """Return the state where the preintegrated IMU ends, which is at ``t_ns``."""
        start, pim = self._start, self._preintegrated
        now = pim.predict(self._nav, self._bias)
        covariance = start.covariance
        if covariance is not None:
            covariance = propagate(
                covariance,
                start.T_world_imu[:3, :3],
                dR=pim.deltaRij().matrix(),
                dp=pim.deltaPij(),
                dv=pim.deltaVij(),
                dt_s=pim.deltaTij(),
                imu=self._imu,
            )
        return NavState(
            t_ns, now.pose().matrix(), now.velocity(), start.gyro_bias_rad_s, start.accel_bias_m_s2, covariance
        )
