"""The sliding window: keyframe states, the factors and landmarks that constrain them, and the marginal prior.

A window is mutable: it holds the current estimates and adds and removes information on them. What is minimized at any
time is its `objective`.

The prior is computed when it is first needed. After a keyframe was marginalized, that is the next keyframe, or a frame
before it that has more time.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence, Set

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from dronevio.estimator.backend.factors import KeyframeFactor, state_values, whitening_matrix
from dronevio.estimator.backend.landmarks import CameraPoses, LandmarkDatabase
from dronevio.estimator.backend.linear_system import LinearSystem, WindowEstimate
from dronevio.estimator.backend.marginal_prior import STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.marginalization import Drift, PendingMarginalization
from dronevio.estimator.backend.observations import NO_OBSERVATIONS, ObservationTable
from dronevio.estimator.backend.recalibration import recalibrated_observations, with_calibration_error
from dronevio.estimator.backend.weighting import image_variance
from dronevio.estimator.backend.window_objective import WindowObjective
from dronevio.estimator.imu.noise import ImuVarianceComponents
from dronevio.estimator.optimization.linalg import CholeskyFactor
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array


class Window:
    """The variables of a sliding window and all information on them."""

    def __init__(
        self,
        start: KeyframeState,
        prior_information: Array,
        landmarks: LandmarkDatabase,
        Ts_imu_cam: Array,
        sigma: float,
        robust_sigmas: float,
    ) -> None:
        """Create a window of one keyframe, number 0.

        Args:
            start: State of the keyframe.
            prior_information: (15, 15) Prior information on the state, in its order.
            landmarks: Observations and landmarks of the window.
            Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras.
            sigma: Standard deviation of an observation, in normalized coordinates.
            robust_sigmas: Threshold of Cauchy's loss in standard deviations, or in median residuals of the keyframe
                where these are larger.
        """
        self.states: dict[int, KeyframeState] = {0: start}
        """Current estimates of the keyframes by their numbers, in increasing order."""
        self.landmarks = landmarks
        """Observations and landmarks of the window."""
        self._known_prior = MarginalPrior(prior_information, np.zeros(STATE_DIM), {0: start})
        self._pending: PendingMarginalization | None = None
        self._factors: list[KeyframeFactor] = []
        self._Ts_imu_cam, self._sigma, self._robust_sigmas = Ts_imu_cam, sigma, robust_sigmas

    @property
    def _prior(self) -> MarginalPrior:
        """The marginal prior without the keyframes that have left the window."""
        self.complete()
        return self._known_prior

    def complete(self) -> None:
        """Compute the marginal prior, if that has not been done since a keyframe was marginalized.

        Raises:
            SingularError: The information on marginalized variables is not positive definite. Each use of the prior
                raises it again.
        """
        if self._pending is not None:
            self._known_prior, self._pending = self._pending.prior(), None

    @property
    def newest(self) -> int:
        """Number of the newest keyframe."""
        return next(reversed(self.states))

    @property
    def persistent(self) -> set[int]:
        """Identities of the persistent landmarks, which are variables of the prior."""
        return set(self._prior.points)

    @property
    def cameras(self) -> CameraPoses:
        """Orientations (C, 3, 3) and positions (C, 3) of the rig's cameras at each keyframe."""
        Ts = {k: state.pose.matrix() @ self._Ts_imu_cam for k, state in self.states.items()}
        return {k: (T[:, :3, :3], T[:, :3, 3]) for k, T in Ts.items()}

    def recalibrate(
        self, before: Calibration, after: Calibration, rates_rad_s: Mapping[int, Array], covariance: Array
    ) -> None:
        """Replace the calibration.

        Args:
            before: The previous calibration.
            after: The new calibration.
            rates_rad_s: (3,) Angular velocities of keyframes in the IMU frame, bias removed [rad/s].
            covariance: (15, 15) Diagonal covariance of the error that the previous calibration has left in the states,
                in the order of `NavState`.

        Raises:
            SingularError: The information on landmarks that are not observed any more is not positive definite.
        """
        observations = recalibrated_observations(self.landmarks, self.states, rates_rad_s, before, after)
        self._Ts_imu_cam = after.Ts_imu_cam
        self.landmarks.replace_observations(observations)
        prior = self._prior.without_points(self.persistent - set(self.landmarks.ids.tolist()))
        delay_s = after.time_offset_correction_s - before.time_offset_correction_s
        self._known_prior = with_calibration_error(prior, covariance, rates_rad_s, delay_s)

    def append(self, state: KeyframeState, factors: Iterable[gtsam.NoiseModelFactor]) -> None:
        """Add a keyframe, and the factors between it and others."""
        self.states[self.newest + 1] = state
        self._factors += map(KeyframeFactor.of, factors)

    def reweight_newest(self, weight: float) -> None:
        """Multiply the information of the factors of the newest keyframe by a weight."""
        self._factors = [
            each._replace(weight=weight) if self.newest in each.keyframes else each for each in self._factors
        ]

    @property
    def objective(self) -> WindowObjective:
        """All information on the variables of the window."""
        return self._objective(self._factors, self.landmarks.observations)

    @property
    def estimate(self) -> WindowEstimate:
        """Current estimates of the keyframes and of the landmarks."""
        return WindowEstimate(self.states, self.landmarks.points)

    @estimate.setter
    def estimate(self, estimate: WindowEstimate) -> None:
        self.states = dict(estimate.states)
        self.landmarks.set_points(estimate.points)

    def linearize(self) -> LinearSystem:
        """Return the linear system of the prior, all factors and all observations."""
        return self.objective.linearize(self.estimate)

    def residuals(self) -> tuple[Array, Array, ObservationTable]:
        """Return the residuals (N, 2) and depths (N,) [m] of all observations of landmarks, and the observations."""
        return *self.objective.residuals(self.estimate), self.landmarks.observations

    def image_variance(self, residual: Array, observations: ObservationTable) -> float | None:
        """Return the variance of observations with residuals (N, 2) relative to the assumed one; None if unknown."""
        return image_variance(self.objective.squared(residual), observations.landmark)

    def oldest_imu_variance(self, solved: CholeskyFactor) -> ImuVarianceComponents | None:
        """Return the variance components of the IMU factor between the two oldest keyframes, None without one.

        Args:
            solved: Cholesky factor of the linear system at the optimum of the window.
        """
        oldest = min(self.states)
        return next(self._imu_variances([each for each in self._factors if oldest in each.keyframes], solved), None)

    def imu_variances(self, solved: CholeskyFactor) -> tuple[ImuVarianceComponents, ...]:
        """Return the variance components of all IMU factors; see `oldest_imu_variance`."""
        return tuple(self._imu_variances(self._factors, solved))

    def _imu_variances(
        self, factors: Iterable[KeyframeFactor], solved: CholeskyFactor
    ) -> Iterator[ImuVarianceComponents]:
        index = {k: i for i, k in enumerate(self.states)}
        for each in factors:
            factor = each.factor
            if isinstance(factor, gtsam.CombinedImuFactor) and each.weight == 1.0:
                values = state_values({k: self.states[k] for k in each.keyframes})
                whitened_J = factor.linearize(values).jacobian()[0]
                J = solve_triangular(whitening_matrix(factor), whitened_J)[:9]  # without the random walk of the biases
                preintegrated, columns = factor.preintegratedMeasurements(), each.block(index).start + each.columns
                yield ImuVarianceComponents.from_residual(
                    factor.unwhitenedError(values)[:9],
                    preintegrated.preintMeasCov()[:9, :9],
                    J @ solved.inverse_block(columns) @ J.T,
                    preintegrated.deltaTij(),
                )

    def marginalize(self, k: int, max_persistent: int, drift_rad: float = 0.0) -> None:
        """Marginalize a keyframe together with the landmarks that it observes.

        Landmarks that the newest keyframe observes may become persistent: they stay as variables of the prior, and only
        their observations from keyframe k are used. All other landmarks of keyframe k are marginalized with all their
        observations; a track that continues becomes a new landmark.

        Args:
            k: Number of the keyframe.
            max_persistent: Largest number of persistent landmarks. Those with the most observations are kept.
            drift_rad: Standard deviation of a common rotation of what is left about the position of the newest
                keyframe, about each axis [rad].
        """
        landmarks, persistent = self.landmarks, self.persistent
        observations = landmarks.observations
        # Which landmarks stay
        tracked = set(landmarks.observed_in(self.newest).tolist())
        observed = set(observations.landmark[observations.keyframe == k].tolist()) - persistent
        kept = self._most_observed(observed & tracked, max_persistent - len(persistent & tracked))
        marginalized = (observed - kept) | (persistent - tracked)
        self._known_prior = self._prior.with_points(landmarks.positions(kept))
        # Which observations are used
        used = np.isin(observations.landmark, list(marginalized)) | (
            (observations.keyframe == k) & np.isin(observations.landmark, list(persistent | kept))
        )
        drift = Drift(self.states[self.newest].pose.translation(), drift_rad) if drift_rad > 0.0 else None
        self._leave(k, observations[used], marginalized, drift)
        landmarks.remove(np.array(sorted(marginalized), dtype=np.int64))

    def drop_keyframe(self, k: int) -> None:
        """Remove a keyframe with its observations, and marginalize its factors only."""
        self._leave(k, NO_OBSERVATIONS, set())

    def remove_landmarks(self, landmarks: Iterable[int]) -> None:
        """Marginalize landmarks of the prior; those that it lacks are ignored.

        Raises:
            SingularError: The information on these landmarks is not positive definite.
        """
        self._known_prior = self._prior.without_points(landmarks)

    def _leave(self, k: int, observations: ObservationTable, landmarks: Set[int], drift: Drift | None = None) -> None:
        """Remove a keyframe; its factors and some observations are to be marginalized, with some landmarks."""
        leaving = self._objective([factor for factor in self._factors if k in factor.keyframes], observations)
        estimate = self.estimate
        self._factors = [factor for factor in self._factors if k not in factor.keyframes]
        self.states = {i: state for i, state in self.states.items() if i != k}
        self.landmarks.remove_keyframe(k)
        unobserved = self.persistent - set(self.landmarks.ids.tolist())
        self._pending = PendingMarginalization(k, leaving, estimate, landmarks, unobserved, drift)

    def _objective(self, factors: Sequence[KeyframeFactor], observations: ObservationTable) -> WindowObjective:
        """Return the information of the prior, some factors and some observations."""
        ids, sigmas = self.landmarks.ids, self._robust_sigmas
        return WindowObjective(self._prior, tuple(factors), observations, ids, self._Ts_imu_cam, self._sigma, sigmas)

    def _most_observed(self, candidates: set[int], count: int) -> set[int]:
        """Return those of some landmarks that have the most observations."""
        landmark = self.landmarks.observations.landmark
        ids, counts = np.unique(landmark[np.isin(landmark, list(candidates))], return_counts=True)
        return set(ids[np.argsort(-counts, kind="stable")[: max(count, 0)]].tolist())
