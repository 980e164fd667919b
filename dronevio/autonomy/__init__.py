"""Autonomy: flights through unknown worlds. `planning` finds paths and trajectories, `pilot` decides what is flown."""

__all__: list[str] = []
