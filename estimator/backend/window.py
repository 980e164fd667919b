"""The window of keyframes that is optimized: its states, the factors and landmarks that tie them, and the prior.

One linear system holds all of it: each keyframe's state and each long-lived landmark is a variable of it, other
landmarks are eliminated (`reprojection`). It is small and dense, so that solving it takes a millisecond or two.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X
from scipy.linalg import solve_triangular

from dronevio.estimator.backend.landmarks import LandmarkDatabase
from dronevio.estimator.backend.linalg import CholeskyFactor, schur_complement
from dronevio.estimator.backend.marginal_prior import POINT_DIM, POSE_DIM, STATE_DIM, KeyframeState, MarginalPrior
from dronevio.estimator.backend.observations import NO_OBSERVATIONS, Integers, ObservationTable
from dronevio.estimator.backend.reprojection import (
    MEDIAN_CHI2_2DOF,
    Rows,
    Scene,
    VisualSystem,
    residuals,
    visual_system,
)
from dronevio.estimator.imu.noise import ImuVarianceComponents

Array = npt.NDArray[np.float64]
Factor = gtsam.NoiseModelFactor
IndexedFactor = tuple[frozenset[int], Factor]
"""A factor, and the keyframes that it ties to each other."""

IMU_ROBUST_SIGMAS = 5.0
"""Standard deviations beyond what noise explains at which what the IMU says of a motion has lost half of its weight, as
under Cauchy's loss: after a jolt, a saturated gyroscope or a gap, what is seen wins."""

_SPANS = {"x": np.arange(6), "v": np.arange(6, 9), "b": np.arange(9, 15)}  # in a state


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """The window to first order: H δ = b for its keyframes and long-lived landmarks."""

    H: Array
    """(n, n) Information."""
    b: Array
    """(n,) Right side."""
    visual: VisualSystem
    """What gives the other landmarks, once these are known."""


