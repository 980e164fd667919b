"""Kidnappings: visual SLAM on a flight that goes over, in the air, to another visit of the same places.

Each kidnapping continues the images and the IMU of flight A, up to a random time, with those of B from a random revisit
of A on: a later part of A, or a flight in the same world (``--world-seed``). The pose after the splice is not close to
that before it, and most frames of the five seconds after it are revisits of A, so that there is a place to recognize. A
row tells when the odometry began anew, when the map was joined, and the error of the first pose in the map frame then,
with yaw and position aligned at the first pose of the flight. A joining is wrong if this error is beyond 5 cm + 2 % of
the median depth or beyond 1°, each added to the error before the splice. Where the pose in the map frame never
disappears, the map is joined from the first frame on after which all errors are within these limits, and it is wrong if
the estimator reports that it tracks while they are not. Rows depend on the seed and on their number only, so that
``--first`` continues an interrupted run::

    .venv/bin/python benchmarks/kidnappings.py recordings/room-laps recordings/hall-laps --count 100 --cameras 2
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import tyro
from measuring import print_as_made, text

from dronevio.benchmark.true_views import recording_views
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.metrics.association import interpolate, nearest_rows
from dronevio.eval.metrics.revisits import LoopTolerance, RevisitRule, Views, find_revisits
from dronevio.eval.run import POSE_IS_VALID
from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, read_frame_truth
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.scenario_file import world_of
from dronevio.models.rotation import inverse_pose, log_so3, pose_matrix, rotation_z, yaw_rad_from_matrix
from dronevio.models.state import Estimate, Health
from dronevio.recording.excerpts import SplicedRecording

BEFORE_S, AFTER_S = 10.0, 10.0
"""Shortest time in the air before the splice, and time after it that is estimated [s]."""
CLIMB_M = 0.3
"""Height above the start from which on the vehicle is in the air [m]."""
MAX_SINCE_START_S, MAX_SINCE_SPLICE_S = 2.0, 5.0
"""Longest times to the joining since the odometry began anew and since the splice [s]."""
KNOWN_SHARE = 0.75
"""Smallest share of revisits among the frames within `MAX_SINCE_SPLICE_S` after the splice."""
_FRAMES_APART = 5
_GAP_NS, _GAP_M = 10**12, 1e3  # between two flights, so that all frames of the first are old enough


@dataclass(frozen=True)
class KidnappingsCommand:
    """Measure how visual SLAM finds its map again."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings of simulated flights."""
    count: int = 10
    """Number of kidnappings."""
    first: int = 0
    """Number of the first one."""
    seed: int = 0
    """Seed of the random choices."""
    cameras: int = 1
    """Number of cameras that the estimator uses."""


@dataclass(frozen=True)
class Splice:
    """Where one flight goes over to another one."""

    end_s: float
    """Time after the first frame of the first flight [s]."""
    start_s: float
    """Time after the first frame of the second flight [s]."""


@dataclass(frozen=True)
class Outcome:
    """What happened after a splice."""

    start_s: float | None
    """Time from the splice to the new start of the odometry [s]; 0 if it went on, None if it did not begin again."""
    joined_s: float | None
    """Time from the splice to the first pose in the map frame after the odometry began anew [s]; None without one."""
    error_m: float | None
    """Position error of that pose [m]."""
    error_rad: float | None
    """Orientation error of that pose [rad]."""
    wrong: bool
    """Whether that pose is beyond the limits, or the estimator tracked in a wrong place."""

    @property
    def in_time(self) -> bool:
        """Whether the map was joined rightly and in time."""
        if self.start_s is None or self.joined_s is None or self.wrong:
            return False
        return self.joined_s - self.start_s <= MAX_SINCE_START_S and self.joined_s <= MAX_SINCE_SPLICE_S


def possible_splices(first: Views, second: Views | None, rng: np.random.Generator) -> Splice | None:
    """Return a random splice; None if there is none.

    Args:
        first: Views of the first flight, of frames at regular intervals.
        second: Those of the second flight in the same world; None for a later part of the first one.
        rng: Random choices.
    """
    both = first if second is None else _concatenated(first, second)
    begin = 0 if second is None else len(first)  # of the second flight
    revisits = find_revisits(both)
    flying = both.Ts_world_cam[:, 2, 3] > both.Ts_world_cam[0, 2, 3] + CLIMB_M
    last_s = (both.t_ns[-1] - both.t_ns) * 1e-9
    ends = np.flatnonzero(flying[: len(first)] & (_airborne_s(first, flying[: len(first)]) >= BEFORE_S))
    for end in rng.permutation(ends):
        known = (revisits.then <= end) & (revisits.now > end) & (revisits.now >= begin) & flying[revisits.now]
        is_known = np.isin(np.arange(len(both)), revisits.now[known])
        starts = np.unique(revisits.now[known & (last_s[revisits.now] >= AFTER_S)])
        starts = starts[[_known_share(both.t_ns, is_known, start) >= KNOWN_SHARE for start in starts.tolist()]]
        starts = starts[~_are_close(both.Ts_world_cam[end], both.Ts_world_cam[starts])]
        if len(starts):
            start = int(rng.choice(starts))
            first_ns = both.t_ns[begin]
            return Splice(float(both.t_ns[end] - both.t_ns[0]) * 1e-9, float(both.t_ns[start] - first_ns) * 1e-9)
    return None


