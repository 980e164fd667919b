"""Online calibration of the cameras' time offset, extrinsics and intrinsics."""
