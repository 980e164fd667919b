"""The interval since the newest keyframe: what the IMU says of it, whether the drone has moved, and when it is over.

While the drone stands still, frames are remembered: the rest is known to last until the motion that ends it is seen, so
that the keyframe after it belongs at the last frame at which the drone surely stood still.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.estimator.imu.preintegration import integrate
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.imu import ImuModel
from dronevio.models.state import NavState

SETTLED_S = 0.2
"""A motion that begins is seen so late at the most [s]: it takes half a pixel, some millimetres."""


def settled_and_recent(rest: Sequence[FramePacket]) -> tuple[list[FramePacket], list[FramePacket]]:
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
        self._is_doubtful |= increments.is_degraded

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
    def is_degraded(self) -> bool:
        """Whether a sensor has been at its limit since the keyframe, or without samples for long."""
        return self._is_doubtful

    @property
    def elapsed_s(self) -> float:
        """Time since the keyframe [s]."""
        return float(self._preintegrated.deltaTij())

    def state_at(self, t_ns: int, rest: Sequence[FramePacket] = ()) -> NavState:
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
            last.restart([packet.increments for packet in recent])
            return last.state_at(t_ns)
        start, pim = self._start, self._preintegrated
        now = pim.predict(self._nav, self._bias)
        covariance = start.covariance
        if covariance is not None:
            covariance = propagate_covariance(
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


MAX_REST_SIGMAS = 5.0
"""A keyframe whose velocity is further from zero than this is not at rest, however little the image moves [standard
deviations]. Velocities are known to 2 mm/s on simulated flights: a centimetre a second is motion. Standing drones were
below 4."""


class Interval:
    """Time since a keyframe, frame by frame."""

    def __init__(
        self,
        params: gtsam.PreintegrationCombinedParams,
        imu: ImuModel,
        policy: KeyframePolicy,
        smoother: KeyframeSmoother,
        observations: Observations,
    ) -> None:
        """Begin at the newest keyframe, with its biases.

        Args:
            params: How the IMU is preintegrated.
            imu: Its noise densities.
            policy: When a frame becomes a keyframe.
            smoother: Knows the keyframe's state.
            observations: What the keyframe sees.
        """
        self._propagation = Propagation(params, imu, smoother.state, smoother.gtsam_state)
        self._policy = policy
        self._may_rest = _is_slow(smoother.state)
        self._rest: list[FramePacket] = []  # frames since the keyframe, if the drone has not moved since
        policy.set_reference(observations)

    @property
    def preintegrated(self) -> gtsam.PreintegratedCombinedMeasurements:
        """The IMU since the keyframe."""
        return self._propagation.preintegrated

    @property
    def is_degraded(self) -> bool:
        """Whether a sensor of the IMU has been at its limit since the keyframe, or without samples for long."""
        return self._propagation.is_degraded

    def would_be_stationary(self, packet: FramePacket, stationary_s: float) -> bool:
        """Say whether the drone has not moved from the keyframe up to a frame that is not added yet.

        Args:
            packet: The frame.
            stationary_s: For how long the image has not moved [s].
        """
        elapsed_s = self._propagation.elapsed_s + float(packet.increments.dt_s.sum())
        return self._may_rest and self._policy.is_stationary(elapsed_s, stationary_s)

    def add(self, packet: FramePacket, still: bool = False) -> None:
        """Take the next frame, and whether the drone has not moved from the keyframe up to it."""
        self._propagation.add(packet.increments)
        if still:
            self._rest.append(packet)

    def state_at(self, t_ns: int) -> NavState:
        """Return the state at the last frame, which is at ``t_ns``."""
        return self._propagation.state_at(t_ns, self._rest)

    def is_over(self, stationary_s: float, observations: Observations, innovation_px: float | None) -> bool:
        """Say whether the last frame becomes a keyframe; see `KeyframePolicy.is_due`."""
        stationary_s = stationary_s if self._may_rest else 0.0
        return self._policy.is_due(self._propagation.elapsed_s, stationary_s, observations, innovation_px)

    def cut_to_rest(self) -> tuple[FramePacket | None, list[FramePacket]]:
        """Go back to the last frame at which the drone surely stood still, if there is one since the keyframe.

        Returns:
            That frame, and those since, which are cut off.
        """
        settled, recent = settled_and_recent(self._rest)
        self._rest = []
        if not settled:
            return None, []
        self._propagation.restart([packet.increments for packet in settled])
        return settled[-1], recent


def _is_slow(state: NavState) -> bool:
    """Say whether a state may be one of rest, by its velocity and how sure that is."""
    if state.covariance is None:
        return True
    v, P = state.velocity_m_s, state.covariance[6:9, 6:9]
    return bool(v @ np.linalg.solve(P, v) < MAX_REST_SIGMAS**2)
