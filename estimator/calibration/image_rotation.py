"""The rotation between frames by the images alone: epipolar geometry of the tracked features, without the gyroscope.

The normals of the epipolar planes of two views, f₁ × R f₂ of the bearings f, are perpendicular to the translation
between them if the rotation R is right (Kneip and Lynen, "Direct optimization of frame-to-frame rotation", ICCV 2013).
R and the direction of the translation are refined by Gauss-Newton from the rotation that aligns the bearings best.
Features that disagree, such as those on moving objects, are left out by RANSAC, or have little weight.
"""

from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from dronevio.estimator.frontend.patches import EVERY_FRAME
from dronevio.estimator.frontend.rig import RigTracker
from dronevio.estimator.frontend.tracker import TrackerConfig
from dronevio.estimator.types import Calibration, Observations, common_rows
from dronevio.models.arrays import Array, Integers
from dronevio.models.imu import Times
from dronevio.models.rig import Rig
from dronevio.models.rotation import cross, exp_so3, log_so3
from dronevio.models.state import CameraFrame

STEP_S = 0.04
"""Shortest time between successive frames of pairs [s]; more pairs would cost time and tell little."""
SPAN_S = 0.095
"""Shortest time between the frames of a pair [s]: over shorter ones, the parallax is too small to tell a rotation from
a translation."""
MAX_SPAN_S = 0.4
"""Longest time between the frames of a pair [s]; longer ones do not show short offsets."""
MIN_FEATURES = 15
"""Smallest number of common features of a pair."""
MIN_TRACKED = 150
"""Number of features below which new ones are detected, where images are tracked for their rotation alone."""
UNKNOWN_SIGMA_RAD = 0.1
"""Standard deviation of the rotation between frames where no gyroscope predicts it [rad]."""
ITERATIONS = 12
"""Number of Gauss-Newton steps."""
OUTLIER_RAD = 0.002
"""Distance of a feature from its epipolar line beyond which it is left out [rad]; a pixel of EuRoC's cameras."""
MIN_SINE = 0.05
"""Least sine of the angle between a bearing and the translation; features nearer to the epipole tell little."""
MAX_TURN = 0.5
"""Largest change of the direction of translation in one step."""
MAX_STEP_RAD = 0.05
"""Largest rotation of one step [rad]."""
_MIN_SCALE_RAD = 1e-4  # least scale of the residuals: a twentieth of a pixel of EuRoC's cameras


@dataclass(frozen=True, eq=False)
class RelativeRotations:
    """The rotations of the IMU between P pairs of frames, as the images show them."""

    start_ns: Times
    """(P,) Times of the first frames, by the clock of the camera [ns]."""
    end_ns: Times
    """(P,) Times of the second frames [ns]."""
    rotation_rad: Array
    """(P, 3) Rotation vectors of R_start_end of the IMU [rad]."""
    sigma_rad: Array
    """(P,) Standard deviations of the rotations, about the worst axis [rad]."""

    def __len__(self) -> int:
        return len(self.start_ns)

    def __getitem__(self, rows: npt.NDArray[np.bool_] | npt.NDArray[np.int64]) -> "RelativeRotations":
        """Return some of the pairs."""
        return RelativeRotations(*(values[rows] for values in vars(self).values()))

    def joined(self, later: "RelativeRotations") -> "RelativeRotations":
        """Return these pairs followed by others."""
        pairs = zip(vars(self).values(), vars(later).values(), strict=True)
        return RelativeRotations(*(np.concatenate(pair) for pair in pairs))

    @property
    def span_s(self) -> Array:
        """(P,) Times between the frames of each pair [s]."""
        return np.asarray((self.end_ns - self.start_ns) * 1e-9)


NO_ROTATIONS = RelativeRotations(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros(0))
"""The rotations of no pairs."""