def outcome_of(estimates: Sequence[Estimate], Ts_world_imu: Array, splice_ns: int, median_depth_m: Array) -> Outcome:
    """Return what happened after a splice.

    Args:
        estimates: (M,) Estimates of all frames, from the first on.
        Ts_world_imu: (M, 4, 4) True poses of the IMU at the frames.
        splice_ns: Time of the first frame after the splice [ns].
        median_depth_m: (M,) Median depths of the scene at the frames [m].
    """
    valid = np.array([e.health in POSE_IS_VALID and e.state is not None for e in estimates])
    mapped = valid & np.array([e.T_map_imu is not None for e in estimates])
    t_ns = np.array([e.t_ns for e in estimates])
    after, since_s = t_ns >= splice_ns, (t_ns - splice_ns) * 1e-9
    lost = np.flatnonzero(after & np.array([e.health is Health.LOST for e in estimates]))
    apart = np.flatnonzero(after & ~mapped)
    first, before = np.flatnonzero(mapped)[0], np.flatnonzero(mapped & ~after)[-1]
    T_world_map = _yaw_alignment(Ts_world_imu[first], _map_pose(estimates[first]))

    def errors_at(row: int) -> tuple[float, float]:
        return _errors(Ts_world_imu[row], T_world_map @ _map_pose(estimates[row]))

    limit, errors_before = LoopTolerance(), errors_at(before)

    def is_wrong(row: int, errors: tuple[float, float]) -> bool:
        limit_m = limit.distance_m + limit.depth_share * float(median_depth_m[row]) + errors_before[0]
        return errors[0] > limit_m or errors[1] > limit.angle_rad + errors_before[1]

    if not len(apart):
        bad = [row for row in np.flatnonzero(after).tolist() if is_wrong(row, errors_at(row))]
        until = bad[-1] + 1 if bad else int(np.argmax(after))
        if until == len(t_ns):
            return Outcome(None, None, None, None, wrong=True)
        wrong = any(estimates[row].health is Health.TRACKING for row in bad)
        return Outcome(0.0, float(since_s[until]), *errors_at(until), wrong)
    joined = np.flatnonzero(mapped & (np.arange(len(t_ns)) > apart[0]))
    until = joined[0] if len(joined) else len(t_ns)
    lost = lost[lost < until]
    begun = np.flatnonzero(valid & (np.arange(len(t_ns)) > lost[-1])) if len(lost) else np.zeros(1, np.int64)
    start_s = (float(since_s[begun[0]]) if len(lost) else 0.0) if len(begun) else None
    if not len(joined):
        return Outcome(start_s, None, None, None, wrong=False)
    errors = errors_at(until)
    return Outcome(start_s, float(since_s[until]), *errors, is_wrong(until, errors))


def kidnap(first: Path, second: Path, splice: Splice, cameras: int, views: Views) -> Outcome:
    """Run visual SLAM on a spliced flight.

    Args:
        first: Recording of the first flight.
        second: That of the second flight, or the same.
        splice: Where the first goes over to the second.
        cameras: Number of cameras that the estimator uses.
        views: The true views of the second flight.
    """
    one, two = (open_recording(folder, cameras) for folder in (first, second))
    recording = SplicedRecording.at(one, splice.end_s, two, splice.start_s)
    truth = recording.ground_truth
    assert truth is not None
    slam, estimates, splice_ns = VisualSlam(recording.rig), list[Estimate](), recording.splice_ns
    for measurement in measurements(recording):
        if isinstance(measurement, ImuSamples):
            slam.add_imu(measurement)
            continue
        if measurement.t_ns > splice_ns + round(AFTER_S * 1e9):
            break
        estimates.append(slam.add_frame(measurement))
    slam.close()
    true, known = interpolate(truth, np.array([estimate.t_ns for estimate in estimates]))
    t_ns, estimates = true.t_ns, [estimates[row] for row in known]
    since_start_ns = views.t_ns - int(two.frame_times_ns[0]) - round(splice.start_s * 1e9)
    depth_m = views.median_depth_m[nearest_rows(since_start_ns, t_ns - splice_ns)]
    return outcome_of(estimates, true.Ts_world_imu, splice_ns, depth_m)


def sampled_views(folder: Path) -> Views:
    """Return the true views of a recording at regular intervals."""
    return recording_views(folder, read_frame_truth(folder / "mav0" / FRAME_TRUTH_FILE).t_ns[::_FRAMES_APART])


