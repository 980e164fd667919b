"""Online calibration of the cameras' time offset, extrinsics and intrinsics."""

__all__: list[str] = []
