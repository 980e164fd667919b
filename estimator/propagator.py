"""Propagation of the newest keyframe's state by the IMU, up to the next keyframe.

While the vehicle is stationary, the frames since the keyframe are kept: the start of a motion is detected late, so the
keyframe that ends the stationary interval belongs at the last frame at which the vehicle was certainly stationary.
"""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np

from dronevio.estimator.backend.keyframes import KeyframePolicy
from dronevio.estimator.backend.smoother import KeyframeSmoother
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.imu.covariance import propagate_covariance
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationParams
from dronevio.estimator.initialization.zero_velocity import MOTION_DETECTION_DELAY_S
from dronevio.estimator.types import FramePacket, Observations
from dronevio.models.imu import ImuModel
from dronevio.models.state import NavState

MAX_STATIONARY_SIGMAS = 5.0
"""A vehicle whose velocity at the keyframe differs from zero by more standard deviations than this is not stationary,
whatever the image shows."""


class ImuPropagation:
    """Preintegrates the IMU from a keyframe on and predicts the state from it."""

    def __init__(
        self,
        params: PreintegrationParams,
        imu: ImuModel,
        state: NavState,
        gtsam_state: tuple[gtsam.NavState, gtsam.imuBias.ConstantBias],
    ) -> None:
        """Begin at a keyframe.

        Args:
            params: The noise of the preintegration.
            imu: The sensor model, for the random walks of the covariance.
            state: The keyframe's state.
            gtsam_state: The same state and its biases as GTSAM's objects.
        """
        self._params, self._imu, self._state = params, imu, state
        self._nav, self._bias = gtsam_state
        self._preintegration = Preintegration(params, self._bias)
        self._is_degraded = False

    def add(self, increments: Increments) -> None:
        """Append IMU increments."""
        self._preintegration.integrate(increments)
        self._is_degraded |= increments.is_degraded

    def restarted(self, parts: Sequence[Increments]) -> "ImuPropagation":
        """Return a propagation from the same keyframe over other increments."""
        restarted = ImuPropagation(self._params, self._imu, self._state, (self._nav, self._bias))
        for increments in parts:
            restarted.add(increments)
        return restarted

    @property
    def preintegrated(self) -> gtsam.PreintegratedCombinedMeasurements:
        """The preintegrated measurements since the keyframe."""
        return self._preintegration.measurements

    @property
    def is_degraded(self) -> bool:
        """Whether a sensor has been saturated, or has had a gap, since the keyframe."""
        return self._is_degraded

    @property
    def elapsed_s(self) -> float:
        """Time since the keyframe [s]."""
        return self._preintegration.duration_s

    def state_at(self, t_ns: int, stationary: Sequence[FramePacket] = ()) -> NavState:
        """Return the predicted state at the end of the increments.

        Args:
            t_ns: Time of that end [ns].
            stationary: The frames since the keyframe, if the vehicle appears stationary since. The state is then that
                of the keyframe, propagated over the last moments only; the IMU alone drifts by a centimetre in half a
                second.
        """
        settled, recent = _settled_and_recent(stationary)
        if settled:
            held = replace(self._state, t_ns=settled[-1].t_ns, velocity_m_s=np.zeros(3))
            nav = gtsam.NavState(self._nav.pose(), np.zeros(3))
            last = ImuPropagation(self._params, self._imu, held, (nav, self._bias))
            return last.restarted([packet.increments for packet in recent]).state_at(t_ns)
        start, pim = self._state, self._preintegration.measurements
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

    def predicted(self, t_ns: int, increments: Increments) -> NavState:
        """Return the predicted state after further increments, which are not added, without covariance.

        Args:
            t_ns: Time of their end [ns].
            increments: The increments after those that are added.
        """
        now = self._preintegration.measurements.predict(self._nav, self._bias)
        further = Preintegration(self._params, self._bias)
        further.integrate(increments)
        end, start = further.measurements.predict(now, self._bias), self._state
        return NavState(t_ns, end.pose().matrix(), end.velocity(), start.gyro_bias_rad_s, start.accel_bias_m_s2)


def propagated(state: NavState, increments: Increments, params: PreintegrationParams, imu: ImuModel) -> NavState:
    """Return a state with its covariance, propagated by IMU increments that begin at its time."""
    nav = gtsam.NavState(gtsam.Pose3(state.T_world_imu), state.velocity_m_s)
    bias = gtsam.imuBias.ConstantBias(state.accel_bias_m_s2, state.gyro_bias_rad_s)
    propagation = ImuPropagation(params, imu, state, (nav, bias))
    propagation.add(increments)
    return propagation.state_at(state.t_ns + round(increments.duration_s * 1e9))


