"""Flights with a map beside their odometry, as JSON lines and Markdown tables, and the shares that keep bounds."""

import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from measuring import table, text

from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.errors import ate
from dronevio.eval.metrics.scores import ScoredTrajectory


@dataclass(frozen=True)
class PathScores:
    """Scores of a path."""

    ate_mm: float
    """RMSE of the position after alignment of yaw and position [mm]."""
    freed_mm: float
    """RMSE of the position after a factor of the path as well [mm]."""
    scale_percent: float | None
    """Error of the scale, positive if the path is too large [%]; None for a straight line."""
    nees: float | None
    """Mean NEES of the position, 3 expected; None without covariances."""
    se3_mm: float | None = None
    """RMSE of the position after alignment of rotation and position [mm]; None for a straight line."""
    tilt_deg: float | None = None
    """Angle by which that rotation inclines the vertical [deg]."""

    @classmethod
    def of(cls, scored: ScoredTrajectory) -> "PathScores":
        """Return the scores of a path that has been compared with the truth."""
        paths = scored.truth.p_world_imu, scored.estimate.p_world_imu
        true, found = (p - p.mean(axis=0) for p in paths)
        freed = true - found * (np.sum(true * found) / np.sum(found * found))
        scores = scored.scores
        freed_mm = 1e3 * float(np.sqrt(np.mean(np.sum(freed**2, axis=1))))
        one = cls(1e3 * scores.ate_m.rmse, freed_mm, scores.scale_error_percent, scores.nees_position)
        if scores.scale_error_percent is None:
            return one
        tilt_deg = math.degrees(math.acos(min(align(*paths, "se3").R_truth_estimate[2, 2], 1.0)))
        return replace(one, se3_mm=1e3 * ate(*paths, "se3").rmse, tilt_deg=tilt_deg)


@dataclass(frozen=True)
class Flight:
    """A flight, and what the map has made of it."""

    name: str
    """Name of the recording."""
    cameras: int
    """Number of cameras."""
    start_s: float
    """Time after the first frame of the recording at which it begins [s]."""
    duration_s: float | None
    """Duration that was asked for [s]."""
    alteration: str
    """Name of the alteration."""
    outcome: str
    """What has determined the scale of the final map or why it was not used; the error of a failed flight."""
    loops: int = 0
    """Number of loops of the final map, without rejected ones."""
    rejected: int = 0
    """Number of rejected loops."""
    coverage_percent: float | None = None
    """Share of the frames later than 3 s after the first that have a pose of the odometry [%]."""
    odometry: PathScores | None = None
    """Path of the odometry; None without poses."""
    online: PathScores | None = None
    """Path as it was corrected at its frames; None without poses."""
    final: PathScores | None = None
    """Path by the final map; None without poses."""
    made_by: str = ""
    """Machine, versions of the packages, and hash of the code."""

    @property
    def key(self) -> tuple[object, ...]:
        """What identifies the flight."""
        return (self.name, self.cameras, self.start_s, self.duration_s, self.alteration)

    @classmethod
    def from_json(cls, line: str) -> "Flight":
        """Return the flight of a line."""
        values = json.loads(line)
        for path in ("odometry", "online", "final"):
            values[path] = None if values[path] is None else PathScores(**values[path])
        return cls(**values)


def mm(path: PathScores | None) -> float:
    """Return the ATE of a path [mm], infinite without one."""
    return math.inf if path is None else path.ate_mm


def freed_mm(path: PathScores | None) -> float:
    """Return the ATE of a path with the scale freed [mm], infinite without one."""
    return math.inf if path is None else path.freed_mm


def se3_mm(path: PathScores | None) -> float:
    """Return the ATE of a path after alignment of rotation and position [mm], infinite without one."""
    return math.inf if path is None or path.se3_mm is None else path.se3_mm


def ratio(numerator: float, denominator: float) -> float:
    """Return a ratio of errors, infinite if one of them is."""
    return math.inf if math.isinf(denominator) else numerator / denominator


def error_of(flight: Flight) -> Callable[[PathScores | None], float]:
    """Return the error [mm] by which the data of a flight can judge paths.

    Truth and IMU differ in scale on EuRoC's V1 flights, which is freed, and in the vertical on its V2 flights, where
    rotation is aligned.
    """
    return next((error for name, error in {"V1": freed_mm, "V2": se3_mm}.items() if flight.name.startswith(name)), mm)


def keeps_final(flight: Flight, error: Callable[[PathScores | None], float] = mm) -> bool:
    """Return whether the final path is at most 5 % worse than the odometry."""
    return ratio(error(flight.final), error(flight.odometry)) <= 1.05