class Window:
    """Holds and moves the variables of a window."""

    def __init__(
        self,
        start: KeyframeState,
        prior_information: Array,
        landmarks: LandmarkDatabase,
        Ts_imu_cam: Array,
        sigma: float,
        robust_sigmas: float,
    ) -> None:
        """Begin with one keyframe, number 0.

        Args:
            start: Its state.
            prior_information: (15, 15) How sure it is.
            landmarks: Where observations and landmarks are kept.
            Ts_imu_cam: (C, 4, 4) Poses of the rig's cameras.
            sigma: Standard deviation of a sighting, normalized.
            robust_sigmas: Beyond so many of them, or medians where those are larger, a sighting loses weight as under
                Cauchy's loss.
        """
        self.states: dict[int, KeyframeState] = {0: start}
        """Of the keyframes, in order."""
        self.landmarks = landmarks
        """What they have seen."""
        self._prior = MarginalPrior(prior_information, np.zeros(STATE_DIM), {0: start})
        self._factors: list[IndexedFactor] = []
        self._Ts_imu_cam, self._sigma, self._robust_sigmas = Ts_imu_cam, sigma, robust_sigmas

    @property
    def newest(self) -> int:
        """Number of the newest keyframe."""
        return next(reversed(self.states))

    @property
    def persistent(self) -> set[int]:
        """Identities of the landmarks that the prior knows of."""
        return set(self._prior.points)

    @property
    def cameras(self) -> dict[int, tuple[Array, Array]]:
        """Orientations (C, 3, 3) and positions (C, 3) of the rig's cameras at each keyframe."""
        Ts = {k: state.pose.matrix() @ self._Ts_imu_cam for k, state in self.states.items()}
        return {k: (T[:, :3, :3], T[:, :3, 3]) for k, T in Ts.items()}

    def append(self, state: KeyframeState, factors: Iterable[Factor]) -> None:
        """Add a keyframe, and what ties it to others."""
        self.states[self.newest + 1] = state
        for factor in factors:
            self._factors.append((frozenset(map(gtsam.symbolIndex, factor.keys())), factor))

    def residuals(self) -> tuple[Array, Array, ObservationTable]:
        """Return residuals (N, 2) and depths (N,) [m] of all observations of landmarks, and these observations."""
        observations = self.landmarks.observations
        error, depth_m = residuals(observations, self._rows(observations), self._Ts_imu_cam, self._scene())
        return error, depth_m, observations

    def cost(self) -> float:
        """Return the negative logarithm of the posterior, up to a constant."""
        values = _values(self.states)
        motion = sum(factor.error(values) for _, factor in self._factors)
        error, _, observations = self.residuals()
        square = np.sum(error**2, axis=1) / (self._sigma * observations.sigma_scale) ** 2
        doubtful2 = self._robust_sigmas**2 * max(1.0, float(np.median(square)) if len(square) else 0.0)
        visual = 0.5 * doubtful2 * np.log1p(square / doubtful2).sum()
        return float(self._prior.cost(self.states, self._points()) + motion + visual)

    def linearize(self) -> LinearSystem:
        """Return the window to first order."""
        return self._system(self._factors, self.landmarks.observations)

    def update(self, system: LinearSystem, change: Array) -> None:
        """Move everything by the solution (n,) of a linear system."""
        K = len(self.states)
        states = change[: STATE_DIM * K].reshape(K, STATE_DIM)
        points = system.visual.points_given(states[:, :POSE_DIM])
        points[self._persistent_rows()] = change[STATE_DIM * K :].reshape(-1, POINT_DIM)
        self.states = {k: s.retract(d) for (k, s), d in zip(self.states.items(), states, strict=True)}
        self.landmarks.points = self.landmarks.points + points

    def oldest_imu_variance(self, solved: CholeskyFactor) -> ImuVarianceComponents | None:
        """Say how well the IMU since the oldest keyframe fits the rest of the window, once that has been optimized.

        Args:
            solved: The linear system of the window's optimum.
        """
        oldest, places = min(self.states), {k: i for i, k in enumerate(self.states)}
        for keyframes, factor in self._factors:
            if oldest in keyframes and isinstance(factor, gtsam.CombinedImuFactor):
                values = _values({k: self.states[k] for k in keyframes})
                J = solve_triangular(_whitening(factor), factor.linearize(values).jacobian()[0])[:9]  # biases apart
                interval = factor.preintegratedMeasurements()
                return ImuVarianceComponents.from_residual(
                    factor.unwhitenedError(values)[:9],
                    interval.preintMeasCov()[:9, :9],
                    J @ solved.inverse_block(_columns(factor, places)) @ J.T,
                    interval.deltaTij(),
                )
        return None

    def marginalize(self, k: int, max_persistent: int) -> None:
        """Let a keyframe go, and keep in the prior what it and the landmarks that it saw say of the others.

        Landmarks that are still followed may become long-lived: only their observations from this keyframe are used up.
        The others are absorbed with all their observations, and begin anew if they are seen again.
        """
        landmarks, long = self.landmarks, self.persistent
        observations = landmarks.observations
        followed = set(landmarks.observed_in(self.newest).tolist())
        seen = set(observations.landmark[observations.keyframe == k].tolist()) - long
        kept = self._most_observed(seen & followed, max_persistent - len(long & followed))
        over = (seen - kept) | (long - followed)
        self._prior = self._prior.with_points(landmarks.positions(kept))
        used = np.isin(observations.landmark, list(over)) | (
            (observations.keyframe == k) & np.isin(observations.landmark, list(long | kept))
        )
        self._marginalize_into_prior(k, observations[used], over)
        landmarks.remove(np.array(sorted(over), dtype=np.int64))

    def drop_keyframe(self, k: int) -> None:
        """Let a keyframe go whose view adds nothing, and keep what the IMU says of its neighbours."""
        self._marginalize_into_prior(k, NO_OBSERVATIONS, set())

    def remove_landmarks(self, landmarks: Iterable[int]) -> None:
        """Let go of landmarks that turned out to be wrong."""
        self._prior = self._prior.without_points(landmarks)

    def _marginalize_into_prior(self, k: int, observations: ObservationTable, over: set[int]) -> None:
        """Put factors of a keyframe and some observations into the prior; keyframe and landmarks leave."""
        touching = [tied for tied in self._factors if k in tied[0]]
        system = self._system(touching, observations)
        leaving_states = np.repeat([i == k for i in self.states], STATE_DIM)
        leaving_points = np.repeat([i in over for i in self._prior.points], POINT_DIM).astype(np.bool_)
        H, b = schur_complement(system.H, system.b, np.concatenate([leaving_states, leaving_points]))
        points = {i: point for i, point in self._points().items() if i not in over}
        self._factors = [(keyframes, factor) for keyframes, factor in self._factors if k not in keyframes]
        del self.states[k]
        self._prior = MarginalPrior.from_current_estimates(H, b, self.states, points, self._prior)
        self.landmarks.remove_keyframe(k)
        self._prior = self._prior.without_points(set(points) - set(self.landmarks.ids.tolist()))

    def _most_observed(self, candidates: set[int], room: int) -> set[int]:
        """Return those of some landmarks that have been seen most often."""
        rows = self.landmarks.observations.landmark
        ids, counts = np.unique(rows[np.isin(rows, list(candidates))], return_counts=True)
        return set(ids[np.argsort(-counts, kind="stable")[: max(room, 0)]].tolist())

    def _system(self, factors: Sequence[IndexedFactor], observations: ObservationTable) -> LinearSystem:
        """Return the prior, some factors and some observations to first order."""
        places = {k: i for i, k in enumerate(self.states)}
        K, long = len(places), self._prior.points
        n = STATE_DIM * K + POINT_DIM * len(long)
        H, b = np.zeros((n, n)), np.zeros(n)

        known = [STATE_DIM * places[k] + np.arange(STATE_DIM) for k in self._prior.states]
        columns = np.concatenate([*known, np.arange(STATE_DIM * K, n)])
        H[np.ix_(columns, columns)] += self._prior.H
        b[columns] += self._prior.right_hand_side(self.states, self._points())

        first = {k: self._prior.linearization_point(k, now) for k, now in self.states.items()}
        tied = frozenset[int]().union(*(keyframes for keyframes, _ in factors))
        values_now, values_first = (_values({k: states[k] for k in tied}) for states in (self.states, first))
        for _, factor in factors:
            A, columns = factor.linearize(values_first).jacobian()[0], _columns(factor, places)
            error = factor.whitenedError(values_now)
            unexplained = max(float(error @ error) - len(error), 0.0)  # noise alone makes as many as there are numbers
            weight = 1.0 / (1.0 + unexplained / IMU_ROBUST_SIGMAS**2)
            H[np.ix_(columns, columns)] += weight * (A.T @ A)
            b[columns] -= weight * (A.T @ error)

        visual = self._visual(observations, first)
        rows = self._persistent_rows()
        eliminated = np.ones(len(self.landmarks.ids), dtype=np.bool_)
        eliminated[rows] = False
        columns = (STATE_DIM * np.arange(K)[:, None] + np.arange(POSE_DIM)).ravel()
        H_poses, b_poses = visual.without_points(eliminated)
        H[np.ix_(columns, columns)] += H_poses
        b[columns] += b_poses
        across = np.moveaxis(visual.cross[rows].reshape(len(rows), POSE_DIM * K, POINT_DIM), 0, 1).reshape(
            POSE_DIM * K, -1
        )
        H[columns, STATE_DIM * K :] += across
        H[STATE_DIM * K :, columns] += across.T
        own = STATE_DIM * K + np.arange(POINT_DIM * len(rows)).reshape(-1, POINT_DIM)
        H[own[:, :, None], own[:, None, :]] += visual.point[rows]
        b[own] += visual.point_b[rows]
        return LinearSystem(H, b, visual)

    def _visual(self, observations: ObservationTable, first: dict[int, KeyframeState]) -> VisualSystem:
        """Return what some observations say."""
        rows, now = self._rows(observations), self._scene()
        error, depth_m = residuals(observations, rows, self._Ts_imu_cam, now)
        sigma2 = (self._sigma * observations.sigma_scale) ** 2
        square = np.sum(error**2, axis=1) / sigma2
        doubtful = self._doubtful(square, rows.keyframe)
        weight = (depth_m > 0.0) / (sigma2 * self._misfit(square) * (1.0 + square / doubtful**2))
        points = now.points.copy()
        points[self._persistent_rows()] = np.reshape(list(self._prior.points.values()), (-1, POINT_DIM))
        return visual_system(observations, rows, self._Ts_imu_cam, _scene(first, points), error, weight)

    def _misfit(self, square: Array) -> float:
        """Return how much larger the variance of observations is than it should be, from squared residuals (N,), or 1.

        Where half of all residuals are larger than half of them can be by chance, it is the noise that is larger.
        """
        return max(1.0, float(np.median(square)) / MEDIAN_CHI2_2DOF) if len(square) > 0 else 1.0

    def _doubtful(self, square: Array, keyframe: Integers) -> Array:
        """Return the residuals (N,) at which observations have lost half of their weight, in standard deviations.

        Where most of what a keyframe shows is far off, it is the keyframe that is wrong, and no sighting is an outlier.

        Args:
            square: (N,) Squared residuals, in variances.
            keyframe: (N,) Rows of the keyframes.
        """
        typical = np.sqrt(medians_of_each(keyframe, square))
        return np.asarray(self._robust_sigmas * np.maximum(1.0, typical))

    def _rows(self, observations: ObservationTable) -> Rows:
        return Rows(
            np.searchsorted(list(self.states), observations.keyframe), self.landmarks.rows(observations.landmark)
        )

    def _scene(self) -> Scene:
        return _scene(self.states, self.landmarks.points)

    def _points(self) -> dict[int, Array]:
        """Return where the long-lived landmarks are now."""
        return self.landmarks.positions(self._prior.points)

    def _persistent_rows(self) -> Integers:
        """Return the rows of the long-lived landmarks among all, in the prior's order."""
        return self.landmarks.rows(np.array(list(self._prior.points), dtype=np.int64))