def image_rotations(
    t_ns: Sequence[int], observations: Sequence[Observations], Ts_imu_cam: Array, after_ns: int | None = None
) -> RelativeRotations:
    """Return the rotations between frames that are `SPAN_S` or a little more apart, by the features that both observe.

    Frames that follow each other within less than `STEP_S` are left out. Each camera that tracks features makes pairs
    of its own.

    Args:
        t_ns: Times of M frames [ns], increasing.
        observations: Their M sets of features, with normalized coordinates.
        Ts_imu_cam: (C, 4, 4) Poses of the cameras in the IMU frame.
        after_ns: Only pairs whose second frame is later are computed; all by default [ns].
    """
    times: list[tuple[int, int, Array]] = []
    pairs: list[tuple[Array, Array]] = []
    for camera in range(len(Ts_imu_cam)):
        R_imu_cam = Ts_imu_cam[camera, :3, :3]
        before: deque[tuple[int, Integers, Array]] = deque()
        for now_ns, seen in zip(t_ns, observations, strict=True):
            mine = seen.camera == camera
            if not mine.any() or (before and now_ns - before[-1][0] < STEP_S * 1e9):
                continue
            before.append((now_ns, seen.ids[mine], seen.xy[mine]))
            while len(before) > 1 and now_ns - before[1][0] >= SPAN_S * 1e9:
                before.popleft()
            then_ns, ids, xy = before[0]
            if not SPAN_S * 1e9 <= now_ns - then_ns <= MAX_SPAN_S * 1e9 or (
                after_ns is not None and now_ns <= after_ns
            ):
                continue
            first, second = common_rows(ids, before[-1][1])
            if len(first) >= MIN_FEATURES:
                times.append((then_ns, now_ns, R_imu_cam))
                pairs.append((xy[first], before[-1][2][second]))
    if not pairs:
        return NO_ROTATIONS
    start_ns, end_ns, Rs_imu_cam = zip(*times, strict=True)
    rotations, sigmas = relative_rotations(pairs)
    of_imu = (np.stack(Rs_imu_cam) @ rotations[..., None])[..., 0]
    return RelativeRotations(np.array(start_ns), np.array(end_ns), of_imu, sigmas)


def tracked_rotations(frames: Iterable[CameraFrame], rig: Rig) -> RelativeRotations:
    """Return the rotations between the frames of a recording, tracked without an IMU.

    Args:
        frames: Successive frames, with images of all cameras of the rig.
        rig: Calibration of the cameras; the IMU is not used.
    """
    tracker, calibration = RigTracker(rig, TrackerConfig(patches=EVERY_FRAME)), Calibration(rig)
    t_ns: list[int] = []
    seen: list[Observations] = []
    for frame in frames:
        observations = tracker.track(frame, np.eye(3), UNKNOWN_SIGMA_RAD)
        if len(observations) < MIN_TRACKED:
            observations = tracker.replenish()
        t_ns.append(frame.t_ns)
        seen.append(observations)
    return image_rotations(t_ns, seen, calibration.Ts_imu_cam)


