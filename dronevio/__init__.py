"""Fly a simulated quadrotor, estimate its motion from camera and IMU, score the estimate.

Four rooms share this import name: ``dronevio.models`` (what the drone, its sensors and their data
are), ``dronevio.sim`` (MuJoCo makes it fly and sense), ``dronevio.estimator`` (GTSAM and OpenCV turn
what was sensed into motion) and ``dronevio.eval`` (scores, reports and recordings to look at).
Importing this package loads none of them.
"""

__version__ = "0.1.0"
