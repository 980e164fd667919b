"""The suite ``explore``: flights through unknown worlds, in groups that share worlds and seeds.

Seeds from 1200 on are those of the figures; constants were tuned on seeds below 100. Groups on the same seeds have the
same worlds and goals, so that they can be compared flight by flight. A flight that crashes the program counts as one
that has not reached its goal, or has seen nothing.
"""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from multiprocessing.pool import ThreadPool
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from scipy.stats import binomtest

from dronevio.eval.benchmark.isolation import call_in_process
from dronevio.models.errors import InputError
from dronevio.models.progress import Progress, silent

RESULTS_FILE = "flights.jsonl"
"""File of the flights, one JSON document on each line."""
GOAL_M = 0.5
"""True distance from the goal at the end within which it is reached [m]."""
CONFIDENCE = 0.95
_WORLDS = ("room", "forest", "warehouse", "corridor", "office")
_COVERED = ("office", "forest", "warehouse")
_COVER_S = 60.0
_FIRST = 1200
_STAGES = ("depth", "map", "plan")
_TWICE = {"drift_m_per_sqrt_m": 0.008, "yaw_drift_rad_per_sqrt_m": 0.002}
_PERFECT = {"depth_sigma_per_m": 1e-4, "drift_m_per_sqrt_m": 0.0, "yaw_drift_rad_per_sqrt_m": 0.0}


@dataclass(frozen=True)
class Group:
    """Flights that are flown in the same way."""

    name: str
    """Name, such as ``estimate``."""
    description: str
    """What the flights have in common."""
    worlds: tuple[str, ...]
    """Worlds of the flights."""
    seeds: range
    """Seeds in each world."""
    options: Mapping[str, Any] = field(default_factory=dict)
    """Options of `fly`, as plain values."""


GROUPS: Mapping[str, Group] = MappingProxyType(
    {
        group.name: group
        for group in (
            Group("estimate", "on the estimate, from images", _WORLDS, range(_FIRST, _FIRST + 20)),
            Group("rays", "depth along rays, drifting odometry", _WORLDS, range(2000, 2030), {"rays": {}}),
            Group("true-pose", "true pose, same images", _WORLDS, range(_FIRST, _FIRST + 6), {"true_pose": True}),
            Group("no-slam", "map without loops", ("office", "corridor"), range(_FIRST, _FIRST + 12), {"slam": False}),
            Group("dark", "no light for 1 s", ("office", "forest"), range(_FIRST, _FIRST + 6), {"dark_s": 1.0}),
            Group("wind", "gusts at 3 m/s", ("office", "forest"), range(_FIRST, _FIRST + 6), {"wind_m_s": 3.0}),
            Group("drift", "twice the drift", ("office", "corridor"), range(2000, 2006), {"rays": _TWICE}),
            Group("perfect", "perfect depth and pose", ("office",), range(_FIRST, _FIRST + 20), {"rays": _PERFECT}),
            Group("cover", "coverage in 60 s", _COVERED, range(_FIRST, _FIRST + 3), {"views": "gain"}),
            Group("cover-nearest", "nearest frontier", _COVERED, range(_FIRST, _FIRST + 3), {"views": "nearest"}),
            Group("narrow", "doors of 0.9 m", ("office-narrow",), range(_FIRST, _FIRST + 6), {"radius_m": 0.36}),
            Group("white", "white walls", ("office-white",), range(_FIRST, _FIRST + 6)),
            Group("glass", "walls of glass", ("office-glass",), range(_FIRST, _FIRST + 6)),
            Group("one-camera", "one camera", ("office",), range(_FIRST, _FIRST + 6), {"rig": "euroc"}),
        )
    }
)
"""The groups of the suite by name."""


@dataclass(frozen=True)
class FlightKey:
    """One flight of the suite."""

    group: str
    """Name of the group."""
    world: str
    """Name of the world."""
    seed: int
    """Seed of world, goal and sensors."""


def keys(groups: Sequence[str] = ()) -> tuple[FlightKey, ...]:
    """Return the flights of groups, all by default, seed by seed so that every world is flown early."""
    chosen = [GROUPS[name] for name in groups or GROUPS]
    return tuple(FlightKey(g.name, world, seed) for g in chosen for seed in g.seeds for world in g.worlds)


