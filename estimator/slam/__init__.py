"""Simultaneous localization and mapping around the odometry: places recognized again, loops closed, maps kept."""
