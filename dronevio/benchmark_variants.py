"""Variants of the scenarios of a benchmark: another IMU, noise that the calibration does not contain, other sensors.

A variant is the same flight with a part replaced. Its runs are rows of their own, whose scenario has the name of the
variant after a plus sign: ``room-easy-v0+imu-100hz``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from dronevio.eval.benchmark.rows import VARIANT_SIGN
from dronevio.models.errors import ConfigError

if TYPE_CHECKING:
    from dronevio.sim.scenario import Scenario

AS_IS = "as-is"
"""Name of the scenario without a change."""
RIG = "rig="
"""Beginning of the name of a variant with other sensors, which is followed by the name of a rig."""


@dataclass(frozen=True)
class Variant:
    """A change of a scenario."""

    description: str
    """What is different, for help texts and documentation."""
    change: "Callable[[Scenario], Scenario]"
    """Function that returns the changed scenario."""


def _imu_rate(rate_hz: float) -> "Callable[[Scenario], Scenario]":
    """Return the change of the rate of the IMU [Hz]; its noise densities stay."""
    return lambda flown: replace(flown, rig=replace(flown.rig, imu=replace(flown.rig.imu, rate_hz=rate_hz)))


def _hidden_noise(factor: float) -> "Callable[[Scenario], Scenario]":
    """Return the change of the noise of the IMU by a factor that the calibration does not contain."""
    return lambda flown: replace(flown, faults=replace(flown.faults, imu_noise_factor=factor))


VARIANTS: Mapping[str, Variant] = {
    AS_IS: Variant("the scenario itself", lambda flown: flown),
    "imu-100hz": Variant("an IMU at 100 Hz", _imu_rate(100.0)),
    "imu-400hz": Variant("an IMU at 400 Hz", _imu_rate(400.0)),
    "noise-half": Variant("half of the calibrated IMU noise", _hidden_noise(0.5)),
    "noise-2x": Variant("twice the calibrated IMU noise", _hidden_noise(2.0)),
}
"""Variants by name."""


def variant_of(flown: "Scenario", name: str) -> "Scenario":
    """Return a variant of a scenario, with the name of both.

    Args:
        flown: The scenario.
        name: A key of `VARIANTS`, or `RIG` and the name of a rig, see `recorder.rig_of`.

    Raises:
        ConfigError: There is no such variant or rig.
    """
    if name == AS_IS:
        return flown
    if name.startswith(RIG):
        from dronevio.recorder import rig_of

        changed = replace(flown, rig=rig_of(name.removeprefix(RIG)))
    elif name in VARIANTS:
        changed = VARIANTS[name].change(flown)
    else:
        raise ConfigError(f"unknown variant {name!r}; expected one of {', '.join(VARIANTS)}, {RIG}NAME")
    return replace(changed, name=f"{flown.name}{VARIANT_SIGN}{name}")
