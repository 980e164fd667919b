"""The cases of `compare_revisions.py`: what is flown, with which rig, and what the probe computes from it."""

from dataclasses import dataclass
from itertools import product

_LENS = """\
  camera_model: pinhole
  intrinsics: [229.327, 228.648, 183.61, 124.19]
  distortion_model: radtan
  distortion_coeffs: [-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05]
  resolution: [376, 240]
"""
_CAMERA = "  T_cam_imu: [[0.0, -1.0, 0.0, {y}], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, -0.05], [0.0, 0.0, 0.0, 1.0]]\n"
_IMU = """\
imu0:
  update_rate: 200.0
  gyroscope_noise_density: 0.00016968
  gyroscope_random_walk: 1.9393e-05
  accelerometer_noise_density: 0.002
  accelerometer_random_walk: 0.003
"""
_IMU_ERRORS = """\
  gyro_bias_instability_rad_s: 7.0e-05
  gyro_scale_error: 0.005
  gyro_misalignment_rad: 0.0009
  gyro_g_sensitivity_rad_s_per_m_s2: 2.0e-05
  gyro_range_rad_s: 17.0
  gyro_bandwidth_hz: 330.0
  accel_bias_instability_m_s2: 0.002
  accel_scale_error: 0.005
  accel_misalignment_rad: 0.0009
  accel_range_m_s2: 170.0
  accel_bandwidth_hz: 330.0
"""
_FISHEYE = """\
  camera_model: pinhole
  intrinsics: [190.0, 190.0, 187.5, 119.5]
  distortion_model: equidistant
  distortion_coeffs: [0.0035, 0.0007, -0.0020, 0.0002]
  resolution: [376, 240]
"""


def _camera(number: int, lens: str, rate_hz: float, y: float = 0.0, more: str = "") -> str:
    return f"cam{number}:\n{lens}{_CAMERA.format(y=y)}  rate_hz: {rate_hz}\n{more}"


RIGS = {
    "mono": _camera(0, _LENS, 20.0) + _IMU,
    "mono-10": _camera(0, _LENS, 10.0) + _IMU,
    "stereo": _camera(0, _LENS, 20.0, 0.055) + _camera(1, _LENS, 20.0, -0.055) + _IMU,
    "stereo-10": _camera(0, _LENS, 10.0, 0.055) + _camera(1, _LENS, 10.0, -0.055) + _IMU,
    "rolling": _camera(0, _LENS, 20.0, 0.0, "  readout_s: 0.03\n  timeshift_cam_imu: 0.012\n") + _IMU,
    "photographs": _camera(0, _LENS, 2.0) + _IMU,
    "errors": _camera(0, _LENS, 10.0, 0.055)
    + _camera(1, _FISHEYE, 10.0, -0.055, "  readout_s: 0.015\n")
    + _IMU
    + _IMU_ERRORS,
}
"""Rigs as Kalibr writes them, with EuRoC's camera at half its resolution. The rolling shutter has a readout of 30 ms
and a time offset of 12 ms. The IMU of ``errors`` has every error of the model except the resolution, whose rounding
would hide small changes of the others."""


@dataclass(frozen=True)
class Flight:
    """A flight to record."""

    options: str
    """Options of ``dronevio fly``."""
    rig: str = ""
    """Key of `RIGS`; empty if the options name a rig."""


@dataclass(frozen=True)
class Case:
    """What is compared."""

    probe: str
    """What `revision_probe.py` computes."""
    flight: Flight | None = None
    """The recording that it reads; None if it needs none."""
    by_each: bool = False
    """Whether each revision flies itself; otherwise the base flies for both."""


_HOP = (
    "--scenario short --plan.waypoint-jitter 0.1 --plan.rest-s 1.2 --plan.takeoff-s 1 --plan.height-m 0.8"
    " --plan.landing-s 1.2 --plan.stand-s 0.3"
)
_AROUND = "--plan.waypoints 0.3 0 0 0.3 0.3 0.2 0 0.3 0"
_LAP = "0.55 0 0 0.55 0.5 0.3 0 0.5 0"
_LAPS = (
    "--scenario short --plan.rest-s 1.2 --plan.takeoff-s 1 --plan.height-m 0.8 --plan.tour-s 22 --plan.landing-s 1.2"
    f" --plan.stand-s 0.3 --plan.heading-scale 0 --plan.waypoints {_LAP} 0 0 0 {_LAP}"
)

