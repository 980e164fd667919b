"""``dronevio policy evaluate``: success, errors and crashes of policies over many episodes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from dronevio.cli.options import Printing, PrintOptions
from dronevio.cli.terminal import parse, print_json, print_table, progress_bars
from dronevio.models.ranges import Range, Settings

if TYPE_CHECKING:
    from dronevio.policy_evaluation import PolicyEvaluation


@dataclass(frozen=True)
class EvaluateCommand(Settings):
    """Evaluate trained policies in episodes of their environments that they have not been trained on, and baselines.

    The success rate, the distance from the goal at the end, crashes by reason, and times are averaged over all
    episodes. The seed determines the episodes, so that policies are compared in the same ones. The baselines fly to
    goals without learning: planner maps the observed depth and plans, straight flies straight ahead.

    Examples:
      dronevio policy evaluate examples/rl/policies/hover.safetensors
      dronevio policy evaluate examples/rl/policies/hover-*.safetensors --episodes 1000 --randomization moderate
      dronevio policy evaluate examples/rl/policies/race.safetensors --world-seed 3 --json
      dronevio policy evaluate planner straight --episodes 50 --worlds 50
      dronevio policy evaluate planner --environment dronevio/VioNavigate-v0 --episodes 10
    """

    policies: Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="FILE|NAME")]
    """One or more files of policies, or names of baselines: planner, straight."""
    environment: str = ""
    """Environment; by default that in which a policy was trained, and dronevio/Navigate-v0 for baselines."""
    episodes: Annotated[int, Range(1, 1_000_000)] = 100
    """Number of episodes for each policy."""
    seed: Annotated[int, Range(0, 2**32 - 1)] = 1_000_000
    """Seed of the episodes: initial states, goals, and errors of the sensors."""
    randomization: Literal["none", "moderate"] = "none"
    """Distributions of mass, inertia, rotors, drag, wind, latency and sensor errors: none, or moderate ones."""
    vehicle: str | None = None
    """Vehicle that replaces that of the training: research, nano, a YAML file with a vehicle of your own, or
    python:package.module:NAME."""
    world: str | None = None
    """World that replaces the one of the task; `dronevio worlds` lists them. A world of your own is a file,
    such as yard.yaml or yard.xml (MJCF), or python:package.module:NAME."""
    world_seed: Annotated[int, Range(0, 2**32 - 1)] = 0
    """Seed of the layout of the world, such as the course of a race."""
    worlds: Annotated[int, Range(1, 100_000)] = 1
    """Number of worlds in which the episodes are flown in turn, with consecutive seeds from --world-seed on."""
    printing: Printing = field(default_factory=PrintOptions)
    """How results are printed."""


def main(arguments: Sequence[str]) -> int:
    """Run the command and return its exit code."""
    command = parse(EvaluateCommand, arguments, "policy evaluate")

    from dronevio.models.errors import ConfigError
    from dronevio.models.policies.policy_file import load_policy

    if not command.policies:
        raise ConfigError("no policy; expected the path of one or more")

    from dronevio.policy_evaluation import BASELINES, NAVIGATE, evaluate_baseline, evaluate_policy

    # A damaged file is reported before the first run
    policies = {
        path: None if str(path) in BASELINES and not path.exists() else load_policy(path) for path in command.policies
    }

    from dronevio.sim.envs.episodes.randomization import MODERATE, NOTHING_RANDOM

    settings: dict[str, Any] = {
        "randomization": MODERATE if command.randomization == "moderate" else NOTHING_RANDOM,
        "world": command.world or "",
        "world_seed": command.world_seed,
        "world_seeds": range(command.world_seed, command.world_seed + command.worlds) if command.worlds > 1 else (),
    }
    if command.vehicle is not None:
        from dronevio.models.vehicles import vehicle_of

        settings["vehicle"] = vehicle_of(command.vehicle)
    results: dict[Path, PolicyEvaluation] = {}
    with progress_bars(quiet=command.printing.json) as bars:
        for path, policy in policies.items():
            run: dict[str, Any] = {"progress": bars.bar(path.stem), **settings}
            if policy is None:
                run["environment"] = command.environment or NAVIGATE
                results[path] = evaluate_baseline(path.stem, command.episodes, command.seed, **run)
            else:
                run["environment"] = command.environment
                results[path] = evaluate_policy(policy, command.episodes, command.seed, **run)
    if command.printing.json:
        print_json(_document(command, results))
    else:
        _print(command, results)
    return 0


def _document(command: EvaluateCommand, results: Mapping[Path, "PolicyEvaluation"]) -> dict[str, Any]:
    """Return the figures of policies by their paths, of types that JSON can represent."""
    from dronevio.sim.world import resolved_world
    from dronevio.sim.worlds.own.names import recorded_world

    policies = [
        {"policy": str(path), "environment": result.environment, **result.figures(), "ends": result.counts()}
        for path, result in results.items()
    ]
    return {
        "episodes": command.episodes,
        "seed": command.seed,
        "randomization": command.randomization,
        "vehicle": command.vehicle,
        "world": None if command.world is None else recorded_world(resolved_world(command.world)),
        "world_seed": command.world_seed,
        "worlds": command.worlds,
        "policies": policies,
    }


def _print(command: EvaluateCommand, results: Mapping[Path, "PolicyEvaluation"]) -> None:
    """Print the figures of policies by their paths."""
    rows = []
    for path, result in results.items():
        figures = result.figures()
        rows.append(
            (
                path.stem,
                result.environment,
                f"{100.0 * (figures['success_rate'] or 0.0):.1f}",
                f"{100.0 * (figures['crash_rate'] or 0.0):.1f}",
                _number(figures["final_distance_m"], ".3f"),
                _number(figures["reward"], ".1f"),
                _number(figures["success_duration_s"], ".2f"),
                _number(figures["lap_s"], ".2f"),
                ", ".join(f"{count} {reason}" for reason, count in result.counts().items()),
            )
        )
    columns = ("policy", "environment", "success %", "crash %", "distance m", "reward", "time s", "lap s", "ends")
    title = f"{command.episodes} episodes, seed {command.seed}, randomization {command.randomization}"
    print_table(title, columns, rows, left=("environment", "ends"))
    print("distance: mean distance from the goal at the end; time, lap: means over the successful episodes")


def _number(value: float | None, form: str) -> str:
    """Return a number as text, a dash for None."""
    return "–" if value is None else format(value, form)
