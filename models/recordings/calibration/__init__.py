"""Calibration files: of EuRoC folders, of Kalibr and of other estimators."""

__all__: list[str] = []
