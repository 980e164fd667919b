"""Dynamics of the quadrotor: rotors, aerodynamics, wind, contacts, and the controller."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.physics.controller import SE3Controller
    from dronevio.sim.physics.gains import Gains
    from dronevio.sim.physics.plant import QuadrotorPlant
    from dronevio.sim.physics.wind import Wind

__all__ = [
    "Gains",
    "QuadrotorPlant",
    "SE3Controller",
    "Wind",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.physics.controller": ("SE3Controller",),
        "dronevio.sim.physics.gains": ("Gains",),
        "dronevio.sim.physics.plant": ("QuadrotorPlant",),
        "dronevio.sim.physics.wind": ("Wind",),
    },
)
