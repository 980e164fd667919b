"""From a true motion to what an IMU measures."""
