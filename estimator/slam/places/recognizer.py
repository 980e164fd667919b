"""Recognition of places: which earlier keyframes of the map a new keyframe sees again, and from where.

A new keyframe is compared with all earlier ones by its visual words (`index`), the most similar ones are verified
geometrically (`verification`), and a verified match is accepted when another keyframe, shortly before or after, has
independently led to the same correction of the path. A wrong match that survives the geometry by chance is not repeated
at the same offset by the next keyframe. Repetitive surroundings do repeat it: there the rival places of one keyframe
are verified, too, and if two of them fit at different offsets, none is accepted.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
import numpy.typing as npt

from dronevio.estimator.slam.map.keyframe import MapKeyframe
from dronevio.estimator.slam.places.features import PlaceFeatureConfig
from dronevio.estimator.slam.places.index import PlaceIndex
from dronevio.estimator.slam.places.verification import PlaceMatch, VerificationConfig, verify
from dronevio.estimator.slam.places.vocabulary import Vocabulary, default_vocabulary
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.ranges import Range, Settings
from dronevio.models.rig import Rig
from dronevio.models.rotation import inverse_pose, log_so3

MIN_SIMILARITY = 0.1
"""Smallest similarity of a keyframe that is verified."""
RIVAL_SIMILARITY = 0.7
"""Similarity of a rival place relative to the recognized one, from which on it is verified, too."""
MAX_VIEW_DEG = 60.0
"""Largest angle between the optical axes of two keyframes that are compared, by the odometry [°]. Beyond it,
descriptors of the same corners hardly match."""
CONFIRM_WITHIN_S = 1.5
"""Time between two keyframes that confirm each other [s]."""
AGREE_M = 0.15
"""Largest difference of two corrections that agree [m], to which the drift of the odometry is added."""
AGREE_DEG = 1.5
"""Largest difference of the rotations of two corrections that agree [°], to which the drift is added."""


@dataclass(frozen=True)
class PlaceConfig(Settings):
    """Settings of the recognition of places."""

    features: PlaceFeatureConfig = field(default_factory=PlaceFeatureConfig)
    """Settings of the corners that are described."""
    verification: VerificationConfig = field(default_factory=VerificationConfig)
    """Settings of the geometric verification."""
    min_age_s: Annotated[float, Range(0.0, 3600.0)] = 10.0
    """Smallest age of a keyframe that is recognized [s]. Younger ones share landmarks with the current window."""
    similar: Annotated[int, Range(1, 100)] = 10
    """Number of the most similar keyframes from which those to verify are chosen."""
    verified: Annotated[int, Range(1, 100)] = 3
    """Largest number of keyframes that are verified for each new one."""
    island: Annotated[int, Range(0, 1000)] = 8
    """Difference of the positions of two keyframes in the map up to which they count as one place."""
    drift_ratio: Annotated[float, Range(0.0, 1.0)] = 0.02
    """Drift of the position of the odometry relative to the length of the path. Two corrections may differ by the drift
    between the keyframes concerned, and none may exceed the drift since the recognized keyframe."""
    drift_deg_m: Annotated[float, Range(0.0, 10.0)] = 0.05
    """Drift of the rotation of the odometry per metre of the path [°/m]."""


@dataclass(frozen=True, eq=False)
class _Place:
    """A keyframe of the map and where it stands in the order of keyframes."""

    keyframe: MapKeyframe
    path_m: float  # length of the path of the odometry up to the keyframe
    track: int  # number of the odometry frame; increases with each loss


@dataclass(frozen=True, eq=False)
class _Verified:
    """A verified match that may be confirmed by another one."""

    result: PlaceMatch
    query: _Place
    match: _Place
    published: bool

    @property
    def T_odom_query(self) -> Array:
        """(4, 4) Pose of the query by the match, in the odometry frame of the matched keyframe."""
        return np.asarray(self.match.keyframe.T_odom_imu @ self.result.T_match_query)


class PlaceRecognizer:
    """Finds the earlier keyframes that new keyframes see again."""

    def __init__(self, rig: Rig, config: PlaceConfig | None = None, vocabulary: Vocabulary | None = None) -> None:
        """Begin with an empty map.

        Args:
            rig: The calibration of the cameras.
            config: Settings.
            vocabulary: Visual words; by default those of the package.
        """
        self._rig, self._config = rig, config or PlaceConfig()
        self._vocabulary = vocabulary or default_vocabulary()
        self._index = PlaceIndex(self._vocabulary.size)
        self._places: list[_Place] = []
        self._track = 0
        self._recent: tuple[_Verified, ...] = ()  # matches of keyframes that were added
        self._located: tuple[_Verified, ...] = ()  # matches of keyframes before they were added

    def __len__(self) -> int:
        """Return the number of keyframes."""
        return len(self._places)

    def start_track(self) -> None:
        """Declare that the following keyframes have another odometry frame, as after a loss of the odometry."""
        self._track += 1

    def add(self, keyframe: MapKeyframe) -> tuple[PlaceMatch, ...]:
        """Add a keyframe and return the matches that are confirmed by it: its own, and those that waited for it.

        Args:
            keyframe: The new keyframe, with a larger number than the one before, and a later time within a track.

        Raises:
            ConfigError: The keyframe is not later than the last one.
        """
        place, words = self._checked(keyframe), self._vocabulary.assign(keyframe.features.descriptors)
        verified = self._recognize(place, words)
        self._insert(place, words)
        matches, self._recent = self._confirmed(place, verified, self._recent)
        return matches

    def locate(self, keyframe: MapKeyframe) -> PlaceMatch | None:
        """Return the match of a keyframe that is not added yet, if earlier keyframes confirm it; otherwise None.

        Args:
            keyframe: The keyframe, with the landmarks that are known so far.
        """
        place = self._checked(keyframe)
        verified = self._recognize(place, self._vocabulary.assign(keyframe.features.descriptors))
        matches, self._located = self._confirmed(place, verified, self._located)
        return matches[-1] if matches else None

    def insert(self, keyframe: MapKeyframe) -> None:
        """Add a keyframe without a search for earlier ones, as those of a map that was saved.

        Raises:
            ConfigError: The keyframe is not later than the last one.
        """
        self._insert(self._checked(keyframe), self._vocabulary.assign(keyframe.features.descriptors))

    def remove(self, number: int) -> None:
        """Remove a keyframe by its number, so that it is no longer recognized."""
        row = next(row for row, place in enumerate(self._places) if place.keyframe.number == number)
        self._index.remove(row)
        del self._places[row]

    def _checked(self, keyframe: MapKeyframe) -> _Place:
        """Return a new keyframe as a place, or raise ConfigError."""
        last = self._places[-1] if self._places else None
        if last is not None and (
            (last.track == self._track and keyframe.t_ns <= last.keyframe.t_ns)
            or keyframe.number <= last.keyframe.number
        ):
            raise ConfigError(
                f"keyframe {keyframe.number} at {keyframe.t_ns} ns after keyframe {last.keyframe.number} at"
                f" {last.keyframe.t_ns} ns; expected a larger number and a later time"
            )
        return _Place(keyframe, self._path_to(keyframe), self._track)

    def _insert(self, place: _Place, words: npt.NDArray[np.int64]) -> None:
        """Let a keyframe be recognized from now on."""
        self._index.add(words)
        self._places.append(place)

    def _path_to(self, keyframe: MapKeyframe) -> float:
        """Return the length of the path to a new keyframe; the step between two odometry frames is not known."""
        if not self._places:
            return 0.0
        last = self._places[-1]
        if last.track != self._track:
            return last.path_m
        step = keyframe.T_odom_imu[:3, 3] - last.keyframe.T_odom_imu[:3, 3]
        return last.path_m + float(np.linalg.norm(step))

    def _recognize(self, query: _Place, words: npt.NDArray[np.int64]) -> _Verified | None:
        """Return the best verified match of a new keyframe, None if there is none or if places rival."""
        c = self._config
        candidates = self._index.query(words, self._may_be_seen(query), c.similar, MIN_SIMILARITY)
        best: _Verified | None = None
        best_similarity, best_row, left = 0.0, 0, c.verified
        for row, similarity in zip(candidates.rows.tolist(), candidates.similarity.tolist(), strict=True):
            # After the first success, only one rival is of interest: another place, if it is nearly as similar.
            if best is not None and (
                abs(row - best_row) <= c.island or similarity < RIVAL_SIMILARITY * best_similarity
            ):
                continue
            if left == 0:
                break
            left -= 1
            match = self._places[row]
            result = verify(query.keyframe, match.keyframe, self._rig, c.verification)
            if not isinstance(result, PlaceMatch):
                continue
            verified = _Verified(result, query, match, published=False)
            if not self._is_possible(verified) or (best is not None and not self._agree(best, verified)):
                return None
            if best is None:
                best, best_similarity, best_row, left = verified, similarity, row, min(left, 1)
        return best

    def _may_be_seen(self, query: _Place) -> npt.NDArray[np.bool_]:
        """Return which of the keyframes may show what a new one shows, by the odometry.

        Of keyframes with another odometry frame, nothing is known; they may also be recent.
        """
        c, places = self._config, self._places
        if not places:
            return np.zeros(0, np.bool_)
        T = np.stack([place.keyframe.T_odom_imu for place in places])
        path_m = query.path_m - np.array([place.path_m for place in places])
        is_other_track = np.array([place.track != query.track for place in places])
        age_ns = query.keyframe.t_ns - np.array([place.keyframe.t_ns for place in places])
        is_old = age_ns >= round(c.min_age_s * 1e9)
        T_query = query.keyframe.T_odom_imu
        axes = np.stack([camera.T_imu_cam[:3, 2] for camera in self._rig.cameras])
        cosine = (axes @ np.swapaxes(T[:, :3, :3], 1, 2) @ T_query[:3, :3] @ axes.T).max(axis=(1, 2))
        max_angle = np.radians(np.minimum(MAX_VIEW_DEG + c.drift_deg_m * path_m, 180.0))
        distance_m = np.linalg.norm(T[:, :3, 3] - T_query[:3, 3], axis=1)
        max_distance_m = c.verification.max_distance_m + AGREE_M + c.drift_ratio * path_m
        is_near = (distance_m <= max_distance_m) & (cosine >= np.cos(max_angle))
        return np.asarray(is_other_track | (is_old & is_near))

    def _is_possible(self, verified: _Verified) -> bool:
        """Return whether the odometry may have drifted as much as a match claims."""
        query, match = verified.query, verified.match
        if query.track != match.track:
            return True
        return self._are_close(verified.T_odom_query, query.keyframe.T_odom_imu, query.path_m - match.path_m)

    def _agree(self, first: _Verified, second: _Verified) -> bool:
        """Return whether two matches lead to the same correction of the path, up to the drift between them."""
        if first.match.track != second.match.track or first.query.track != second.query.track:
            return False
        between = inverse_pose(first.query.keyframe.T_odom_imu) @ second.query.keyframe.T_odom_imu
        drift_m = abs(second.query.path_m - first.query.path_m) + abs(second.match.path_m - first.match.path_m)
        return self._are_close(first.T_odom_query @ between, second.T_odom_query, drift_m)

    def _are_close(self, first: Array, second: Array, path_m: float) -> bool:
        """Return whether two poses (4, 4) of one keyframe differ by no more than the drift along a path."""
        c, difference = self._config, inverse_pose(first) @ second
        angle_deg = float(np.degrees(np.linalg.norm(log_so3(difference[:3, :3]))))
        return (
            float(np.linalg.norm(difference[:3, 3])) <= AGREE_M + c.drift_ratio * path_m
            and angle_deg <= AGREE_DEG + c.drift_deg_m * path_m
        )

    def _confirmed(
        self, place: _Place, verified: _Verified | None, recent: tuple[_Verified, ...]
    ) -> tuple[tuple[PlaceMatch, ...], tuple[_Verified, ...]]:
        """Return the matches that a new one confirms, with the new one, and those to remember for the next keyframes.

        Args:
            place: The keyframe of the new match.
            verified: The new match; None if there is none.
            recent: Matches of the keyframes before.
        """
        oldest_ns = place.keyframe.t_ns - round(CONFIRM_WITHIN_S * 1e9)
        recent = tuple(each for each in recent if each.query.keyframe.t_ns >= oldest_ns)
        if verified is None:
            return (), recent
        agreeing = [each for each in recent if self._agree(each, verified)]
        waiting = _waiting(agreeing)
        others = [each for each in recent if each not in waiting]
        published = [_Verified(each.result, each.query, each.match, published=True) for each in waiting]
        newest = _Verified(verified.result, verified.query, verified.match, published=bool(agreeing))
        recent = (*others, *published, newest)
        return ((*(each.result for each in waiting), newest.result) if agreeing else ()), recent


def _waiting(matches: Sequence[_Verified]) -> list[_Verified]:
    """Return the matches that have not been published."""
    return [each for each in matches if not each.published]
