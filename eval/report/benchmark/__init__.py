"""Reports of benchmarks: their statistics, pages, plots and tables."""