def relative_rotations(pairs: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return rotation vectors (P, 3) of R_first_second of a camera, and their standard deviations (P,) [rad].

    Args:
        pairs: P pairs of normalized coordinates (N, 2) of features, at least five, in the first and the second view.
    """
    views: list[tuple[Array, Array, Array]] = []
    starts: list[Array] = []
    for xy_first, xy_second in pairs:
        E, mask = cv2.findEssentialMat(xy_first, xy_second, np.eye(3), cv2.RANSAC, prob=0.999, threshold=OUTLIER_RAD)
        agree = np.ones(len(xy_first), dtype=np.bool_)
        if mask is not None and mask.sum() >= MIN_FEATURES:
            agree = mask[:, 0] == 1
        view = _bearings(xy_first[agree]), _bearings(xy_second[agree])
        R, weights = _aligning(*view)
        turns = [R, R]
        if E is not None and E.shape == (3, 3):  # of the two rotations of the matrix, one is turned by half a turn
            turned: list[Array] = [np.asarray(turn.T, np.float64) for turn in cv2.decomposeEssentialMat(E)[:2]]
            turns[1] = max(turned, key=lambda turn: float(np.trace(turn @ R.T)))
        views += [(*view, weights)] * 2
        starts += turns
    first, second, first_weights = (_padded(values) for values in zip(*views, strict=True))
    R, H, scale = _refined(first, second, first_weights, np.stack(starts))
    best = np.argmin(scale.reshape(-1, 2), axis=1) + 2 * np.arange(len(pairs))
    covariance = scale[best, None, None] ** 2 * np.linalg.inv(H[best])[:, :3, :3]
    return log_so3(R[best]), np.sqrt(np.linalg.eigvalsh(covariance)[:, -1])


def _padded(rows: Sequence[Array]) -> Array:
    """Return arrays (N, …) of different lengths as one (P, N, …), followed by zeros."""
    padded = np.zeros((len(rows), max(map(len, rows)), *rows[0].shape[1:]))
    for one, values in zip(padded, rows, strict=True):
        one[: len(values)] = values
    return padded


def _refined(first: Array, second: Array, weights: Array, R: Array) -> tuple[Array, Array, Array]:
    """Return the rotations (P, 3, 3), the Hessians (P, 5, 5) of them and of the translations, and the scales (P,).

    Args:
        first: (P, N, 3) Bearings in the first views; zeros where a pair has fewer.
        second: (P, N, 3) Those in the second views.
        weights: (P, N) Their first weights.
        R: (P, 3, 3) Rotations to begin at.
    """
    exists = first.any(axis=2)
    count = exists.sum(axis=1)
    normals = cross(first, second @ np.swapaxes(R, 1, 2))
    t = np.linalg.eigh(np.swapaxes(weights[..., None] * normals, 1, 2) @ normals)[1][:, :, 0]
    H, scale = np.zeros((len(R), 5, 5)), np.full(len(R), np.inf)
    for _ in range(ITERATIONS):
        turned = second @ np.swapaxes(R, 1, 2)
        across_first, across_second = cross(t[:, None], first), cross(t[:, None], turned)
        squares = (across_first**2).sum(axis=2) + (across_second**2).sum(axis=2)
        length = np.sqrt(0.5 * squares + MIN_SINE**2)[..., None]
        normals = cross(first, turned) / length
        residual = (normals @ t[..., None])[..., 0]
        tangents = np.linalg.svd(t[:, None])[2][:, 1:]
        # By a rotation of the second view, n = f × Exp(δ) R g: ∂(t·n)/∂δ = −(t × f) × R g
        J = np.concatenate([-cross(across_first, turned) / length, normals @ np.swapaxes(tangents, 1, 2)], axis=2)
        ordered = np.sort(np.where(exists, np.abs(residual), np.inf), axis=1)
        middle = ordered[np.arange(len(R)), (count - 1) // 2] + ordered[np.arange(len(R)), count // 2]
        scale = np.maximum(1.4826 * 0.5 * middle, _MIN_SCALE_RAD)
        weights = exists / (1.0 + (residual / (2.0 * scale[:, None])) ** 2) ** 2
        weighted = np.swapaxes(weights[..., None] * J, 1, 2)
        H = weighted @ J + 1e-9 * np.eye(5)
        step = -np.linalg.solve(H, weighted @ residual[..., None])[..., 0]
        angle = np.linalg.norm(step[:, :3], axis=1, keepdims=True)
        R = exp_so3(step[:, :3] * np.minimum(1.0, MAX_STEP_RAD / np.maximum(angle, 1e-12))) @ R
        t = t + (np.clip(step[:, None, 3:], -MAX_TURN, MAX_TURN) @ tangents)[:, 0]
        t = t / np.linalg.norm(t, axis=1, keepdims=True)
        if (angle < 1e-6).all():
            break
    return R, H, scale


def _aligning(first: Array, second: Array) -> tuple[Array, Array]:
    """Return the rotation (3, 3) that aligns bearings (N, 3) with others best, and weights (N,) of those that agree."""
    R, weights = np.eye(3), np.ones(len(first))
    for _ in range(3):
        U, _, Vt = np.linalg.svd((weights[:, None] * first).T @ second)
        R = U @ np.diag([1.0, 1.0, float(np.linalg.det(U @ Vt))]) @ Vt
        error = np.linalg.norm(first - second @ R.T, axis=1)
        weights = 1.0 / (1.0 + (error / max(2.0 * float(np.median(error)), _MIN_SCALE_RAD)) ** 2)
    return R, weights


def _bearings(xy: Array) -> Array:
    rays = np.column_stack([xy, np.ones(len(xy))])
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))