def _concatenated(first: Views, second: Views) -> Views:
    """Return the views of one flight and, much later, of another one with the same camera."""
    t_ns = second.t_ns - second.t_ns[0] + first.t_ns[-1] + _GAP_NS
    return Views(
        np.concatenate([first.t_ns, t_ns]),
        np.concatenate([first.path_m, second.path_m + first.path_m[-1] + _GAP_M]),
        np.concatenate([first.Ts_world_cam, second.Ts_world_cam]),
        first.camera,
        np.concatenate([first.ranges_m, second.ranges_m]),
    )


def _known_share(t_ns: npt.NDArray[np.int64], is_known: npt.NDArray[np.bool_], start: int) -> float:
    """Return the share of known frames among those within `MAX_SINCE_SPLICE_S` from a frame on."""
    since_s = (t_ns - t_ns[start]) * 1e-9
    return float(is_known[(since_s >= 0.0) & (since_s <= MAX_SINCE_SPLICE_S)].mean())


def _airborne_s(views: Views, flying: npt.NDArray[np.bool_]) -> Array:
    """Return the time (K,) since the vehicle was in the air first [s]."""
    return np.asarray((views.t_ns - views.t_ns[int(np.argmax(flying))]) * 1e-9)


def _are_close(T_world_a: Array, Ts_world_b: Array) -> npt.NDArray[np.bool_]:
    """Return whether cameras (M, 4, 4) are as close to another one as a revisit."""
    rule = RevisitRule()
    apart_m = np.linalg.norm(Ts_world_b[:, :3, 3] - T_world_a[:3, 3], axis=1)
    cosine = Ts_world_b[:, :3, 2] @ T_world_a[:3, 2]
    return np.asarray((apart_m <= rule.distance_m) & (cosine >= np.cos(rule.angle_rad)))


def _map_pose(estimate: Estimate) -> Array:
    assert estimate.T_map_imu is not None
    return estimate.T_map_imu


def _yaw_alignment(T_world_imu: Array, T_map_imu: Array) -> Array:
    """Return the pose of the map frame in the world, a rotation about z and a position, by one pose."""
    R = rotation_z(yaw_rad_from_matrix(T_world_imu[:3, :3] @ T_map_imu[:3, :3].T))
    return pose_matrix(R, T_world_imu[:3, 3] - R @ T_map_imu[:3, 3])


def _errors(T_true: Array, T: Array) -> tuple[float, float]:
    """Return position error [m] and orientation error [rad]."""
    D = inverse_pose(T_true) @ T
    return float(np.linalg.norm(D[:3, 3])), float(np.linalg.norm(log_so3(D[:3, :3])))


def row_of(number: int, names: tuple[str, str], splice: Splice, outcome: Outcome) -> dict[str, str]:
    """Return the row of a kidnapping."""
    joined, start = outcome.joined_s, outcome.start_s
    since_start = None if joined is None or start is None else joined - start
    return {
        "kidnapping": f"{number}: `{names[0]}`" + ("" if names[0] == names[1] else f" + `{names[1]}`"),
        "from, to [s]": f"{splice.end_s:.1f}, {splice.start_s:.1f}",
        "new start [s]": text(start, ".2f"),
        "joined [s]": text(joined, ".2f"),
        "since new start [s]": text(since_start, ".2f"),
        "error [mm]": text(None if outcome.error_m is None else 1e3 * outcome.error_m, ".0f"),
        "error [°]": text(None if outcome.error_rad is None else float(np.degrees(outcome.error_rad)), ".2f"),
        "": "wrong" if outcome.wrong else "in time" if outcome.in_time else "not joined" if joined is None else "late",
    }


def chosen_splice(
    views: Mapping[Path, Views], pairs: Sequence[tuple[Path, Path]], rng: np.random.Generator
) -> tuple[Path, Path, Splice]:
    """Return two flights and a random splice of them.

    Raises:
        ConfigError: There is no possible splice.
    """
    for index in rng.permutation(len(pairs)):
        first, second = pairs[int(index)]
        splice = possible_splices(views[first], None if first == second else views[second], rng)
        if splice is not None:
            return first, second, splice
    raise ConfigError("no flight revisits a place in the air late enough; expected flights that come back")


def main(command: KidnappingsCommand) -> None:
    """Print a row for each kidnapping as it ends, and the shares.

    Raises:
        ConfigError: There is no possible kidnapping.
    """
    views = {folder: sampled_views(folder) for folder in command.recordings}
    pairs = [(a, b) for a, b in product(views, views) if world_of(a) == world_of(b)]
    outcomes: list[Outcome] = []

    def rows() -> Iterator[dict[str, str]]:
        for number in range(command.first, command.first + command.count):
            first, second, splice = chosen_splice(views, pairs, np.random.default_rng([command.seed, number]))
            outcomes.append(kidnap(first, second, splice, command.cameras, views[second]))
            yield row_of(number, (first.name, second.name), splice, outcomes[-1])

    print_as_made(rows())
    in_time, wrong = sum(each.in_time for each in outcomes), sum(each.wrong for each in outcomes)
    print(f"\n{in_time} of {len(outcomes)} joined in time, {wrong} wrong")


if __name__ == "__main__":
    main(tyro.cli(KidnappingsCommand, description=__doc__))
