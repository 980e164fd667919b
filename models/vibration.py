"""How the rotors shake the airframe: what an IMU feels beyond the motion that an estimator is to find."""

from dataclasses import dataclass


@dataclass(frozen=True)
class RotorVibration:
    """The strength of each rotor's vibration where the IMU is bolted.

    Forces of rotors grow with the square of their speed ω. What is out of balance turns with the rotor and shakes the
    airframe in the disc's plane, at ω; passing blades pull on it along the axis, at ω times the number of blades and
    its multiples. Both also rock it. A body under a force of amplitude F at ω swings by F / (m ω²): so an amplitude of
    acceleration, x ω², is given by the swing x, and one of angular rate, φ ω, by the angle φ. Both are constants.
    """

    blades: int = 2
    """Blades of a rotor."""
    harmonics: int = 2
    """How many multiples of the blade-pass frequency there are; the k-th is k² times weaker."""
    imbalance_m: float = 0.0
    """Swing in the disc's plane at the rotor's speed [m]."""
    imbalance_rad: float = 0.0
    """Rocking about axes in that plane at the rotor's speed [rad]."""
    blade_pass_m: float = 0.0
    """Acceleration along the rotor's axis at the blade-pass frequency, by ω² [m]."""
    blade_pass_rad: float = 0.0
    """Angular rate about the vehicle's arm-normal axis at the blade-pass frequency, by ω [rad]."""


STILL = RotorVibration()
"""Perfect rotors."""

SHAKEN = RotorVibration(imbalance_m=1.1e-6, imbalance_rad=2e-5, blade_pass_m=1.7e-6, blade_pass_rad=1.5e-5)
"""As much as on EuRoC's drone. Between 60 and 100 Hz its IMU feels, in flight V1_02 and per axis, 0.4 to 1.1 m/s² and
0.01 to 0.04 rad/s r.m.s., most along the vertical; so do four rotors of these strengths at 660 rad/s."""
