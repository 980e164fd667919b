"""Recordings as ROS 2 bags: reading and writing, without ROS."""

__all__: list[str] = []
