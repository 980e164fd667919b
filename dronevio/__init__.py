"""Simulate a quadrotor, estimate its motion from camera and IMU, and evaluate the estimate.

The package consists of ``dronevio.models`` (data types, sensor models and recordings), ``dronevio.sim`` (physics and
sensors with MuJoCo), ``dronevio.estimator`` (visual-inertial odometry with GTSAM and OpenCV), ``dronevio.eval``
(metrics, benchmarks and reports) and the application layer (the command line and what connects the others). Importing
``dronevio`` loads none of them.
"""

__version__ = "0.1.0"
