"""World frame of a reconstruction from known poses, a rig or an IMU: position, orientation and scale."""

__all__: list[str] = []
