"""Recordings as ROS 2 bags: reading and writing, without ROS."""