def fly(key: FlightKey) -> dict[str, Any]:
    """Fly and return the row of a flight: its key, its scores, and why it failed, if it did."""
    from dronevio.autonomy.exploration import LONGEST_S, RIG, exploration_scenario, explore
    from dronevio.autonomy.goals import drawn_goal
    from dronevio.autonomy.planning.body import Body
    from dronevio.autonomy.ray_sensing import RaySensing
    from dronevio.autonomy.settings import ExploreSettings
    from dronevio.sim.faults import Faults
    from dronevio.sim.physics.wind import Wind

    options = GROUPS[key.group].options
    scenario = exploration_scenario(key.world, key.seed, options.get("rig", RIG))
    if "dark_s" in options:
        scenario = replace(scenario, faults=Faults(dark_from_s=18.0, dark_for_s=options["dark_s"]))
    if "wind_m_s" in options:
        scenario = replace(scenario, wind=Wind((options["wind_m_s"], 0.0, 0.0), 1.0))
    settings = ExploreSettings()
    if "radius_m" in options:
        radius_m = options["radius_m"]
        settings = replace(settings, body=Body(radius_m, min(radius_m, settings.body.bare_radius_m)))
    if "views" in options:
        settings = replace(settings, views=options["views"])
    covers = "views" in options
    rays = RaySensing(**options["rays"]) if "rays" in options else None
    found = explore(
        scenario,
        None if covers else tuple(drawn_goal(key.world, key.seed, key.seed, settings.body)),
        task="cover" if covers else "reach",
        longest_s=_COVER_S if covers else LONGEST_S,
        settings=settings,
        slam=options.get("slam", True),
        true_pose=options.get("true_pose", False),
        without_images=rays,
    )
    stages = {name: getattr(found.times, name) for name in _STAGES if getattr(found.times, name)}
    planning_s = sum(sum(values) for values in stages.values()) * 1e-3
    last = found.decisions[-1].what if found.decisions else ""
    return {
        **asdict(key),
        **asdict(found.scores),
        "reason": str(found.flight.collision) if found.flight.collision else last,
        "planning_cpu_per_s": planning_s / found.scores.time_s,
        "cpu_per_s": found.cpu_s / found.scores.time_s,
        **{f"{name}_p99_ms": float(np.percentile(values, 99)) for name, values in stages.items()},
    }