def keeps_online(flight: Flight, error: Callable[[PathScores | None], float] = mm) -> bool:
    """Return whether the path corrected online is at most 5 % or 0.5 mm worse than the odometry."""
    odometry_mm = error(flight.odometry)
    return math.isfinite(odometry_mm) and error(flight.online) <= max(1.05 * odometry_mm, odometry_mm + 0.5)


def keeps_scale(flight: Flight) -> bool:
    """Return whether the error of the scale of the final path is at most 0.1 % larger than that of the odometry."""
    scales = [None if path is None else path.scale_percent for path in (flight.final, flight.odometry)]
    final, odometry = (math.inf if scale is None else abs(scale) for scale in scales)
    return math.isfinite(odometry) and final <= odometry + 0.1


def keeps_nees(flight: Flight) -> bool:
    """Return whether the mean NEES of the position of the corrected pose is in [1.5, 5]."""
    return flight.online is not None and flight.online.nees is not None and 1.5 <= flight.online.nees <= 5.0


BOUNDS: Mapping[str, Callable[[Flight], bool]] = {
    "final ≤ 1.05 × odometry": keeps_final,
    "the same, V1 with the scale freed, V2 with rotation aligned": lambda flight: keeps_final(flight, error_of(flight)),
    "online ≤ max(1.05 × odometry, odometry + 0.5 mm)": keeps_online,
    "the same, V1 and V2 likewise": lambda flight: keeps_online(flight, error_of(flight)),
    "scale error of the final path ≤ odometry + 0.1 %": keeps_scale,
    "the same, V1 by the ATE with the scale freed": lambda flight: (
        keeps_final(flight, freed_mm) if flight.name.startswith("V1") else keeps_scale(flight)
    ),
    "NEES of the corrected position in [1.5, 5]": keeps_nees,
}
"""Bounds by name, of which a share of the flights keeps each."""


def median_gain(
    flights: Sequence[Flight], error_of: Callable[[Flight], Callable[[PathScores | None], float]] = lambda _: mm
) -> float | None:
    """Return the median of final / odometry of the flights with loops and of those that failed; None without any."""
    errors = [(error_of(f), f) for f in flights if f.loops or f.final is None]
    ratios = [ratio(error(f.final), error(f.odometry)) for error, f in errors]
    return statistics.median(ratios) if ratios else None


def summary(flights: Sequence[Flight]) -> str:
    """Return how many flights keep the bounds, all of them and by the number of cameras."""
    groups = {"all": flights}
    for cameras in sorted({flight.cameras for flight in flights}):
        groups[f"{cameras} camera{'s' * (cameras > 1)}"] = [f for f in flights if f.cameras == cameras]
    rows = [("flights", *(str(len(group)) for group in groups.values()))]
    for name, error in (
        ("final / odometry, median with loops", lambda _: mm),
        ("the same, V1 and V2 as below", error_of),
    ):
        rows.append((name, *(text(median_gain(group, error)) for group in groups.values())))
    for name, keeps in BOUNDS.items():
        kept = [sum(map(keeps, group)) for group in groups.values()]
        shares = zip(kept, groups.values(), strict=True)
        rows.append((name, *(f"{count} of {len(group)}, {100 * count / len(group):.0f} %" for count, group in shares)))
    return table(("", *groups), rows)


HEADINGS = (
    "flight", "cameras", "start [s]", "altered", "loops", "poses [%]", "odometry [mm]", "scale [%]", "online [mm]",
    "final [mm]", "scale [%]", "final / odometry", "scale freed: odometry [mm]", "online [mm]", "final [mm]",
    "rotation aligned: odometry [mm]", "online [mm]", "final [mm]", "tilt [°]", "NEES: odometry", "corrected",
    "adjustment",
)  # fmt: skip


def cells(flight: Flight) -> Sequence[str]:
    """Return the row of a flight."""
    odometry, online, final = flight.odometry, flight.online, flight.final
    scales = [text(None if path is None else path.scale_percent, "+.2f") for path in (odometry, final)]
    return (
        f"`{flight.name}`",
        str(flight.cameras),
        f"{flight.start_s:g}",
        flight.alteration,
        f"{flight.loops}" + (f" (−{flight.rejected})" if flight.rejected else ""),
        text(flight.coverage_percent, ".0f"),
        text(mm(odometry), ".1f"),
        scales[0],
        text(mm(online), ".1f"),
        text(mm(final), ".1f"),
        scales[1],
        text(ratio(mm(final), mm(odometry)), ".2f"),
        *(text(error(path), ".1f") for error in (freed_mm, se3_mm) for path in (odometry, online, final)),
        text(None if final is None else final.tilt_deg, ".2f"),
        *(text(None if path is None else path.nees, ".1f") for path in (odometry, online)),
        " ".join(flight.outcome.replace("|", "/").split()) or "–",
    )
