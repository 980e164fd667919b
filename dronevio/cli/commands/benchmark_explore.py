"""``dronevio benchmark --suite explore``: flights through unknown worlds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

from dronevio.benchmark.exploration import (
    GROUPS,
    RESULTS_FILE,
    CoveragePair,
    coverage_pairs,
    has_reached,
    is_coverage,
    run_suite,
    summaries,
)
from dronevio.cli.terminal import print_json, print_table, progress_bars
from dronevio.models.errors import unknown_name


def run_explore_suite(
    out: Path | None, groups: Sequence[str], seeds: int | None, workers: int | None, json: bool
) -> int:
    """Fly the suite, print its tables, and return the exit code.

    Args:
        out: Folder of the results; benchmarks/explore by default.
        groups: Names of groups; none for all.
        seeds: Largest number of seeds of each world; None for all.
        workers: Number of flights at the same time; the number of cores by default.
        json: Whether one JSON document is printed instead of tables.

    Raises:
        ConfigError: There is no such group.
        InputError: The folder holds something else.
    """
    from dronevio.eval.benchmark.engines import available_cores
    from dronevio.sim.cameras.gl import require_gl

    for name in groups:
        if name not in GROUPS:
            raise unknown_name("variant of the suite explore", name, GROUPS)
    require_gl()
    folder = out or Path("benchmarks") / "explore"
    with progress_bars(quiet=json) as bars:
        rows = run_suite(folder, groups, workers or available_cores(), bars.bar("flights"), seeds)
    if json:
        print_json({"results": str(folder / RESULTS_FILE), "rows": rows})
        return 0
    _print(rows)
    print(f"results:  {folder / RESULTS_FILE}")
    return 0


def _print(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the summaries, and each flight that has not reached its goal."""
    columns = (
        "flights",
        "world",
        "reached",
        "95 % interval",
        "collisions",
        "95 % interval",
        "path / shortest",
        "SPL",
        "speed [m/s]",
        "time [s]",
        "ATE [m]",
    )
    cells = [
        (
            each.group,
            each.world,
            f"{each.reached}/{each.flights}",
            _percent(each.reached_bounds),
            f"{each.collisions}",
            _percent(each.collisions_bounds),
            f"{each.path_ratio:.2f}",
            f"{each.spl:.2f}",
            f"{each.speed_m_s:.2f}",
            f"{each.time_s:.0f}",
            f"{each.ate_m:.3f}",
        )
        for each in summaries(rows)
    ]
    print_table("Flights to goals through unknown worlds; medians over flights", columns, cells, left=columns[:2])
    _print_coverage(coverage_pairs(rows))
    _print_costs(rows)
    for row in rows:
        if row["collided"] if is_coverage(row) else not has_reached(row):
            distance_m = row.get("distance_to_goal_m")
            away = "" if distance_m is None else f", {distance_m:.1f} m from the goal"
            print(f"  {row['group']}, {row['world']}, seed {row['seed']}: {row['outcome']}{away}: {row['reason']}")


def _print_coverage(pairs: Sequence[CoveragePair]) -> None:
    """Print pairs of flights for coverage, if there are any."""
    columns = ("world", "seed", "covered [%]", "nearest frontier [%]", "ratio", "collision")
    cells = [
        (
            each.world,
            f"{each.seed}",
            f"{100.0 * each.by_gain:.1f}",
            f"{100.0 * each.by_nearest:.1f}",
            f"{each.ratio:.2f}",
            "yes" if each.collided else "no",
        )
        for each in pairs
    ]
    if cells:
        print_table("Coverage in 60 s", columns, cells, left=columns[:1])
        print(f"median ratio: {median(each.ratio for each in pairs):.2f}")


def _print_costs(rows: Sequence[Mapping[str, Any]]) -> None:
    """Print the median processor times of flights with images, except those that ended with an error."""
    seen = [row for row in rows if "cpu_per_s" in row and "rays" not in GROUPS[row["group"]].options]
    if seen:
        planning_s, all_s = (median(row[name] for row in seen) for name in ("planning_cpu_per_s", "cpu_per_s"))
        print("processor time per second of flight, median over flights with images:", end=" ")
        print(f"{planning_s:.2f} s for depth, map and plan, {all_s:.2f} s for all but rendering")


def _percent(bounds: tuple[float, float]) -> str:
    """Return an interval of probabilities in percent."""
    return f"{100 * bounds[0]:.0f} to {100 * bounds[1]:.0f} %"
