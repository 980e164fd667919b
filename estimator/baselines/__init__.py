"""Baseline estimators that the odometry is compared with."""
