"""Variants of the scenarios of a benchmark: another IMU, noise or rig, the same world, other light, the reverse tour.

A variant is the same scenario with a part replaced. Its runs are rows of their own, whose scenario has the name of the
variant after a plus sign: ``room-easy-v0+imu-100hz``. Variants of different kinds are combined by plus signs:
``room-easy-v0+world=3+reverse``.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from dronevio.eval.benchmark.rows import VARIANT_SIGN
from dronevio.models.errors import ConfigError

if TYPE_CHECKING:
    from dronevio.sim.scenario import Scenario

Change: TypeAlias = "Callable[[Scenario, str], Scenario]"
"""Returns a changed scenario, given the scenario and the value after the equals sign, empty without one."""

AS_IS = "as-is"
"""Name of the scenario without a change."""
RIG = "rig="
"""Beginning of the name of a variant with other sensors, which is followed by the name of a rig."""
_LARGEST_SEED = 2**32 - 1


@dataclass(frozen=True)
class Variant:
    """A change of a scenario."""

    description: str
    """What is different, for documentation."""
    kind: str
    """What is changed. Of each kind, one variant is allowed in a combination."""
    change: Change
    """Function that returns the changed scenario."""


def _other_rig(flown: "Scenario", name: str) -> "Scenario":
    """Return a scenario with other sensors, see `recorder.rig_of`."""
    from dronevio.recording.recorder import rig_of

    return replace(flown, rig=rig_of(name))


def _imu_rate(rate_hz: float) -> Change:
    """Return the change of the rate of the IMU [Hz]; noise densities stay, and if possible the path."""

    def change(flown: "Scenario", _: str) -> "Scenario":
        from dronevio.sim.physics.motion import can_be_resampled

        control_rate_hz = flown.control_rate_hz or flown.rig.imu.rate_hz
        keeps_path = can_be_resampled(round(1e9 / control_rate_hz), round(1e9 / rate_hz))
        rig = replace(flown.rig, imu=replace(flown.rig.imu, rate_hz=rate_hz))
        return replace(flown, rig=rig, control_rate_hz=control_rate_hz if keeps_path else None)

    return change


def _hidden_noise(factor: float) -> Change:
    """Return the change of the noise of the IMU by a factor that the calibration does not contain."""
    return lambda flown, _: replace(flown, faults=replace(flown.faults, imu_noise_factor=factor))


def _seed(text: str) -> int:
    """Return the seed in a variant.

    Raises:
        ConfigError: It is no whole number in the range of seeds.
    """
    if not (text.isascii() and text.isdecimal() and int(text) <= _LARGEST_SEED):
        raise ConfigError(f"seed {text!r} in a variant; expected a whole number from 0 to {_LARGEST_SEED}")
    return int(text)


VARIANTS: Mapping[str, Variant] = {
    RIG: Variant("other sensors: a name or a file, see `recorder.rig_of`", "rig", _other_rig),
    "imu-100hz": Variant("an IMU at 100 Hz", "imu", _imu_rate(100.0)),
    "imu-400hz": Variant("an IMU at 400 Hz", "imu", _imu_rate(400.0)),
    "noise-half": Variant("half of the calibrated IMU noise", "noise", _hidden_noise(0.5)),
    "noise-2x": Variant("twice the calibrated IMU noise", "noise", _hidden_noise(2.0)),
    "world=": Variant(
        "the world of this seed in all flights", "world", lambda flown, seed: replace(flown, world_seed=_seed(seed))
    ),
    "light=": Variant(
        "the light of this seed in the same world", "light", lambda flown, seed: replace(flown, light_seed=_seed(seed))
    ),
    "reverse": Variant(
        "the tour in the opposite direction", "direction", lambda flown, _: replace(flown, reverse=True)
    ),
}
"""Variants by name, in the order in which they are combined. Names that end in an equals sign are followed by a
value."""


def variant_of(flown: "Scenario", name: str) -> "Scenario":
    """Return a variant of a scenario, with the name of both.

    Args:
        flown: The scenario.
        name: `AS_IS`, a key of `VARIANTS` with its value, or several of these, joined by plus signs in any order.

    Raises:
        ConfigError: There is no such variant, rig or seed, or two variants of one kind are combined.
    """
    if name == AS_IS:
        return flown
    order, chosen = list(VARIANTS), dict[str, str]()
    for part in name.split(VARIANT_SIGN):
        key, equals, value = part.partition("=")
        prefix = f"{key}{equals}"
        if prefix not in VARIANTS:
            expected = ", ".join((AS_IS, *(f"{each}…" if each.endswith("=") else each for each in order)))
            raise ConfigError(f"unknown variant {part!r}; expected one of {expected}")
        if rival := next((each for each in chosen if VARIANTS[each].kind == VARIANTS[prefix].kind), None):
            raise ConfigError(f"variant {name!r} with {rival}{chosen[rival]} and {part}; expected one of them")
        chosen[prefix] = value
    for prefix in sorted(chosen, key=order.index):
        changed = VARIANTS[prefix].change(flown, chosen[prefix])
        flown = replace(changed, name=f"{flown.name}{VARIANT_SIGN}{prefix}{chosen[prefix]}")
    return flown
