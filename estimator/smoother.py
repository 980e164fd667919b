"""The back end: a fixed-lag smoother over keyframes, with smart factors for the landmarks.

Each keyframe has a pose, a velocity and biases. Consecutive ones are joined by the preintegrated IMU, and all that see
a landmark by a smart factor, which eliminates the landmark itself (Carlone et al., "Eliminating conditionally
independent sets in factor graphs", ICRA 2014). Keyframes older than the lag are marginalised into a prior. The
solver is iSAM2 (Kaess et al., IJRR 2012).

All image coordinates here are normalised (at depth 1 in the camera frame), so a pixel is 1/fx.
"""

from dataclasses import dataclass, field

import gtsam
import numpy as np
import numpy.typing as npt
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.covariance import covariance_from_gtsam, covariance_to_gtsam
from dronevio.estimator.frontend import Observations
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import NavState

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class SmootherConfig:
    """Settings of the fixed-lag smoother."""

    lag_s: float = 5.0
    """Length of the window [s]."""
    pixel_sigma: float = 1.0
    """Standard deviation of an image measurement [px]: tracking error and what calibration leaves."""
    min_views: int = 3
    """Keyframes that must have seen a landmark before it constrains anything."""
    min_parallax_deg: float = 1.5
    """Angle under which a landmark must have been seen [°]; below, its depth is not observable and iSAM2 fails."""
    max_distance_m: float = 60.0
    """Landmarks beyond are ignored [m]."""
    max_reprojection_px: float = 6.0
    """A landmark that is seen further than this from where it should be is dropped [px]."""
    relinearise_threshold: float = 0.01
    """Change of a variable that makes iSAM2 linearise again."""
    still_velocity_sigma: float = 0.01
    """How surely the velocity is zero at rest [m/s]."""
    still_pose_sigma: float = 0.001
    """How surely the pose stays at rest, from one keyframe to the next [rad and m]."""


@dataclass
class _Track:
    """What the window knows of one landmark."""

    first_bearing: Array  # (3,) world direction of the first sighting, for the parallax
    keyframes: list[int] = field(default_factory=list)
    xy: list[Array] = field(default_factory=list)
    parallax: float = 0.0  # largest angle to the first sighting [rad]
    factor: gtsam.SmartProjectionRigFactorPinholePoseCal3_S2 | None = None
    slot: int = -1  # of the factor in iSAM2