def read_rows(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of the flights in a folder; none if there is no file.

    Raises:
        InputError: A line is no row.
    """
    path, rows = folder / RESULTS_FILE, []
    if not path.exists():
        return []
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1):
        try:
            row = json.loads(line)
            FlightKey(row["group"], row["world"], row["seed"])
        except (ValueError, KeyError, TypeError) as error:
            raise InputError(f"{path}:{number}", "no flight of the suite", "a line that it has written") from error
        rows.append(row)
    return rows


def run_suite(
    folder: Path, groups: Sequence[str], workers: int, progress: Progress = silent, seeds: int | None = None
) -> list[dict[str, Any]]:
    """Fly the flights of groups that are not in a folder yet, and return the rows of all of them.

    Args:
        folder: Folder of the results; each row is written when its flight has ended.
        groups: Names of groups; none for all.
        workers: Number of processes.
        progress: Called with the number of finished flights and their total.
        seeds: Largest number of seeds of each world; None for all.
    """
    wanted = [key for key in keys(groups) if seeds is None or key.seed < GROUPS[key.group].seeds[0] + seeds]
    folder.mkdir(parents=True, exist_ok=True)
    rows = {_key(row): row for row in read_rows(folder)}
    missing = [key for key in wanted if key not in rows]
    for done, row in enumerate(_flown(missing, workers), 1):
        rows[_key(row)] = row
        with (folder / RESULTS_FILE).open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")
        progress(len(wanted) - len(missing) + done, len(wanted))
    return [rows[key] for key in wanted]


def _flown(missing: Sequence[FlightKey], workers: int) -> Iterator[dict[str, Any]]:
    """Fly, each flight in a process of its own, and yield the rows as flights end; the threads only wait."""
    with ThreadPool(workers) as threads:
        yield from threads.imap_unordered(_flown_apart, missing)


def _flown_apart(key: FlightKey) -> dict[str, Any]:
    """Fly in another process; return a row with the reason if it fails, which counts as a failure of the flight."""
    outcome = call_in_process(fly, key)
    if outcome.status == "ok":
        return dict(outcome.value)
    return {**asdict(key), "outcome": "error", "collided": False, "reason": outcome.reason}


def _key(row: Mapping[str, Any]) -> FlightKey:
    """Return the key of a row."""
    return FlightKey(row["group"], row["world"], row["seed"])


@dataclass(frozen=True)
class Summary:
    """Summary of the flights of a group in a world, or in all of its worlds."""

    group: str
    """Name of the group."""
    world: str
    """Name of the world; ``all`` for all of them."""
    flights: int
    """Number of flights."""
    reached: int
    """Number of flights that ended within `GOAL_M` of the goal without a collision."""
    reached_bounds: tuple[float, float]
    """Clopper-Pearson interval of their probability."""
    collisions: int
    """Number of collisions."""
    collisions_bounds: tuple[float, float]
    """Clopper-Pearson interval of their probability."""
    path_ratio: float
    """Median length of the path by that of the shortest one, over flights that reached the goal."""
    spl: float
    """Success weighted by path length (Anderson et al., "On evaluation of embodied navigation agents", 2018, eq. 1)."""
    speed_m_s: float
    """Median of the median speeds [m/s]."""
    time_s: float
    """Median duration [s]."""
    ate_m: float
    """Median ATE [m]."""


def summaries(rows: Sequence[Mapping[str, Any]]) -> list[Summary]:
    """Return the summaries of flights to goals, by group and world, and of all worlds of a group that has several."""
    found, rows = [], [row for row in rows if not is_coverage(row)]
    for name in dict.fromkeys(row["group"] for row in rows):
        of_group = [row for row in rows if row["group"] == name]
        worlds = list(dict.fromkeys(row["world"] for row in of_group))
        found += [_summary(name, world, [row for row in of_group if row["world"] == world]) for world in worlds]
        if len(worlds) > 1:
            found.append(_summary(name, "all", of_group))
    return found


def has_reached(row: Mapping[str, Any]) -> bool:
    """Return whether a flight ended near its goal without a collision, as its pilot said."""
    return bool(row["outcome"] == "reached" and row["distance_to_goal_m"] <= GOAL_M and not row["collided"])


def is_coverage(row: Mapping[str, Any]) -> bool:
    """Return whether a flight had no goal, but was to see what it can reach."""
    return "views" in GROUPS[row["group"]].options


@dataclass(frozen=True)
class CoveragePair:
    """Two flights in the same world: by the expected volume of views, and to the nearest frontier."""

    world: str
    """Name of the world."""
    seed: int
    """Its seed."""
    by_gain: float
    """Share of the reachable places that is known to be free at the end; 0 after an error."""
    by_nearest: float
    """The same of the other flight."""
    collided: bool
    """Whether one of them collided."""

    @property
    def ratio(self) -> float:
        """Ratio of the shares."""
        return self.by_gain / self.by_nearest if self.by_nearest else np.inf


def coverage_pairs(rows: Sequence[Mapping[str, Any]]) -> list[CoveragePair]:
    """Return the pairs of flights for coverage of which both were flown."""
    flown = {(row["group"], row["world"], row["seed"]): row for row in rows if is_coverage(row)}
    pairs = []
    for (group, world, seed), row in flown.items():
        other = flown.get(("cover-nearest", world, seed))
        if group == "cover" and other is not None:
            shares = row.get("covered_share", 0.0), other.get("covered_share", 0.0)
            pairs.append(CoveragePair(world, seed, *shares, row["collided"] or other["collided"]))
    return pairs


def _summary(group: str, world: str, rows: Sequence[Mapping[str, Any]]) -> Summary:
    """Return the summary of rows."""
    good = [row for row in rows if has_reached(row)]
    collisions = sum(bool(row["collided"]) for row in rows)
    ratios = [row["path_m"] / row["shortest_m"] for row in good if np.isfinite(row["shortest_m"])]

    def median(name: str) -> float:
        values = [row[name] for row in rows if row.get(name) is not None]
        return float(np.median(values)) if values else np.nan

    return Summary(
        group,
        world,
        len(rows),
        len(good),
        _bounds(len(good), len(rows)),
        collisions,
        _bounds(collisions, len(rows)),
        float(np.median(ratios)) if ratios else np.nan,
        sum(1.0 / max(ratio, 1.0) for ratio in ratios) / len(rows),
        median("median_speed_m_s"),
        median("time_s"),
        median("ate_m"),
    )


def _bounds(count: int, total: int) -> tuple[float, float]:
    """Return the Clopper-Pearson interval of a probability."""
    interval = binomtest(count, total).proportion_ci(CONFIDENCE, method="exact")
    return float(interval.low), float(interval.high)