class Propagator:
    """The interval from the newest keyframe to the next: prediction, stationarity, and when it ends."""

    def __init__(
        self,
        params: PreintegrationParams,
        imu: ImuModel,
        policy: KeyframePolicy,
        smoother: KeyframeSmoother,
        observations: Observations,
    ) -> None:
        """Begin at the smoother's newest keyframe, with its biases.

        Args:
            params: The noise of the preintegration.
            imu: The sensor model.
            policy: Decides when a frame becomes a keyframe.
            smoother: Provides the keyframe's state.
            observations: The features of the keyframe.
        """
        self._propagation = ImuPropagation(params, imu, smoother.state, smoother.gtsam_state)
        self._policy = policy
        self._may_be_stationary = velocity_may_be_zero(smoother.state)
        self._stationary: list[FramePacket] = []  # the frames since the keyframe, if stationary since
        policy.set_reference(observations)

    @property
    def preintegrated(self) -> gtsam.PreintegratedCombinedMeasurements:
        """The preintegrated measurements since the keyframe."""
        return self._propagation.preintegrated

    @property
    def is_degraded(self) -> bool:
        """Whether a sensor of the IMU has been saturated, or has had a gap, since the keyframe."""
        return self._propagation.is_degraded

    def would_be_stationary(self, packet: FramePacket) -> bool:
        """Return whether the vehicle is stationary from the keyframe up to a frame that is not added yet."""
        elapsed_s = self._propagation.elapsed_s + packet.increments.duration_s
        return self._may_be_stationary and self._policy.is_stationary(elapsed_s, packet.stationary_s)

    def add(self, packet: FramePacket, stationary: bool = False) -> None:
        """Add the next frame, and whether the vehicle is stationary from the keyframe up to it."""
        self._propagation.add(packet.increments)
        if stationary:
            self._stationary.append(packet)

    def state_at(self, t_ns: int) -> NavState:
        """Return the predicted state at the last frame, whose time is ``t_ns``."""
        return self._propagation.state_at(t_ns, self._stationary)

    def predicted(self, t_ns: int, increments: Increments) -> NavState:
        """Return the predicted state after further increments, which are not added; see `ImuPropagation.predicted`."""
        return self._propagation.predicted(t_ns, increments)

    def is_keyframe_due(self, packet: FramePacket, innovation_px: float | None) -> bool:
        """Return whether the last frame becomes a keyframe; see `KeyframePolicy.is_due`."""
        stationary_s = packet.stationary_s if self._may_be_stationary else 0.0
        frame_s, elapsed_s = packet.increments.duration_s, self._propagation.elapsed_s
        return self._policy.is_due(elapsed_s, frame_s, stationary_s, packet.observations, innovation_px)

    @property
    def elapsed_s(self) -> float:
        """Time from the keyframe to the last frame [s]."""
        return self._propagation.elapsed_s

    def end_stationary(self) -> tuple[FramePacket | None, list[FramePacket]]:
        """Return to the last frame at which the vehicle was certainly stationary, if there is one since the keyframe.

        Returns:
            That frame, and the later ones, which are removed from the interval.
        """
        settled, recent = _settled_and_recent(self._stationary)
        self._stationary = []
        if not settled:
            return None, []
        self._propagation = self._propagation.restarted([packet.increments for packet in settled])
        return settled[-1], recent


def _settled_and_recent(stationary: Sequence[FramePacket]) -> tuple[list[FramePacket], list[FramePacket]]:
    """Divide stationary frames into those before the detection delay and those within it."""
    settled = [p for p in stationary if (stationary[-1].t_ns - p.t_ns) * 1e-9 >= MOTION_DETECTION_DELAY_S]
    return settled, list(stationary[len(settled) :])


def velocity_may_be_zero(state: NavState) -> bool:
    """Return whether zero velocity is consistent with a state and its covariance."""
    if state.covariance is None:
        return True
    v, P = state.velocity_m_s, state.covariance[6:9, 6:9]
    if v @ v > 1.01 * MAX_STATIONARY_SIGMAS**2 * np.trace(P):  # beyond the limit whatever the direction
        return False
    return bool(v @ np.linalg.solve(P, v) < MAX_STATIONARY_SIGMAS**2)
