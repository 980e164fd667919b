"""Flights with a map beside their odometry, as JSON lines and Markdown tables, and the shares that keep bounds."""

import json
import math
import statistics
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markdown_tables import table, text

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

    @classmethod
    def of(cls, scored: ScoredTrajectory) -> "PathScores":
        """Return the scores of a path that has been compared with the truth."""
        true, found = (p - p.mean(axis=0) for p in (scored.truth.p_world_imu, scored.estimate.p_world_imu))
        freed = true - found * (np.sum(true * found) / np.sum(found * found))
        scores = scored.scores
        freed_mm = 1e3 * float(np.sqrt(np.mean(np.sum(freed**2, axis=1))))
        return cls(1e3 * scores.ate_m.rmse, freed_mm, scores.scale_error_percent, scores.nees_position)


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


def ratio(numerator: float, denominator: float) -> float:
    """Return a ratio of errors, infinite if one of them is."""
    return math.inf if math.isinf(denominator) else numerator / denominator


def keeps_final(flight: Flight) -> bool:
    """Return whether the final path is at most 5 % worse than the odometry."""
    return ratio(mm(flight.final), mm(flight.odometry)) <= 1.05


def keeps_freed(flight: Flight) -> bool:
    """Return whether the same is true with the scale freed."""
    return ratio(freed_mm(flight.final), freed_mm(flight.odometry)) <= 1.05


def keeps_online(flight: Flight) -> bool:
    """Return whether the path corrected online is at most 5 % or 0.5 mm worse than the odometry."""
    odometry_mm = mm(flight.odometry)
    return math.isfinite(odometry_mm) and mm(flight.online) <= max(1.05 * odometry_mm, odometry_mm + 0.5)


def keeps_scale(flight: Flight) -> bool:
    """Return whether the error of the scale of the final path is at most 0.1 % larger than that of the odometry."""
    scales = [None if path is None else path.scale_percent for path in (flight.final, flight.odometry)]
    final, odometry = (math.inf if scale is None else abs(scale) for scale in scales)
    return math.isfinite(odometry) and final <= odometry + 0.1


def freed_on_v1(keeps: Callable[[Flight], bool]) -> Callable[[Flight], bool]:
    """Return a bound that EuRoC's V1 flights keep by `keeps_freed`: truth and IMU may differ in scale there."""
    return lambda flight: (keeps_freed if flight.name.startswith("V1") else keeps)(flight)


def keeps_nees(flight: Flight) -> bool:
    """Return whether the mean NEES of the position of the corrected pose is in [1.5, 5]."""
    return flight.online is not None and flight.online.nees is not None and 1.5 <= flight.online.nees <= 5.0


BOUNDS: Mapping[str, Callable[[Flight], bool]] = {
    "final ≤ 1.05 × odometry": keeps_final,
    "the same, V1 with the scale freed": freed_on_v1(keeps_final),
    "online ≤ max(1.05 × odometry, odometry + 0.5 mm)": keeps_online,
    "scale error of the final path ≤ odometry + 0.1 %": keeps_scale,
    "the same, V1 by the ATE with the scale freed": freed_on_v1(keeps_scale),
    "NEES of the corrected position in [1.5, 5]": keeps_nees,
}
"""Bounds by name, of which a share of the flights keeps each."""


def median_gain(flights: Sequence[Flight]) -> float | None:
    """Return the median of final / odometry of the flights with loops and of those that failed; None without any."""
    ratios = [ratio(mm(f.final), mm(f.odometry)) for f in flights if f.loops or f.final is None]
    return statistics.median(ratios) if ratios else None


def summary(flights: Sequence[Flight]) -> str:
    """Return how many flights keep the bounds, all of them and by the number of cameras."""
    groups = {"all": flights}
    for cameras in sorted({flight.cameras for flight in flights}):
        groups[f"{cameras} camera{'s' * (cameras > 1)}"] = [f for f in flights if f.cameras == cameras]
    rows = [("flights", *(str(len(group)) for group in groups.values()))]
    rows.append(("final / odometry, median with loops", *(text(median_gain(group)) for group in groups.values())))
    for name, keeps in BOUNDS.items():
        kept = [sum(map(keeps, group)) for group in groups.values()]
        shares = zip(kept, groups.values(), strict=True)
        rows.append((name, *(f"{count} of {len(group)}, {100 * count / len(group):.0f} %" for count, group in shares)))
    return table(("", *groups), rows)


HEADINGS = (
    "flight", "cameras", "start [s]", "altered", "loops", "poses [%]", "odometry [mm]", "scale [%]", "online [mm]",
    "final [mm]", "scale [%]", "final / odometry", "scale freed: odometry [mm]", "final [mm]", "NEES: odometry",
    "corrected", "adjustment",
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
        text(freed_mm(odometry), ".1f"),
        text(freed_mm(final), ".1f"),
        *(text(None if path is None else path.nees, ".1f") for path in (odometry, online)),
        " ".join(flight.outcome.replace("|", "/").split()) or "–",
    )
