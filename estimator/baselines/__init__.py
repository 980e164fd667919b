"""Baseline estimators that the odometry is compared with."""

__all__: list[str] = []