CASES: dict[str, Case] = {
    "mono": Case("estimate", Flight(f"{_HOP} --seed 3 --plan.tour-s 6 {_AROUND}", "mono")),
    "moving": Case(
        "estimate",
        Flight(
            "--scenario room --seed 3 --plan.skip-s 4.5 --plan.tour-s 13 --plan.landing-s 1.5 --plan.stand-s 0.3"
            " --faults.dark-from-s 3 --faults.dark-for-s 8",
            "mono",
        ),
    ),
    "stereo": Case(
        "estimate",
        Flight(
            f"{_HOP} --seed 2 --world hall --plan.tour-s 5 {_AROUND}"
            " --faults.dropped-frames 0.1 --faults.stamp-jitter-s 0.0005",
            "stereo",
        ),
    ),
    "rolling": Case(
        "estimate",
        Flight(
            f"{_HOP} --seed 5 --plan.tour-s 6 {_AROUND}"
            " --faults.hidden-time-offset-s 0.006 --faults.hidden-tilt-rad 0.015",
            "rolling",
        ),
    ),
    "eqvio": Case("eqvio"),
    "slam": Case("slam", Flight(f"{_LAPS} --seed 1", "mono-10")),
    "slam-stereo": Case("slam", Flight(f"{_LAPS} --seed 4", "stereo-10")),
    "sfm": Case("sfm", Flight(f"{_HOP} --seed 6 --plan.tour-s 6 {_AROUND}", "photographs")),
    "scores": Case("scores", Flight(f"{_HOP} --seed 3 --plan.tour-s 6 {_AROUND}", "mono")),
    "flight": Case("flight", Flight("--scenario short --seed 1", "mono"), by_each=True),
    "flight-faults": Case(
        "flight",
        Flight(
            "--scenario short --seed 1 --wind.mean-m-s 2 0 0 --wind.gusts 1"
            " --faults.dropped-frames 0.3 --truth-images depth",
            "errors",
        ),
        by_each=True,
    ),
    "flight-rotor": Case(
        "flight",
        Flight(
            "--scenario short --seed 2 --world forest --vehicle nano --rig nano --imaging.no-auto-exposure"
            " --faults.failing-rotor 1 --faults.rotor-fails-at-s 3",
        ),
        by_each=True,
    ),
    "flight-on-estimate": Case("on-estimate"),
    "environments": Case("environments"),
    "vector-environments": Case("vector-environments"),
    "vio-environments": Case("vio-environments"),
    "policies": Case("policies"),
}
"""All cases by name. ``moving`` starts in motion and flies in the dark until the odometry is lost; ``stereo`` loses
frames, and its stamps jitter; the clock and the mounting of ``rolling`` differ from its calibration; ``slam`` flies
two laps with one heading, whose places are recognized."""

_PAIRED = (
    ("euroc", "room"),
    ("mono", "hall"),
    ("mono", "corridor"),
    ("rolling", "room"),
    ("euroc-stereo", "room"),
    ("stereo", "hall"),
    ("stereo", "forest"),
    ("stereo", "warehouse"),
)
_PAIRED_SEEDS = range(4)


def paired_flights() -> list[tuple[str, Flight]]:
    """Return the flights of the paired comparison with their names: eight rigs and worlds, each with four seeds."""
    flights = []
    for (rig, world), seed in product(_PAIRED, _PAIRED_SEEDS):
        options = f"{_HOP} --world {world} --seed {seed} --plan.tour-s 6 {_AROUND}"
        flight = Flight(options, rig) if rig in RIGS else Flight(f"{options} --rig {rig}")
        flights.append((f"{rig} {world} {seed}", flight))
    return flights
