"""Recordings as bags of ROS 1 and ROS 2: reading, and writing for ROS 2, without ROS."""

__all__: list[str] = []
