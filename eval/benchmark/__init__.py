"""Benchmarks: many recordings × estimators, each run in a process of its own and stored as a row of a table.

Simulation and estimation are passed in as a `dronevio.eval.benchmark.jobs.BenchmarkPipeline`, because this package
imports neither the simulator nor the estimator.
"""

__all__: list[str] = []
