"""Between keyframes: the newest keyframe's state, carried forward by the IMU."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from dronevio.estimator.imu.buffer import Increments, integrate
from dronevio.estimator.imu.covariance import propagate
from dronevio.estimator.initialization.dynamic import Sighting
from dronevio.models.imu import ImuModel
from dronevio.models.state import NavState

SETTLED_S = 0.2
"""A motion that begins is seen so late at the most [s]: it takes half a pixel, some millimetres."""


def settled_and_recent(rest: Sequence[Sighting]) -> tuple[list[Sighting], list[Sighting]]:
    """Divide the frames of a rest into those at which the drone surely stood still, and those since."""
    settled = [s for s in rest if (rest[-1].t_ns - s.t_ns) * 1e-9 >= SETTLED_S]
    return settled, list(rest[len(settled) :])


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
        self._params = params
        self.restart(())

    def add(self, increments: Increments) -> None:
        """Take the IMU since the last call."""
        integrate(self._preintegrated, increments, self._params)
        self._is_doubtful |= increments.is_doubtful

    def restart(self, parts: Sequence[Increments]) -> None:
        """Begin at the keyframe again, with some of the IMU since."""
        self._preintegrated = gtsam.PreintegratedCombinedMeasurements(self._params, self._bias)
        self._is_doubtful = False
        for increments in parts:
            self.add(increments)

    @property
    def preintegrated(self) -> gtsam.PreintegratedCombinedMeasurements:
        """The IMU since the keyframe."""
        return self._preintegrated

    @property
    def is_doubtful(self) -> bool:
        """Whether a sensor has been at its limit since the keyframe, or without samples for long."""
        return self._is_doubtful

    @property
    def elapsed_s(self) -> float:
        """Time since the keyframe [s]."""
        return float(self._preintegrated.deltaTij())

    def state_at(self, t_ns: int, rest: Sequence[Sighting] = ()) -> NavState:
        """Return the state where the preintegrated IMU ends, which is at ``t_ns``.

        Args:
            t_ns: Time of the state.
            rest: The frames since the keyframe, if the drone seems not to have moved since. It is then where the
                keyframe was, but for what the IMU says of the last moments. The IMU alone would let it drift by a
                centimetre in half a second.
        """
        settled, recent = settled_and_recent(rest)
        if settled:
            held = replace(self._start, t_ns=settled[-1].t_ns, velocity_m_s=np.zeros(3))
            nav = gtsam.NavState(self._nav.pose(), np.zeros(3))
            last = Propagation(self._params, self._imu, held, (nav, self._bias))
            last.restart([sighting.increments for sighting in recent])
            return last.state_at(t_ns)
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
                noise=pim.preintMeasCov()[:9, :9],
            )
        return NavState(
            t_ns, now.pose().matrix(), now.velocity(), start.gyro_bias_rad_s, start.accel_bias_m_s2, covariance
        )
