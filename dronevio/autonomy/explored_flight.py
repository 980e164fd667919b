"""A flight through an unknown world in the form in which reports, rerun files and JSON documents show it."""

import math
from dataclasses import asdict
from types import MappingProxyType

import numpy as np

from dronevio.autonomy.exploration import Exploration
from dronevio.autonomy.true_map import true_map
from dronevio.eval.exploration import ExploredFlight, FlownPlan, StageCost, TimedDecision
from dronevio.eval.metrics import Alignment
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.errors import EvaluationError
from dronevio.models.state import Trajectory
from dronevio.sim.world import flight_area, solid_space

OUTCOMES = MappingProxyType(
    {
        "reached": "reached the goal",
        "covered": "saw all that it can reach",
        "unreachable": "found no way to the goal",
        "lost": "lost the estimate or the depth, and landed",
        "collision": "collided",
        "timeout": "was still under way when the time was over",
    }
)
"""What the drone did, in words."""


def explored_flight(exploration: Exploration) -> ExploredFlight:
    """Return a flight as reports and rerun files show it."""
    e, scenario, settings = exploration, exploration.scenario, exploration.settings
    pad_m = flight_area(scenario.world, scenario.seed_of_world).pad
    stages = ("depth", settings.depth_latency_s), ("map", settings.map_latency_s), ("plan", settings.plan_latency_s)
    return ExploredFlight(
        name=f"{scenario.name}, seed {scenario.seed}",
        outcome=OUTCOMES[e.scores.outcome],
        collision=None if e.flight.collision is None else str(e.flight.collision),
        scores=e.scores,
        pad_m=pad_m,
        goal_m=e.goal_m,
        truth=e.flight.truth,
        estimate=_estimate_in_world(e),
        occupancy=e.occupancy,
        T_world_map=e.T_world_map,
        decisions=tuple(TimedDecision(d.t_ns + e.waited_ns, d.what, d.position_m) for d in e.decisions),
        plans=tuple(FlownPlan(p.t_ns + e.waited_ns, p.positions_m, p.route_m) for p in e.plans),
        coverage=e.coverage + [1e-9 * e.waited_ns, 0.0],
        stages=tuple(StageCost(name, 1e3 * s, np.array(getattr(e.times, name))) for name, s in stages),
        cpu_per_s=e.cpu_s / e.scores.time_s,
        speed_limit_m_s=settings.limits.speed_m_s,
        heights_m=(float(pad_m[2] + settings.lowest_m), float(pad_m[2] + settings.highest_m)),
        true_map=true_map(solid_space(scenario.world, scenario.seed_of_world)),
    )


def document(exploration: Exploration, flight: ExploredFlight) -> dict[str, object]:
    """Return the figures of a flight, its costs and its decisions, of types that JSON can represent.

    The length of a path that does not exist is None. Times of decisions are those of the flight.

    Args:
        exploration: The flight.
        flight: The same, by `explored_flight`.
    """
    e = exploration
    scores = {name: None if value == math.inf else value for name, value in asdict(e.scores).items()}
    costs = {
        stage.name: {"latency_ms": stage.latency_ms, "cpu_ms_mean": stage.mean_ms, "cpu_ms_p99": stage.p99_ms}
        for stage in flight.stages
    }
    decisions = [{"t_s": 1e-9 * d.t_ns, "what": d.what, "position_m": list(d.position_m)} for d in flight.decisions]
    return {
        "scenario": e.scenario.name,
        "seed": e.scenario.seed,
        "world": e.scenario.recorded.world,
        "pad_m": flight.pad_m.tolist(),
        "goal_m": None if e.goal_m is None else e.goal_m.tolist(),
        **scores,
        "outcome_text": flight.collision or flight.outcome,
        "plans": len(e.plans),
        "coverage": flight.coverage.tolist(),
        "costs": costs | {"flight": {"cpu_per_s": flight.cpu_per_s}},
        "decisions": decisions,
    }


def _estimate_in_world(e: Exploration) -> Trajectory:
    """Return the estimated poses as they were published, in the map frame if there is one, placed in the world.

    They are placed by the known pose of the pad, or by the best alignment where the pilot had the true pose instead.
    """
    trajectory = e.run.trajectory if e.run.map is None else e.run.map_trajectory
    if not e.true_pose:
        return Alignment(e.T_world_map[:3, :3], e.T_world_map[:3, 3]).apply(trajectory)
    try:
        return score_trajectory(e.flight.truth, trajectory).alignment.apply(trajectory)
    except EvaluationError:
        return trajectory
