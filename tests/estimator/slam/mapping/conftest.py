"""Maps of synthetic flights: the odometry's keyframes without images, and a recognizer that knows the true poses."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import X

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.backend.observations import observation_table
from dronevio.estimator.imu.preintegration import PreintegrationConfig, PreintegrationParams
from dronevio.estimator.keyframe_observer import OdometryKeyframe
from dronevio.estimator.slam.adjustment.bundle_adjustment import AdjustmentInputs, AdjustmentKeyframe
from dronevio.estimator.slam.correction import Correction
from dronevio.estimator.slam.map.keyframe import NO_KEYFRAME_FEATURES, MapKeyframe
from dronevio.estimator.slam.map.pose_graph import OptimizedGraph, PoseGraph, factor_graph
from dronevio.estimator.slam.mapper import Mapper, Recognizer
from dronevio.estimator.slam.places.localization import KeyframeView
from dronevio.estimator.slam.places.verification import PlaceMatch
from dronevio.models.arrays import Array
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix
from dronevio.models.state import Estimate

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight


def marginal_covariance(graph: PoseGraph, keyframe: int) -> Array:
    """Return the marginal covariance (6, 6) of a keyframe's pose in a graph: δθ, δp in the IMU frame."""
    values = gtsam.Values()
    for k, T in graph.poses.items():
        values.insert(X(k), gtsam.Pose3(T))
    return np.asarray(gtsam.Marginals(factor_graph(graph), values).marginalCovariance(X(keyframe)))


class TrueRecognizer:
    """Recognizes places by the true poses of a flight, with noise; some matches are wrong."""

    def __init__(
        self,
        true_poses: Mapping[int, Array],
        *,
        every: int = 5,
        min_age: int = 25,
        sigma: float = 1e-3,
        wrong: float = 0.0,
        seed: int = 0,
    ) -> None:
        """Begin without keyframes.

        Args:
            true_poses: True poses (4, 4) of the IMU by their times [ns].
            every: Number of keyframes for one match.
            min_age: Smallest number of keyframes between the two keyframes of a match.
            sigma: Standard deviation of the matches [rad] and [m].
            wrong: Share of the matches that are wrong, by 0.5 m and more.
            seed: Seed of noise and wrong matches.
        """
        self._true_poses, self._every, self._min_age, self._sigma, self._wrong = (
            true_poses,
            every,
            min_age,
            sigma,
            wrong,
        )
        self._rng = np.random.default_rng(seed)
        self._times: list[int] = []
        self.wrong_pairs: set[tuple[int, int]] = set()
        """Numbers of the keyframes of the wrong matches."""

    def add(self, keyframe: MapKeyframe) -> tuple[PlaceMatch, ...]:
        """Return the pose in the frame of an old keyframe, for some keyframes."""
        self._times.append(keyframe.t_ns)
        match = self.locate(keyframe)
        return () if match is None else (match,)

    def remove(self, number: int) -> None:
        """Do nothing: true poses are known of culled keyframes, too."""

    def start_track(self) -> None:
        """Do nothing: true poses do not depend on the odometry frame."""

    def locate(self, keyframe: MapKeyframe) -> PlaceMatch | None:
        """Return the pose in the frame of an old keyframe, for some keyframes."""
        if keyframe.number % self._every or keyframe.number < self._min_age:
            return None
        old = int(self._rng.integers(0, keyframe.number - self._min_age + 1))
        T = inverse_pose(self._true_poses[self._times[old]]) @ self._true_poses[keyframe.t_ns]
        noise = self._sigma * self._rng.normal(size=6)
        T = T @ pose_matrix(exp_so3(noise[:3]), noise[3:])
        if self._rng.random() < self._wrong:
            T = T @ pose_matrix(exp_so3(0.3 * self._rng.normal(size=3)), 0.5 + self._rng.random(3))
            self.wrong_pairs.add((old, keyframe.number))
        return PlaceMatch(keyframe.number, old, T, self._sigma**2 * np.eye(6), 0, 0)


class NoRecognizer:
    """Recognizes no place."""

    def add(self, keyframe: MapKeyframe) -> tuple[PlaceMatch, ...]:
        """Return no match."""
        return ()

    def remove(self, number: int) -> None:
        """Do nothing."""

    def start_track(self) -> None:
        """Do nothing."""

    def locate(self, keyframe: MapKeyframe) -> PlaceMatch | None:
        """Return no match."""
        return None