def medians_of_each(group: Integers, values: Array) -> Array:
    """Return for each of some values (N,) the median (N,) of those that are in its group (N,)."""
    _, inverse, counts = np.unique(group, return_inverse=True, return_counts=True)
    ordered, first = values[np.lexsort((values, group))], np.cumsum(counts) - counts
    medians = 0.5 * (ordered[first + (counts - 1) // 2] + ordered[first + counts // 2])
    return np.asarray(medians[inverse])


def _whitening(factor: Factor) -> Array:
    """Return the square root R of a factor's information RᵀR, upper triangular."""
    model = factor.noiseModel()
    assert isinstance(model, gtsam.noiseModel.Gaussian)
    return np.asarray(model.R())


def _columns(factor: Factor, places: dict[int, int]) -> Integers:
    """Return the columns of a factor's variables in a linear system, for keyframes in these places."""
    keys = list(factor.keys())
    return np.concatenate(
        [STATE_DIM * places[gtsam.symbolIndex(key)] + _SPANS[chr(gtsam.symbolChr(key))] for key in keys]
    )


def _scene(states: dict[int, KeyframeState], points: Array) -> Scene:
    Ts = np.stack([state.pose.matrix() for state in states.values()])
    return Scene(Ts[:, :3, :3], Ts[:, :3, 3], points)


def _values(states: dict[int, KeyframeState]) -> gtsam.Values:
    """Return states as GTSAM has them."""
    values = gtsam.Values()
    for k, state in states.items():
        # By name, or the binding tries forty other types first, which takes three times as long
        values.insert(X(k), pose3=state.pose)
        values.insert(V(k), vector=state.velocity)
        values.insert(B(k), constant_bias=state.bias)
    return values
