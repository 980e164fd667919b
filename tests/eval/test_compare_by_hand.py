"""Comparisons of a few runs, every figure worked out by hand."""

from dronevio.eval.benchmark.rows import Row
from dronevio.eval.compare import compare, gate, pair_up


def run(seed: int, coverage_percent: float | None, ate_m: float = 0.1) -> Row:
    """A run that ended well."""
    return Row("s", "w", seed, "vio", "c", "v", "ok", coverage_percent=coverage_percent, ate_m=ate_m, rpe_m=ate_m)


def failed(seed: int) -> Row:
    return Row("s", "w", seed, "vio", "c", "v", "timeout", "no end after 9 s")


def test_a_failed_run_covers_nothing() -> None:
    """Mean of 90, 100 and 0 %; what a run that is ok does not know counts on neither side."""
    first = [run(0, 90.0), run(1, 100.0), failed(2), run(3, None)]
    second = [failed(0), failed(1), failed(2), run(3, None)]
    (found,) = compare(pair_up(first, second))
    assert found.coverage_percent == (190.0 / 3.0, None)
    assert found.failed == (1, 3)
    assert found.newly_failed == tuple(f"s, seed {seed}, vio: timeout, no end after 9 s" for seed in (0, 1))


def test_failed_runs_lower_the_coverage_of_a_gate() -> None:
    """One of four runs fails: a quarter of the runs, and of the coverage."""
    first = [run(seed, 100.0) for seed in range(4)]
    second = [*first[:3], failed(3)]
    runs, coverage = gate(pair_up(first, second), 24.0).objections
    assert runs == "vio: 1 of 4 runs failed, 0 before"
    assert coverage == "vio: mean coverage 75.0 %, 100.0 % before"
    assert gate(pair_up(first, second), 26.0).passed
    assert gate(pair_up(second, first), 0.0).passed
