"""Gymnasium environments; importing ``dronevio.envs`` registers them."""

from typing import TYPE_CHECKING

from dronevio._lazy import attach

if TYPE_CHECKING:
    from dronevio.sim.envs.hover import Hover

__all__ = [
    "Hover",
]

__getattr__, __dir__ = attach(
    __name__,
    {
        "dronevio.sim.envs.hover": ("Hover",),
    },
)
