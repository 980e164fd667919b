"""Write a GIF of an episode of a policy, seen by a chase camera.

```console
python animate.py hover policies/hover.safetensors --out hover.gif
```
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import tyro
from PIL import Image
from trainings import TRAININGS

import dronevio as dv


@dataclass(frozen=True)
class AnimateCommand:
    """Write a GIF of an episode of a policy."""

    training: tyro.conf.Positional[str]
    """Name of the training, which determines the environment: hover, hover-imu, waypoints or race."""
    policy: tyro.conf.Positional[Path]
    """File of the policy."""
    out: Path = Path("episode.gif")
    """File to write."""
    seed: int = 1_000_000
    """Seed of the environment."""
    duration_s: float = 6.0
    """Longest duration of the animation [s]."""
    rate_hz: float = 8.0
    """Number of pictures per second of the flight [Hz]."""
    width_px: int = 240
    """Width of the pictures [px]."""
    colours: int = 32
    """Number of colours of a picture."""


def pictures(command: AnimateCommand) -> list[Image.Image]:
    """Return the pictures of an episode."""
    training, policy = TRAININGS[command.training], dv.load_policy(command.policy)
    arguments = {**training.arguments, **training.of_evaluation}
    env: Any = gymnasium.make(f"dronevio.envs:{training.environment}", render_mode="rgb_array", flat=True, **arguments)
    fps = env.metadata["render_fps"]
    count = round(command.duration_s * command.rate_hz)
    shown = {round(k * fps / command.rate_hz) for k in range(count)}
    observation, _ = env.reset(seed=command.seed)
    frames = []
    for step in range(max(shown) + 1):
        if step in shown:
            picture = Image.fromarray(env.render())
            height = picture.height * command.width_px // picture.width
            frames.append(picture.resize((command.width_px, height), Image.Resampling.LANCZOS))
        observation, _, terminated, truncated, _ = env.step(policy.action(np.asarray(observation)[None])[0])
        if terminated or truncated:
            break
    env.close()
    return frames


def main(command: AnimateCommand) -> None:
    """Fly an episode and write the animation."""
    frames = [frame.quantize(command.colours, dither=Image.Dither.NONE) for frame in pictures(command)]
    first, *others = frames
    first.save(
        command.out, save_all=True, append_images=others, duration=round(1000 / command.rate_hz), loop=0, optimize=True
    )


if __name__ == "__main__":
    main(tyro.cli(AnimateCommand, description=__doc__))