class KeyframeSmoother:
    """Estimates the states of the last few seconds' keyframes."""

    def __init__(
        self,
        T_imu_cam: Array,
        focal_px: float,
        config: SmootherConfig,
        start: NavState,
        covariance: Array,
        observations: Observations,
    ) -> None:
        """Begin with one keyframe.

        Args:
            T_imu_cam: (4, 4) Pose of the camera in the IMU frame.
            focal_px: Focal length, which turns pixels into normalised coordinates.
            config: Settings.
            start: The first state.
            covariance: (15, 15) How sure it is, in the order of `NavState`.
            observations: The features seen from it.
        """
        self._config = config
        self._T_imu_cam = T_imu_cam
        self._focal_px = focal_px
        self._measurement_noise = gtsam.noiseModel.Isotropic.Sigma(2, config.pixel_sigma / focal_px)
        self._cameras = gtsam.CameraSetPinholePoseCal3_S2()
        self._cameras.push_back(gtsam.PinholePoseCal3_S2(gtsam.Pose3(T_imu_cam), gtsam.Cal3_S2()))
        self._smart = gtsam.SmartProjectionParams()
        self._smart.setDegeneracyMode(gtsam.DegeneracyMode.ZERO_ON_DEGENERACY)
        self._smart.setRankTolerance(1e-3)
        self._smart.setLandmarkDistanceThreshold(config.max_distance_m)
        self._smart.setDynamicOutlierRejectionThreshold(config.max_reprojection_px / focal_px)
        self._banned: set[int] = set()  # landmarks that were seen where they should not be
        self._solver: gtsam.IncrementalFixedLagSmoother
        self._tracks: dict[int, _Track]
        self._condemned: list[int]  # slots of their factors, to be removed with the next update
        self._k: int  # index of the newest keyframe since the last restart
        self._nav: gtsam.NavState
        self._bias: gtsam.imuBias.ConstantBias
        self._covariance: Array  # (15, 15) of the newest keyframe, in the order of NavState
        self._state: NavState
        self._restart(start, covariance)
        self._observe(0, start.T_world_imu[:3, :3], observations)

    @property
    def state(self) -> NavState:
        """The newest keyframe's state."""
        return self._state

    @property
    def gtsam_state(self) -> tuple[gtsam.NavState, gtsam.imuBias.ConstantBias]:
        """The newest keyframe's state, for preintegration to start from."""
        return self._nav, self._bias

    def landmarks(self) -> tuple[npt.NDArray[np.int64], Array]:
        """Return the identities (N,) and world positions (N, 3) of the landmarks that constrain the window."""
        ids, points = [], []
        for track_id, track in self._tracks.items():
            if track.factor is not None:
                result = track.factor.point()
                if result.valid():
                    ids.append(track_id)
                    points.append(result.get())
        return np.array(ids, dtype=np.int64), np.array(points).reshape(-1, 3)

    def add_keyframe(
        self,
        t_ns: int,
        preintegrated: gtsam.PreintegratedCombinedMeasurements,
        observations: Observations,
        still: bool,
    ) -> tuple[str, ...]:
        """Add a keyframe and optimise the window.

        Args:
            t_ns: Time of the keyframe.
            preintegrated: The IMU since the last keyframe.
            observations: The features seen.
            still: Whether the drone has not moved since the last keyframe.

        Returns:
            Events for people: empty, or what went wrong and how it was mended.
        """
        previous, k = self._k, self._k + 1
        predicted = preintegrated.predict(self._nav, self._bias)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        values.insert(X(k), predicted.pose())
        values.insert(V(k), predicted.velocity())
        values.insert(B(k), self._bias)
        graph.add(gtsam.CombinedImuFactor(X(previous), V(previous), X(k), V(k), B(previous), B(k), preintegrated))
        if still:
            self._add_rest(graph, previous, k)
        self._observe(k, predicted.pose().rotation().matrix(), observations)
        tracks, removed = self._renew_factors(graph, observations.ids)
        first_new = graph.size() - len(tracks)
        self._k = k
        try:
            self._solver.update(graph, values, {key(k): t_ns * 1e-9 for key in (X, V, B)}, removed)
        except RuntimeError as error:  # indeterminate linear system: too little parallax, or a wild outlier
            self._restart(_nav_state(t_ns, predicted, self._bias), self._covariance)
            return (f"solver restored: {str(error).strip().splitlines()[0]}",)
        slots = self._solver.getISAM2Result().getNewFactorsIndices()
        for track, slot in zip(tracks, slots[first_new:], strict=True):
            track.slot = slot
        self._state = self._read_state(t_ns)
        self._forget()
        self._reject(observations)
        return ()

    def _restart(self, start: NavState, covariance: Array) -> None:
        """Begin anew at a state, as sure of it as the covariance (15, 15) says."""
        c = self._config
        params = gtsam.ISAM2Params()
        params.setRelinearizeThreshold(c.relinearise_threshold)
        params.relinearizeSkip = 1
        params.findUnusedFactorSlots = True
        self._solver = gtsam.IncrementalFixedLagSmoother(c.lag_s, params)
        self._tracks = {}
        self._condemned = []
        self._k = 0
        pose = gtsam.Pose3(start.T_world_imu)
        self._bias = gtsam.imuBias.ConstantBias(start.accel_bias_m_s2, start.gyro_bias_rad_s)
        self._nav = gtsam.NavState(pose, start.velocity_m_s)
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        P = covariance_to_gtsam(covariance, start.T_world_imu[:3, :3])
        gaussian = gtsam.noiseModel.Gaussian.Covariance
        graph.add(gtsam.PriorFactorPose3(X(0), pose, gaussian(P[:6, :6])))
        graph.add(gtsam.PriorFactorVector(V(0), start.velocity_m_s, gaussian(P[6:9, 6:9])))
        graph.add(gtsam.PriorFactorConstantBias(B(0), self._bias, gaussian(P[9:, 9:])))
        values.insert(X(0), pose)
        values.insert(V(0), start.velocity_m_s)
        values.insert(B(0), self._bias)
        self._solver.update(graph, values, {key(0): start.t_ns * 1e-9 for key in (X, V, B)}, [])
        self._state = self._read_state(start.t_ns)

    def _add_rest(self, graph: gtsam.NonlinearFactorGraph, previous: int, k: int) -> None:
        """Say that the drone stood still between two keyframes."""
        c = self._config
        graph.add(
            gtsam.PriorFactorVector(V(k), np.zeros(3), gtsam.noiseModel.Isotropic.Sigma(3, c.still_velocity_sigma))
        )
        graph.add(
            gtsam.BetweenFactorPose3(
                X(previous), X(k), gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, c.still_pose_sigma)
            )
        )

    def _observe(self, k: int, R_world_imu: Array, observations: Observations) -> None:
        """Add the sightings of keyframe k to the tracks."""
        rays = np.column_stack([observations.xy, np.ones(len(observations))])
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        bearings = rays @ (R_world_imu @ self._T_imu_cam[:3, :3]).T
        for track_id, xy, bearing in zip(observations.ids.tolist(), observations.xy, bearings, strict=True):
            if track_id in self._banned:
                continue
            track = self._tracks.get(track_id)
            if track is None:
                track = self._tracks[track_id] = _Track(first_bearing=bearing)
            track.keyframes.append(k)
            track.xy.append(xy)
            cosine = float(bearing @ track.first_bearing)
            track.parallax = max(track.parallax, float(np.arccos(min(cosine, 1.0))))

    def _renew_factors(
        self, graph: gtsam.NonlinearFactorGraph, seen_ids: npt.NDArray[np.int64]
    ) -> tuple[list[_Track], list[int]]:
        """Add the smart factors of the tracks seen in this keyframe; return the tracks, and the slots they leave."""
        c = self._config
        tracks, removed = [], self._condemned
        self._condemned = []
        min_parallax = np.radians(c.min_parallax_deg)
        for track_id in seen_ids.tolist():
            track = self._tracks.get(track_id)
            if track is None or len(track.keyframes) < c.min_views or track.parallax < min_parallax:
                continue
            if track.slot >= 0:
                removed.append(track.slot)
            factor = gtsam.SmartProjectionRigFactorPinholePoseCal3_S2(
                self._measurement_noise, self._cameras, self._smart
            )
            factor.add(track.xy, [X(k) for k in track.keyframes])
            graph.add(factor)
            track.factor = factor
            tracks.append(track)
        return tracks, removed

    def _forget(self) -> None:
        """Let go of what left the window.

        A smart factor whose oldest keyframe was marginalised has been absorbed whole into the prior. Its track begins
        anew, so that no sighting counts twice.
        """
        oldest = min(gtsam.symbolIndex(key) for key in self._solver.timestamps())
        newest = self._k
        for track_id, track in list(self._tracks.items()):
            if track.keyframes[0] < oldest:
                if track.factor is None:
                    first = next((i for i, k in enumerate(track.keyframes) if k >= oldest), len(track.keyframes))
                    track.keyframes, track.xy = track.keyframes[first:], track.xy[first:]
                else:
                    track.keyframes, track.xy = [], []
                    track.factor, track.slot = None, -1
                if not track.keyframes or track.keyframes[-1] < newest:
                    del self._tracks[track_id]

    def _reject(self, observations: Observations) -> None:
        """Drop landmarks that are not seen where they should be."""
        T_cam_world = inverse_pose(self._state.T_world_imu @ self._T_imu_cam)
        ids, points = self.landmarks()
        _, i, j = np.intersect1d(ids, observations.ids, assume_unique=True, return_indices=True)
        p = points[i] @ T_cam_world[:3, :3].T + T_cam_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            error = np.linalg.norm(p[:, :2] / p[:, 2:] - observations.xy[j], axis=1)
        wrong = (p[:, 2] <= 0.0) | ~(error < self._config.max_reprojection_px / self._focal_px)
        for track_id in ids[i[wrong]].tolist():
            self._condemned.append(self._tracks.pop(track_id).slot)
            self._banned.add(track_id)

    def _read_state(self, t_ns: int) -> NavState:
        k = self._k
        pose = self._solver.calculateEstimatePose3(X(k))
        velocity = self._solver.calculateEstimateVector(V(k))
        self._bias = self._solver.calculateEstimateConstantBias(B(k))
        self._nav = gtsam.NavState(pose, velocity)
        joint = self._solver.getISAM2().jointMarginalCovariance([X(k), V(k), B(k)])
        self._covariance = covariance_from_gtsam(joint.fullMatrix(), pose.rotation().matrix())
        return _nav_state(t_ns, self._nav, self._bias, self._covariance)


def _nav_state(
    t_ns: int, nav: gtsam.NavState, bias: gtsam.imuBias.ConstantBias, covariance: Array | None = None
) -> NavState:
    return NavState(t_ns, nav.pose().matrix(), nav.velocity(), bias.gyroscope(), bias.accelerometer(), covariance)
