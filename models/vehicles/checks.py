"""Checks that the parameters of a vehicle are plausible, with proposals of the unit that was meant."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import AIR_DENSITY_KG_M3, Quadrotor, VehicleError

LEAST_THRUST_TO_WEIGHT = 1.2
"""Thrust-to-weight ratio at a full battery below which a vehicle cannot be controlled."""
_MOST_THRUST_TO_WEIGHT = 30.0  # racing quadrotors have about 15
_LEAST_INERTIA, _MOST_INERTIA = 0.01, 1.0  # moments relative to mass times squared radius; a solid disc has 0.5
_LEAST_ROTOR_INERTIA, _MOST_ROTOR_INERTIA = 1e-4, 0.1  # of a rotor relative to its share of the mass times its squared
# radius; 0.007 is usual
_LEAST_MERIT, _MOST_MERIT = 0.15, 1.0  # figure of merit of the rotors; 1 is an ideal actuator disc
_FASTEST_TIP_M_S = 340.0  # speed of sound
_MOST_DRAG_PER_S = 5.0  # in-plane and axial drag of the rotors at hover per mass; 0.1 to 0.6 are usual
_MOST_WH_PER_KG = 400.0  # energy of the battery relative to the mass of the vehicle; cells have 150 to 300
_CELL_V = 3.7

_PER_RPM = 2.0 * np.pi / 60.0
_UNITS: dict[str, tuple[tuple[str, float], ...]] = {
    "mass_kg": (("g", 1e-3), ("lb", 0.45359237)),
    "inertia_kg_m2": (("g cm²", 1e-7), ("kg mm²", 1e-6), ("kg cm²", 1e-4), ("g m²", 1e-3)),
    "arm_m": (("mm", 1e-3), ("cm", 1e-2), ("inches", 0.0254)),
    "rotor_height_m": (("mm", 1e-3), ("cm", 1e-2)),
    "rotor_radius_m": (("mm", 1e-3), ("cm", 1e-2), ("inches", 0.0254)),
    "rotor_speed_max_rad_s": (("rpm", _PER_RPM),),
    "rotor_speed_per_v": (("rpm/V", _PER_RPM),),
    "thrust_n_per_rad2_s2": (("N/rpm²", _PER_RPM**-2),),
    "torque_nm_per_rad2_s2": (("N m/rpm²", _PER_RPM**-2),),
    "rotor_inertia_kg_m2": (("g cm²", 1e-7), ("g m²", 1e-3)),
    "battery.capacity_ah": (("mA h", 1e-3),),
}
"""Units that are used by mistake, and their values in the units of the fields."""
_TOGETHER = {"thrust_n_per_rad2_s2": "torque_nm_per_rad2_s2"}  # fields that often have the same wrong unit


def check_vehicle(quadrotor: Quadrotor) -> None:
    """Check that a vehicle can fly and that its parameters are plausible.

    Raises:
        VehicleError: A parameter is not plausible; the message proposes a unit in which it would be.
    """
    for check in _CHECKS:
        problem = check(quadrotor)
        if problem is not None:
            raise VehicleError(problem.field, problem.found, f"{problem.expected}{_meant(quadrotor, problem)}")


def unit_hint(field: str, value: Any, accepted: Callable[[Any], bool]) -> str:
    """Return the end of a message that proposes a unit in which a value would be accepted, or nothing.

    Args:
        field: Dotted name of a field of `Quadrotor`.
        value: A number or numbers.
        accepted: Whether a value in the unit of the field is accepted.
    """
    for unit, factor in _UNITS.get(field, ()):
        converted = _scaled(value, factor)
        if accepted(converted):
            return f"; if it is in {unit}, write {_text(converted)}"
    return ""


@dataclass(frozen=True)
class _Problem:
    """What is not plausible in a vehicle."""

    field: str
    """Dotted name of the field that is named."""
    found: str
    """Description of what was found."""
    expected: str
    """Description of what was expected."""
    suspects: tuple[str, ...]
    """Dotted names of the fields that may be wrong, the most probable first."""


def _meant(quadrotor: Quadrotor, problem: _Problem) -> str:
    """Return the end of a message that proposes a unit in which a vehicle would be plausible, or nothing."""
    for field in problem.suspects:
        group, _, name = field.rpartition(".")
        given = getattr(getattr(quadrotor, group) if group else quadrotor, name)

        def accepted(value: Any, field: str = field, given: Any = given) -> bool:
            changed = _changed(quadrotor, field, value)
            other = _TOGETHER.get(field)
            if changed is not None and other is not None and not _plausible(changed):
                changed = _changed(changed, other, getattr(quadrotor, other) * value / given)
            return changed is not None and _plausible(changed)

        hint = unit_hint(field, given, accepted)
        if hint and field in _TOGETHER:
            hint += f", and {_TOGETHER[field]} likewise"
        if hint:
            return hint if field == problem.field else hint.replace("if it is", f"if {field} is")
    return ""


def _changed(quadrotor: Quadrotor, field: str, value: Any) -> Quadrotor | None:
    """Return a vehicle with another value of a field by its dotted name; None if the value is out of its range."""
    group, _, name = field.rpartition(".")
    try:
        if group:
            name, value = group, replace(getattr(quadrotor, group), **{name: value})
        return replace(quadrotor, **{name: value})
    except ConfigError:
        return None


def _plausible(quadrotor: Quadrotor) -> bool:
    """Return whether a vehicle passes all checks."""
    return all(check(quadrotor) is None for check in _CHECKS)


def _battery(q: Quadrotor) -> _Problem | None:
    stored_wh = q.battery.cells * _CELL_V * q.battery.capacity_ah
    if stored_wh <= _MOST_WH_PER_KG * q.mass_kg:
        return None
    found = f"{q.battery.capacity_ah:g} A h in {q.battery.cells} cells are {stored_wh:.3g} W h, in {q.mass_kg:g} kg"
    expected = f"at most {_MOST_WH_PER_KG:g} W h per kg"
    return _Problem("battery.capacity_ah", found, expected, ("battery.capacity_ah",))


def _tips(q: Quadrotor) -> _Problem | None:
    tip_m_s = q.rotor_speed_max_rad_s * q.rotor_radius_m
    if tip_m_s < _FASTEST_TIP_M_S:
        return None
    found = f"{q.rotor_speed_max_rad_s:g} rad/s, at which the tips of the blades move at {tip_m_s:.0f} m/s"
    expected = f"less than the speed of sound, {_FASTEST_TIP_M_S:g} m/s"
    return _Problem("rotor_speed_max_rad_s", found, expected, ("rotor_speed_max_rad_s", "rotor_radius_m"))


def _thrust(q: Quadrotor) -> _Problem | None:
    ratio = q.thrust_to_weight
    if LEAST_THRUST_TO_WEIGHT < ratio <= _MOST_THRUST_TO_WEIGHT:
        return None
    thrust_n = q.rotor_count * q.thrust_n_per_rad2_s2 * q.full_speed_rad_s**2
    found = (
        f"a thrust-to-weight ratio of {ratio:.3g}: {q.rotor_count} rotors lift {thrust_n:.3g} N at"
        f" {q.full_speed_rad_s:.0f} rad/s with a full battery, the weight is {q.mass_kg * GRAVITY_M_S2:.3g} N"
    )
    expected = f"more than {LEAST_THRUST_TO_WEIGHT:g}, at most {_MOST_THRUST_TO_WEIGHT:g}"
    suspects = ("mass_kg", "thrust_n_per_rad2_s2", "rotor_speed_per_v", "rotor_speed_max_rad_s")
    return _Problem("mass_kg", found, expected, suspects)


def _moments(q: Quadrotor) -> _Problem | None:
    moments = np.array(q.inertia_kg_m2)
    shown = ", ".join(f"{moment:g}" for moment in moments)
    largest, others = float(moments.max()), float(moments.sum() - moments.max())
    if largest > others * (1.0 + 1e-9):
        found = f"{shown}: the largest exceeds the sum of the others, {others:g}"
        return _Problem("inertia_kg_m2", found, "moments that a body can have", ())
    scale = q.mass_kg * (q.reach_m + q.rotor_radius_m) ** 2
    low, high = _LEAST_INERTIA * scale, _MOST_INERTIA * scale
    if low <= moments.min() and largest <= high:
        return None
    found = f"{shown} with {q.mass_kg:g} kg within {q.reach_m + q.rotor_radius_m:.3g} m"
    suspects = ("inertia_kg_m2", "arm_m", "mass_kg")
    return _Problem("inertia_kg_m2", found, f"{low:.2g} to {high:.2g} kg m²", suspects)


def _rotor_inertia(q: Quadrotor) -> _Problem | None:
    scale = q.mass_kg / q.rotor_count * q.rotor_radius_m**2
    low, high = _LEAST_ROTOR_INERTIA * scale, _MOST_ROTOR_INERTIA * scale
    if low <= q.rotor_inertia_kg_m2 <= high:
        return None
    found = f"{q.rotor_inertia_kg_m2:g} for rotors with a radius of {q.rotor_radius_m:g} m"
    suspects = ("rotor_inertia_kg_m2", "rotor_radius_m")
    return _Problem("rotor_inertia_kg_m2", found, f"{low:.2g} to {high:.2g} kg m²", suspects)


def _merit(q: Quadrotor) -> _Problem | None:
    thrust_n = q.mass_kg * GRAVITY_M_S2 / q.rotor_count
    ideal_w = thrust_n**1.5 / np.sqrt(2.0 * AIR_DENSITY_KG_M3 * np.pi * q.rotor_radius_m**2)
    merit = float(ideal_w / (q.torque_nm_per_rad2_s2 * q.hover_speed_rad_s**3))
    if _LEAST_MERIT <= merit <= _MOST_MERIT:
        return None
    found = f"{q.torque_nm_per_rad2_s2:g}, with which the rotors have a figure of merit of {merit:.3g} at hover"
    expected = f"{_LEAST_MERIT:g} to {_MOST_MERIT:g}, the share of the ideal power of their discs in their power"
    suspects = ("torque_nm_per_rad2_s2", "rotor_radius_m", "thrust_n_per_rad2_s2")
    return _Problem("torque_nm_per_rad2_s2", found, expected, suspects)


def _drag(q: Quadrotor) -> _Problem | None:
    for field in ("drag_n_s2_per_rad_m", "inflow_n_s2_per_rad_m"):
        per_s = q.rotor_count * q.hover_speed_rad_s * getattr(q, field) / q.mass_kg
        if per_s > _MOST_DRAG_PER_S:
            found = f"{getattr(q, field):g}, which at hover is {per_s:.3g} m/s² per m/s"
            return _Problem(field, found, f"at most {_MOST_DRAG_PER_S:g}, usually 0.1 to 0.6", ())
    return None


def _overlap(q: Quadrotor) -> _Problem | None:
    places = q.rotor_positions_m
    apart = np.hypot(*(places[:, None, :2] - places[:, :2]).transpose(2, 0, 1))
    np.fill_diagonal(apart, np.inf)
    over = apart < 1.8 * q.rotor_radius_m
    level = over & (np.abs(places[:, None, 2] - places[:, 2]) < 0.1 * q.rotor_radius_m)
    if not level.any() and over.sum(axis=1).max() <= 1:
        return None
    first, second = np.argwhere(level if level.any() else over)[0]
    found = (
        f"{q.rotor_radius_m:g}: the discs of rotors {first} and {second} overlap, whose axes are"
        f" {apart[first, second]:.3g} m apart"
    )
    expected = "discs beside each other, or at most two above each other"
    return _Problem("rotor_radius_m", found, expected, ("rotor_radius_m", "arm_m"))


_CHECKS = (_battery, _tips, _thrust, _overlap, _moments, _rotor_inertia, _merit, _drag)


def _scaled(value: Any, factor: float) -> Any:
    """Return a number or numbers times a factor."""
    return tuple(each * factor for each in value) if isinstance(value, tuple) else value * factor


def _text(value: Any) -> str:
    """Return a number or numbers as in a file."""
    return f"[{', '.join(f'{each:.6g}' for each in value)}]" if isinstance(value, tuple) else f"{value:.6g}"
