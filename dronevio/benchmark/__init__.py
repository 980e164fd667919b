"""Benchmarks of the application: their flights, the variants of flights, and the jobs that estimate them."""

__all__: list[str] = []
