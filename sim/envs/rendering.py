"""Rendering of environments: pictures of the drone by a chase camera, as arrays or in a window."""

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.sim.envs.settings import EnvironmentSettings
from dronevio.sim.pictures.chase_camera import ChaseCamera, lease_chase_camera
from dronevio.sim.rendering.shared import Lease
from dronevio.sim.rendering.window import Window, has_display, require_display

Picture = npt.NDArray[np.uint8]

RENDER_MODES = ("human", "rgb_array")
"""Render modes of a single environment; vectors have ``rgb_array`` only."""


def check_render_mode(render_mode: str | None, modes: tuple[str, ...]) -> None:
    """Check a render mode, and that there is a display for ``human``.

    Raises:
        ConfigError: The render mode is unknown.
        GraphicsError: The render mode is ``human``, and there is no display.
    """
    if render_mode not in (None, *modes):
        raise ConfigError(f"render mode {render_mode!r}; expected None or {' or '.join(map(repr, modes))}")
    if render_mode == "human":
        require_display()


def possible_render_modes() -> list[str]:
    """Return the render modes that work here, all of which Gymnasium's `check_env` tries: ``human`` needs a display."""
    return [mode for mode in RENDER_MODES if mode != "human" or has_display()]


class DronePictures:
    """Pictures of the drone by a chase camera, which is leased when the first one is taken."""

    def __init__(self, settings: EnvironmentSettings) -> None:
        """Define world and vehicle."""
        self._settings = settings
        self._cameras: dict[int, Lease[ChaseCamera]] = {}
        self._window: Window | None = None

    def picture(self, world_seed: int, T_world_vehicle: Array, goals_m: Array) -> Picture:
        """Return an RGB image (480, 640, 3) of the drone at a pose and of its goals.

        Args:
            world_seed: Seed of the world.
            T_world_vehicle: (4, 4) Pose of the drone.
            goals_m: (K, 3) Goals [m].

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        if world_seed not in self._cameras:
            chosen = self._settings
            self._cameras[world_seed] = lease_chase_camera(chosen.world, world_seed, chosen.vehicle, chosen.rig)
        return self._cameras[world_seed].value.render(T_world_vehicle, goals_m)

    def show(self, world_seed: int, T_world_vehicle: Array, goals_m: Array) -> None:
        """Show a picture in a window, in real time; the arguments are those of `picture`.

        Raises:
            GraphicsError: Off-screen OpenGL or a display is not available.
        """
        picture = self.picture(world_seed, T_world_vehicle, goals_m)
        if self._window is None:
            self._window = Window(picture.shape[1], picture.shape[0], "dronevio", self._settings.action_rate_hz)
        self._window.show(picture)

    def close(self) -> None:
        """Release the cameras and close the window; further calls have no effect."""
        while self._cameras:
            self._cameras.popitem()[1].release()
        if self._window is not None:
            self._window.close()
            self._window = None