@dataclass
class RecordingObserver:
    """A `KeyframeObserver` that keeps what it receives."""

    keyframes: list[OdometryKeyframe] = field(default_factory=list)
    estimates: list[KeyframeEstimate] = field(default_factory=list)

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Keep the keyframe."""
        self.keyframes.append(keyframe)

    def marginalized(self, estimate: KeyframeEstimate) -> None:
        """Keep the estimate."""
        self.estimates.append(estimate)

    def lost(self) -> None:
        """Fail, since no synthetic flight here is lost."""
        raise AssertionError("the odometry is lost")


@dataclass(frozen=True, eq=False)
class MappedFlight:
    """The map of a flight."""

    mapper: Mapper
    """The mapper after the last keyframe."""
    corrections: list[Correction]
    """The correction by each keyframe."""


@dataclass(frozen=True, eq=False)
class OdometryFlight:
    """A synthetic flight with its estimates and the keyframes of its odometry."""

    flight: "SyntheticFlight"
    estimates: list[Estimate]
    marginalized: list[KeyframeEstimate]
    keyframes: list[OdometryKeyframe]

    @cached_property
    def true_poses(self) -> dict[int, Array]:
        """True poses (4, 4) of the IMU at the marginalized keyframes, by their times [ns]."""
        return {d.t_ns: self.flight.state_at(d.t_ns).T_world_imu for d in self.marginalized}

    def mapped(self, recognizer: Recognizer) -> MappedFlight:
        """Return the map of the flight; keyframes have no image."""
        mapper = Mapper(recognizer)
        view = KeyframeView(NO_KEYFRAME_FEATURES)
        return MappedFlight(mapper, [mapper.add(estimate, view) for estimate in self.marginalized])

    def with_loops(self, **settings: float) -> tuple[TrueRecognizer, MappedFlight]:
        """Return a recognizer that knows the true poses, and the map with the places that it recognizes."""
        recognizer = TrueRecognizer(self.true_poses, **settings)  # type: ignore[arg-type]
        return recognizer, self.mapped(recognizer)


@pytest.fixture(scope="session")
def odometry_flight(make_flight: "Callable[..., SyntheticFlight]") -> OdometryFlight:
    """Return a flight of 25 s with the keyframes of its odometry."""
    flight, observer = make_flight(4, duration_s=25.0), RecordingObserver()
    return OdometryFlight(flight, flight.run(observer=observer), observer.estimates, observer.keyframes)


@pytest.fixture(scope="session")
def graph_solution(odometry_flight: "OdometryFlight") -> OptimizedGraph:
    """Return the optimized pose graph of a flight with loops."""
    _, mapped = odometry_flight.with_loops(every=5)
    found = mapped.mapper.final_solution()
    assert found is not None
    return found


@pytest.fixture(scope="session")
def adjustment_inputs(odometry_flight: "OdometryFlight", graph_solution: OptimizedGraph) -> AdjustmentInputs:
    """Return the measurements of the map, with the poses of the graph as initial ones."""
    of_time = {keyframe.t_ns: keyframe for keyframe in odometry_flight.keyframes}
    keyframes, flight = [], odometry_flight.flight
    for number, estimate in enumerate(odometry_flight.marginalized):
        if estimate.t_ns not in of_time:  # a keyframe of the initialization
            continue
        known = of_time[estimate.t_ns]
        keyframes.append(
            AdjustmentKeyframe(
                number,
                estimate.t_ns,
                graph_solution.graph.poses[number],
                known.state.velocity_m_s,
                known.state.gyro_bias_rad_s,
                known.state.accel_bias_m_s2,
                1e-6 * np.eye(6),
                observation_table(number, known.observations),
                estimate,
            )
        )
    params = PreintegrationParams.of(flight.rig.imu, PreintegrationConfig())
    first = keyframes[0].number
    loops = [loop for loop in graph_solution.without_rejected.loops if loop.first >= first]
    covariance, calibration = odometry_flight.marginalized[first].covariance, odometry_flight.keyframes[-1].calibration
    return AdjustmentInputs(keyframes, loops, flight.imu, flight.rig.imu, params, calibration, first, covariance)
