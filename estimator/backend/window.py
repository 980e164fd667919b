"""The sliding window: keyframe states, the factors and landmarks that constrain them, and the marginal prior.

One dense linear system holds the states of all keyframes and the persistent landmarks; all other landmarks are
eliminated by the Schur complement (`reprojection`).

The prior is computed when it is first needed. After a keyframe was marginalized, that is the next keyframe, or a frame
before it that has more time.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from copy import copy

import gtsam
import numpy as np
import numpy.typing as npt
from scipy.linalg import solve_triangular

from dronevio.estimator.backend.drift import with_rotation_error
from dronevio.estimator.backend.factors import KeyframeFactor, state_values, whitening_matrix
from dronevio.estimator.backend.landmarks import CameraPoses, LandmarkDatabase
from dronevio.estimator.backend.linear_system import LinearSystem, linear_system, linearization_points
from dronevio.estimator.backend.marginal_prior import POINT_DIM, POSE_DIM, STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.observations import NO_OBSERVATIONS, Integers, ObservationTable
from dronevio.estimator.backend.recalibration import recalibrated_observations, with_calibration_error
from dronevio.estimator.backend.reprojection import (
    ObservationIndices,
    VisualState,
    residuals,
    visual_system,
)
from dronevio.estimator.backend.weighting import image_variance, robust_thresholds, variance_factor
from dronevio.estimator.imu.noise import ImuVarianceComponents
from dronevio.estimator.optimization.linalg import CholeskyFactor, schur_complement
from dronevio.estimator.types import Calibration

Array = npt.NDArray[np.float64]


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
        self._pending: list[Callable[[MarginalPrior], MarginalPrior]] = []  # changes of the prior to be computed
        self._factors: list[KeyframeFactor] = []
        self._Ts_imu_cam, self._sigma, self._robust_sigmas = Ts_imu_cam, sigma, robust_sigmas

    @property
    def _prior(self) -> MarginalPrior:
        """The marginal prior with all changes."""
        self.complete()
        return self._known_prior

    @_prior.setter
    def _prior(self, prior: MarginalPrior) -> None:
        self._known_prior = prior

    def complete(self) -> None:
        """Compute the marginal prior, if that has not been done since a keyframe was marginalized.

        Raises:
            SingularError: The information on marginalized variables is not positive definite. Each use of the prior
                raises it again.
        """
        while self._pending:
            self._known_prior = self._pending[0](self._known_prior)
            del self._pending[0]

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
        self._prior = with_calibration_error(prior, covariance, rates_rad_s, delay_s)

    def append(self, state: KeyframeState, factors: Iterable[gtsam.NoiseModelFactor]) -> None:
        """Add a keyframe, and the factors between it and others."""
        self.states[self.newest + 1] = state
        self._factors += map(KeyframeFactor.of, factors)

    def residuals(self) -> tuple[Array, Array, ObservationTable]:
        """Return the residuals (N, 2) and depths (N,) [m] of all observations of landmarks, and the observations."""
        observations = self.landmarks.observations
        residual, depth_m = residuals(observations, self._indices(observations), self._Ts_imu_cam, self._visual_state())
        return residual, depth_m, observations

    def image_variance(self, residual: Array, observations: ObservationTable) -> float | None:
        """Return the variance of observations with residuals (N, 2) relative to the assumed one; None if unknown."""
        return image_variance(self._squared(residual, observations), observations.landmark)

    def cost(self) -> float:
        """Return the negative logarithm of the posterior density at the current estimates, up to a constant."""
        values = state_values(self.states)
        of_factors = sum(each.factor.error(values) for each in self._factors)
        residual, _, observations = self.residuals()
        squared = self._squared(residual, observations)
        threshold2 = self._robust_sigmas**2 * max(1.0, float(np.median(squared)) if len(squared) else 0.0)
        of_observations = (
            0.5 * threshold2 * (np.log1p(squared / threshold2) / self._variance_growth(observations)).sum()
        )
        return float(self._prior.cost(self.states, self._persistent_points()) + of_factors + of_observations)

    def linearize(self) -> LinearSystem:
        """Return the linear system of the prior, all factors and all observations."""
        return self._linear_system(self._factors, self.landmarks.observations)

    def update(self, system: LinearSystem, delta: Array) -> None:
        """Apply a step to the states, and the step of the landmarks that belongs to it.

        Args:
            system: The linear system.
            delta: (n,) Its solution, or that of a damped one.
        """
        K = len(self.states)
        delta_states = delta[: STATE_DIM * K].reshape(K, STATE_DIM)
        delta_points = system.visual.back_substitute(delta_states[:, :POSE_DIM])
        delta_points[self._persistent_rows()] = delta[STATE_DIM * K :].reshape(-1, POINT_DIM)
        self.states = {k: state.retract(d) for (k, state), d in zip(self.states.items(), delta_states, strict=True)}
        self.landmarks.set_points(self.landmarks.points + delta_points)

    @property
    def estimates(self) -> tuple[dict[int, KeyframeState], Array]:
        """Current estimates of the keyframes and of the landmarks (L, 3), for `restore`."""
        return self.states, self.landmarks.points

    def restore(self, estimates: tuple[dict[int, KeyframeState], Array]) -> None:
        """Set the estimates to earlier ones of the same keyframes and landmarks."""
        self.states, points = estimates
        self.landmarks.set_points(points)

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
            if isinstance(factor, gtsam.CombinedImuFactor):
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

    def marginalize(self, k: int, max_persistent: int) -> None:
        """Marginalize a keyframe together with the landmarks that it observes.

        Landmarks that the newest keyframe observes may become persistent: they stay as variables of the prior, and only
        their observations from keyframe k are used. All other landmarks of keyframe k are marginalized with all their
        observations; a track that continues becomes a new landmark.

        Args:
            k: Number of the keyframe.
            max_persistent: Largest number of persistent landmarks. Those with the most observations are kept.
        """
        landmarks, persistent = self.landmarks, self.persistent
        observations = landmarks.observations
        tracked = set(landmarks.observed_in(self.newest).tolist())
        observed = set(observations.landmark[observations.keyframe == k].tolist()) - persistent
        kept = self._most_observed(observed & tracked, max_persistent - len(persistent & tracked))
        marginalized = (observed - kept) | (persistent - tracked)
        self._prior = self._prior.with_points(landmarks.positions(kept))
        used = np.isin(observations.landmark, list(marginalized)) | (
            (observations.keyframe == k) & np.isin(observations.landmark, list(persistent | kept))
        )
        self._marginalize_into_prior(k, observations[used], marginalized)
        landmarks.remove(np.array(sorted(marginalized), dtype=np.int64))

    def add_drift(self, sigma_rad: float) -> None:
        """Let the prior have a common error of rotation about the position of the newest keyframe.

        Args:
            sigma_rad: Standard deviation about each axis [rad].
        """
        pivot_m = self.states[self.newest].pose.translation()
        self._pending.append(lambda prior: with_rotation_error(prior, pivot_m, sigma_rad))

    def drop_keyframe(self, k: int) -> None:
        """Remove a keyframe with its observations, and marginalize its factors only."""
        self._marginalize_into_prior(k, NO_OBSERVATIONS, set())

    def remove_landmarks(self, landmarks: Iterable[int]) -> None:
        """Marginalize landmarks of the prior; those that it lacks are ignored.

        Raises:
            SingularError: The information on these landmarks is not positive definite.
        """
        self._prior = self._prior.without_points(landmarks)

    def _marginalize_into_prior(self, k: int, observations: ObservationTable, landmarks: set[int]) -> None:
        """Replace the prior by that of all its information, of the factors of a keyframe and of some observations.

        The keyframe and some of the prior's landmarks are marginalized.
        """
        before = self._copy()
        self._factors = [factor for factor in self._factors if k not in factor.keyframes]
        del self.states[k]
        self.landmarks.remove_keyframe(k)
        unobserved = self.persistent - set(self.landmarks.ids.tolist())
        self._pending.append(lambda _: before._marginal_prior(k, observations, landmarks).without_points(unobserved))

    def _copy(self) -> "Window":
        """Return a window with the same variables and information, which changes of this one do not concern."""
        self.complete()
        copied = copy(self)
        copied.states, copied.landmarks, copied._pending = dict(self.states), copy(self.landmarks), []
        return copied

    def _marginal_prior(self, k: int, observations: ObservationTable, landmarks: set[int]) -> MarginalPrior:
        """Return the prior without a keyframe and some landmarks, with the keyframe's factors and some observations."""
        system = self._linear_system([factor for factor in self._factors if k in factor.keyframes], observations)
        of_states = np.repeat([i == k for i in self.states], STATE_DIM)
        of_points = np.repeat([i in landmarks for i in self._prior.points], POINT_DIM).astype(np.bool_)
        H, b = schur_complement(system.H, system.b, np.concatenate([of_states, of_points]))
        states = {i: state for i, state in self.states.items() if i != k}
        points = {i: point for i, point in self._persistent_points().items() if i not in landmarks}
        return MarginalPrior.from_current_estimates(H, b, states, points, self._prior)

    def _most_observed(self, candidates: set[int], count: int) -> set[int]:
        """Return those of some landmarks that have the most observations."""
        landmark = self.landmarks.observations.landmark
        ids, counts = np.unique(landmark[np.isin(landmark, list(candidates))], return_counts=True)
        return set(ids[np.argsort(-counts, kind="stable")[: max(count, 0)]].tolist())

    def _linear_system(self, factors: Sequence[KeyframeFactor], observations: ObservationTable) -> LinearSystem:
        """Return the linear system of the prior, some factors and some observations.

        Its visual part contains the landmarks of these observations and the persistent ones, in the order of their
        identities.
        """
        indices, persistent = self._indices(observations), self._persistent_rows()
        is_contained = np.zeros(len(self.landmarks.ids), dtype=np.bool_)
        is_contained[indices.landmark] = is_contained[persistent] = True
        system_row = np.cumsum(is_contained) - 1
        in_system = ObservationIndices(indices.keyframe, system_row[indices.landmark])
        current, first = self._visual_state(), linearization_points(self._prior, self.states)
        points = current.points.copy()
        points[persistent] = np.reshape(list(self._prior.points.values()), (-1, POINT_DIM))
        residual, weight = self._weighted_residuals(observations, indices, current)
        linearized_at = _visual_state(first, points[is_contained])
        visual = visual_system(observations, in_system, self._Ts_imu_cam, linearized_at, residual, weight)
        rows = system_row[persistent]
        return linear_system(self._prior, self._persistent_points(), self.states, factors, visual, rows)

    def _weighted_residuals(
        self, observations: ObservationTable, indices: ObservationIndices, current: VisualState
    ) -> tuple[Array, Array]:
        """Return the residuals (N, 2) of observations at the current estimates, and their weights (N,)."""
        residual, depth_m = residuals(observations, indices, self._Ts_imu_cam, current)
        sigma2 = (self._sigma * observations.sigma_scale) ** 2
        squared = _squared_norms(residual) / sigma2
        threshold = robust_thresholds(squared, indices.keyframe, self._robust_sigmas)
        variance = sigma2 * self._variance_growth(observations) * variance_factor(squared)
        weight = (depth_m > 0.0) / (variance * (1.0 + squared / threshold**2))
        return residual, weight

    def _variance_growth(self, observations: ObservationTable) -> Array | float:
        """Return the factors on the variances of observations due to correlated errors of tracks.

        Several cameras observe the depth at every keyframe, so that growing errors do not change the scale.
        """
        return observations.variance_growth if len(self._Ts_imu_cam) == 1 else 1.0

    def _squared(self, residual: Array, observations: ObservationTable) -> Array:
        """Return the squares (N,) of residuals (N, 2) in units of the assumed variance."""
        return np.asarray(_squared_norms(residual) / (self._sigma * observations.sigma_scale) ** 2)

    def _indices(self, observations: ObservationTable) -> ObservationIndices:
        """Return the indices of the keyframes and landmarks of observations."""
        keyframe = np.searchsorted(list(self.states), observations.keyframe)
        return ObservationIndices(keyframe, self.landmarks.rows(observations.landmark))

    def _visual_state(self) -> VisualState:
        """Return the current estimates of poses and landmarks."""
        return _visual_state(self.states, self.landmarks.points)

    def _persistent_points(self) -> dict[int, Array]:
        """Return the current positions (3,) of the persistent landmarks [m]."""
        return self.landmarks.positions(self._prior.points)

    def _persistent_rows(self) -> Integers:
        """Return the rows of the persistent landmarks among all, in the order of the prior."""
        return self.landmarks.rows(np.array(list(self._prior.points), dtype=np.int64))


def _squared_norms(vectors: Array) -> Array:
    """Return the squared norms (N,) of vectors (N, 2); much faster than a sum along the axis of two."""
    return np.asarray(vectors[:, 0] ** 2 + vectors[:, 1] ** 2)


def _visual_state(states: dict[int, KeyframeState], points: Array) -> VisualState:
    """Return the poses of keyframes and the positions (L, 3) of landmarks."""
    Ts = np.stack([state.pose.matrix() for state in states.values()])
    return VisualState(Ts[:, :3, :3], Ts[:, :3, 3], points)
