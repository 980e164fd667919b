"""A flight through an unknown world as reports and rerun files show it: what was flown, mapped, planned and decided."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.occupancy import OccupancyGrid
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import Trajectory


class ExplorationScores(Protocol):
    """How a flight ended, by the truth; those of `dronevio.autonomy.exploration` are meant."""

    @property
    def distance_to_goal_m(self) -> float | None:
        """True distance from the goal at the end [m]; None without a goal."""

    @property
    def path_m(self) -> float:
        """Length of the true path after take-off and turns [m]."""

    @property
    def shortest_m(self) -> float | None:
        """Length of the shortest path to the goal on the true map [m]; inf without one, None without a goal."""

    @property
    def time_s(self) -> float:
        """Duration of the flight [s]."""

    @property
    def covered_share(self) -> float:
        """Share of the reachable places that the map knows to be free."""

    @property
    def ate_m(self) -> float | None:
        """Absolute trajectory error of the estimate (RMSE) [m]; None without a pose."""

    @property
    def median_speed_m_s(self) -> float:
        """Median true speed while the vehicle moves [m/s]."""


@dataclass(frozen=True)
class TimedDecision:
    """A decision of the pilot."""

    t_ns: int
    """Time of the flight [ns]."""
    what: str
    """What was decided, and why."""
    position_m: tuple[float, float, float]
    """Where the vehicle was to be in the world [m]."""


@dataclass(frozen=True, eq=False)
class FlownPlan:
    """A trajectory that was flown for a while, and the route that it follows."""

    t_ns: int
    """Time of the flight from which it was flown [ns]."""
    positions_m: Array
    """(N, 3) Positions in the world to its end at rest [m]."""
    route_m: Array
    """(M, 3) Route to the goal in the world; M may be 0 [m]."""


@dataclass(frozen=True, eq=False)
class StageCost:
    """Processor times of a stage, beside its declared latency."""

    name: str
    """Name of the stage."""
    latency_ms: float
    """Declared time after which its result is used [ms]."""
    cpu_ms: Array
    """(N,) Processor times [ms]."""

    @property
    def mean_ms(self) -> float | None:
        """Mean processor time [ms]; None if the stage did not run."""
        return float(self.cpu_ms.mean()) if len(self.cpu_ms) else None

    @property
    def p99_ms(self) -> float | None:
        """99th percentile of the processor times [ms]; None if the stage did not run."""
        return float(np.percentile(self.cpu_ms, 99.0)) if len(self.cpu_ms) else None


@dataclass(frozen=True, eq=False)
class ExploredFlight:
    """A flight through an unknown world, in the frame of the world unless another is named."""

    name: str
    """Name of the flight."""
    outcome: str
    """What the drone did, in words."""
    collision: str | None
    """What touched what, and when; None without a collision."""
    scores: ExplorationScores
    """How it ended, in figures."""
    pad_m: Array
    """(3,) Landing pad [m]."""
    goal_m: Array | None
    """(3,) Goal [m]; None for coverage."""
    truth: Trajectory
    """True poses of the IMU."""
    estimate: Trajectory
    """Estimated poses of the IMU as they were published, corrected by loops if there is a map of keyframes."""
    occupancy: OccupancyGrid | None
    """What is free, occupied and unknown at the end, in the map frame; None without depth."""
    T_world_map: Array
    """(4, 4) Pose of the map frame."""
    decisions: tuple[TimedDecision, ...]
    """What the pilot decided, in the order of time."""
    plans: tuple[FlownPlan, ...]
    """The trajectories that were flown, in the order of time."""
    coverage: Array
    """(N, 2) Times of the flight [s], and the share of the reachable places that the map knew then to be free."""
    stages: tuple[StageCost, ...]
    """Costs of depth, map and plan."""
    cpu_per_s: float
    """Processor time of everything but rendering, per second of flight."""
    speed_limit_m_s: float
    """Limit of the speed of plans [m/s]."""
    heights_m: tuple[float, float]
    """Least and greatest height of routes [m]."""
    true_map: OccupancyGrid
    """What is free and occupied in truth, in the frame of the world, for drawings."""

    @property
    def goals_m(self) -> Array:
        """(G, 3) The goal, or none [m]."""
        return np.zeros((0, 3)) if self.goal_m is None else self.goal_m[None]

    @property
    def origin_ns(self) -> int:
        """Time at which the flight begins [ns]."""
        return int(self.truth.t_ns[0])

    @property
    def T_map_world(self) -> Array:
        """(4, 4) Pose of the world in the map frame."""
        return inverse_pose(self.T_world_map)

    @property
    def under_way(self) -> Trajectory:
        """True poses from the first plan on; all poses without a plan."""
        return self.truth[self.truth.t_ns >= self.plans[0].t_ns] if self.plans else self.truth
