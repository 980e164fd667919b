"""Rotor-induced vibration of the airframe, which an IMU measures in addition to the motion of the drone."""

from dataclasses import dataclass
from typing import Annotated

from dronevio.models.ranges import Range, Settings


@dataclass(frozen=True)
class RotorVibration(Settings):
    """Amplitudes of the vibration of each rotor at the position of the IMU.

    Rotor forces are proportional to the square of the rotor speed ω. The imbalance rotates with the rotor and excites
    the airframe in the plane of the disc at ω; the passing blades excite it along the axis, at the blade-pass frequency
    (ω times the number of blades) and its harmonics. Both also cause angular vibration. A body under a force of
    amplitude F at ω oscillates with the displacement F / (m ω²). Therefore an amplitude of acceleration x ω² is given
    by the displacement x, and one of angular velocity φ ω by the angle φ, both of which are constants.
    """

    blades: Annotated[int, Range(1, 20)] = 2
    """Number of blades of a rotor."""
    harmonics: Annotated[int, Range(0, 20)] = 2
    """Number of multiples of the blade-pass frequency; the k-th is k² times weaker."""
    imbalance_m: Annotated[float, Range(0.0, 0.01)] = 0.0
    """Displacement amplitude in the plane of the disc at the rotor frequency [m]."""
    imbalance_rad: Annotated[float, Range(0.0, 0.1)] = 0.0
    """Angle amplitude about axes in the plane of the disc at the rotor frequency [rad]."""
    blade_pass_m: Annotated[float, Range(0.0, 0.01)] = 0.0
    """Amplitude of the acceleration along the rotor axis at the blade-pass frequency, divided by ω² [m]."""
    blade_pass_rad: Annotated[float, Range(0.0, 0.1)] = 0.0
    """Amplitude of the angular velocity about the horizontal axis normal to the arm at the blade-pass frequency,
    divided by ω [rad]."""


NO_VIBRATION = RotorVibration()
"""Perfectly balanced rotors without blade-pass excitation."""

EUROC_VIBRATION = RotorVibration(imbalance_m=1.1e-6, imbalance_rad=2e-5, blade_pass_m=1.7e-6, blade_pass_rad=1.5e-5)
"""Vibration as strong as on EuRoC's drone. Between 60 and 100 Hz its IMU measures, in sequence V1_02 and per axis, 0.4
to 1.1 m/s² and 0.01 to 0.04 rad/s RMS, most along the vertical. Four rotors with these amplitudes at 660 rad/s cause
the same."""
