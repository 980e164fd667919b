"""Reports of runs and benchmarks: HTML pages, plots and tables."""
