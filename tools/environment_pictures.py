"""Make the pictures of the environments in docs/images: one of each environment, by its chase camera.

Each picture is taken after some steps of an episode whose start shows the task; `SCENES` lists them. The picture
``environment-images.jpg`` shows the kinds of images that the drone of Race observes at that moment. The hashes of the
pictures are recorded in ``docs/images/figures.json``::

    .venv/bin/python tools/environment_pictures.py Hover Race
"""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import gymnasium
import numpy as np
import numpy.typing as npt
import tyro

import dronevio.envs  # noqa: F401 registers the environments

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
VIEW_RAD = np.radians(60.0)
"""Direction of the view of the chase camera [rad], in which goals are visible."""


@dataclass(frozen=True)
class Scene:
    """A moment of an episode."""

    seed: int
    """Seed of the reset."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the reset."""
    action: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """Action in the mode ``velocity``."""
    steps: int = 1
    """Number of steps before the picture."""


def heading(yaw_rad: float) -> npt.NDArray[np.float64]:
    """Return the unit quaternion (4,) wxyz of a level vehicle with a heading."""
    return np.array([np.cos(0.5 * yaw_rad), 0.0, 0.0, np.sin(0.5 * yaw_rad)])


SCENES = {
    "Hover": Scene(seed=4),
    "Waypoints": Scene(
        seed=4,
        options={"position_m": np.array([-0.6, -1.2, 1.6]), "quat_wxyz": heading(VIEW_RAD)},
        action=(0.3, 0.0, 0.0, 0.0),
        steps=10,
    ),
    "Track": Scene(seed=5, steps=5),
    "Race": Scene(
        seed=20,  # the first gate of this episode is the one ahead
        options={
            "position_m": np.array([-3.8, -8.44, 1.84]),
            "quat_wxyz": heading(np.radians(39.0)),
            "velocity_m_s": np.array([2.3, 1.9, 0.0]),
        },
        action=(1.0, 0.0, 0.0, 0.0),
        steps=4,
    ),
    "Navigate": Scene(
        seed=0,
        options={
            "position_m": np.array([6.24, -10.25, 2.07]),
            "goal_m": np.array([8.9, -5.58, 2.29]),
            "quat_wxyz": heading(np.radians(60.3)),
            "velocity_m_s": np.zeros(3),
        },
        action=(0.5, 0.0, 0.0, 0.0),
        steps=15,
    ),
    "Explore": Scene(
        seed=0,
        options={
            "position_m": np.array([-8.5, 0.0, 1.3]),
            "quat_wxyz": heading(0.0),
            "velocity_m_s": np.zeros(3),
        },
        action=(0.5, 0.0, 0.0, 0.0),
        steps=25,
    ),
    "VioHover": Scene(seed=0, action=(0.0, 0.0, 0.3, 0.0), steps=75),
    "VioNavigate": Scene(seed=2, action=(0.2, 0.0, 0.4, 0.0), steps=90),
}
"""The pictures by the names of the environments."""


def picture_name(name: str) -> str:
    """Return the file name of the picture of an environment, such as ``Hover``."""
    return f"environment-{name.lower()}.jpg"


def picture(name: str) -> npt.NDArray[np.uint8]:
    """Return the picture (480, 640, 3) RGB of an environment.

    Raises:
        RuntimeError: The episode ends before the picture.
    """
    scene = SCENES[name]
    chosen: dict[str, Any] = {"observations": ("position",), "action": "velocity", "render_mode": "rgb_array"}
    with gymnasium.make(f"dronevio/{name}-v0", **chosen) as env:
        env.reset(seed=scene.seed, options=scene.options)
        for _ in range(scene.steps):
            *_, terminated, _, info = env.step(np.array(scene.action, np.float32))
            if terminated:
                raise RuntimeError(f"the episode of {name} ends: {info['termination'].text}")
        shown: Any = env.render()
    return np.asarray(shown, dtype=np.uint8)


def images_picture(name: str, size: tuple[int, int] = (320, 240)) -> npt.NDArray[np.uint8]:
    """Return the colour, depth, segmentation and flow images that an environment observes, side by side in two rows.

    Near surfaces are bright, each object has a colour, and the hue of a flow is its direction.
    """
    scene, kinds = SCENES[name], ("rgb", "depth", "segmentation", "flow")
    with gymnasium.make(f"dronevio/{name}-v0", observations=kinds, action="velocity", image_size=size) as env:
        seen = env.reset(seed=scene.seed, options=scene.options)[0]
        for _ in range(scene.steps):
            seen = env.step(np.array(scene.action, np.float32))[0]
    near = 255.0 * np.clip(1.5 / seen["depth"], 0.0, 1.0)
    palette = np.random.default_rng(1).integers(40, 256, (int(seen["segmentation"].max()) + 1, 3), np.uint8)
    length, angle_deg = cv2.cartToPolar(seen["flow"][..., 0], seen["flow"][..., 1], angleInDegrees=True)
    strength = np.clip(255.0 * length / np.percentile(length, 95), 0.0, 255.0)
    hsv = np.stack([0.5 * angle_deg, strength, np.full_like(length, 255.0)], axis=-1).astype(np.uint8)
    shown = (
        seen["rgb"],
        np.repeat(near.astype(np.uint8), 3, axis=2),
        palette[seen["segmentation"][..., 0]],
        np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB), np.uint8),
    )
    return np.vstack([np.hstack(shown[:2]), np.hstack(shown[2:])])


def record_hashes() -> None:
    """Write the hashes of all pictures in docs/images to figures.json."""
    path = IMAGES / "figures.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    document["pictures"] = {
        image.name: hashlib.sha256(image.read_bytes()).hexdigest() for image in sorted(IMAGES.glob("*.jpg"))
    }
    path.write_text(json.dumps(document, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class EnvironmentPicturesCommand:
    """Make the pictures of the environments."""

    names: tyro.conf.Positional[tuple[str, ...]] = (*SCENES, "images")
    """Names of the environments, such as Hover, and ``images``; all by default."""


if __name__ == "__main__":
    for chosen_name in tyro.cli(EnvironmentPicturesCommand, description=__doc__).names:
        quality = [cv2.IMWRITE_JPEG_QUALITY, 88]
        made = images_picture("Race") if chosen_name == "images" else picture(chosen_name)
        cv2.imwrite(str(IMAGES / picture_name(chosen_name)), made[..., ::-1], quality)
    record_hashes()
