"""What a rendering process does: look at frames to meter them, or draw, develop and write them."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.sim.camera import OffscreenCamera
from dronevio.sim.imaging import Exposures
from dronevio.sim.render_job import RenderJob
from dronevio.sim.shutter import Shutter

Array = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

PARTIAL = ".partial"
"""Suffix of an image that is being written."""
_NOISE_STREAM = 20  # beside those of `dronevio.sim.scenario` and `dronevio.sim.world`
_GLANCE_PX = 8  # a glance has a pixel for so many, each way
_NEAR_PERCENTILE = 10  # of the depths: what is nearer fills a tenth of the image


@dataclass(frozen=True, eq=False)
class Stage:
    """The compiled world, ready to be drawn."""

    model_path: Path
    """The model."""
    illumination: float
    """Light that falls in, relative to a well lit world."""


@dataclass(frozen=True, eq=False)
class MeterTask:
    """Measure the light of frames."""

    job: RenderJob
    """What they are frames of."""
    stage: Stage
    """Where."""
    indices: npt.NDArray[np.int64]
    """(K,) Their places in the schedule."""
    result: Path
    """Where the histograms (K, 256) go: the share of the main camera's pixels on each grey level."""

    def carry_out(self) -> Iterator[None]:
        """Do it; a frame is a unit."""
        model = mujoco.MjModel.from_binary_path(str(self.stage.model_path))
        Ts_world_cam = self.job.poses(0)(self.job.schedule.exposed_ns[self.indices])
        histograms = np.zeros((len(self.indices), 256))
        with OffscreenCamera(model, at_a_glance(self.job.rig.cameras[0].model), supersampling=1.0) as eye:
            for row, T_world_cam in enumerate(Ts_world_cam):
                image = eye.render(T_world_cam)
                histograms[row] = np.bincount(image.ravel(), minlength=256) / image.size
                yield
        np.save(self.result, histograms)


@dataclass(frozen=True, eq=False)
class DrawTask:
    """Draw, develop and write frames."""

    job: RenderJob
    """What they are frames of."""
    stage: Stage
    """Where."""
    indices: npt.NDArray[np.int64]
    """(K,) Their places in the schedule."""
    exposures: Exposures
    """Of all frames of the job."""
    mav0: Path
    """The folder that holds ``cam0/data`` and its neighbours."""

    def carry_out(self) -> Iterator[None]:
        """Do it; a frame, from all cameras, is a unit."""
        model = mujoco.MjModel.from_binary_path(str(self.stage.model_path))
        with ExitStack() as opened:
            cameras = [
                opened.enter_context(_FilmCamera(self, number, model)) for number in range(len(self.job.rig.cameras))
            ]
            for index in self.indices.tolist():
                name = f"{self.job.schedule.stamps_ns[index]}.png"
                for number, camera in enumerate(cameras):
                    write_png(self.mav0 / f"cam{number}" / "data" / name, camera.take(index))
                yield


class _FilmCamera:
    """One camera of the rig: takes developed frames."""

    def __init__(self, task: DrawTask, number: int, model: mujoco.MjModel) -> None:
        """Prepare to take a camera's frames."""
        self._task, self._number = task, number
        camera = task.job.rig.cameras[number]
        self._poses = task.job.poses(number)
        self._shutter = Shutter(camera, task.job.margin_px(number))
        self._eye = OffscreenCamera(model, self._shutter.drawn)
        self._glance = OffscreenCamera(model, at_a_glance(camera.model), supersampling=1.0)

    def __enter__(self) -> "_FilmCamera":
        return self

    def __exit__(self, *_: object) -> None:
        self._eye.close()
        self._glance.close()

    def take(self, index: int) -> GreyImage:
        """Return a frame (H, W)."""
        job, exposures = self._task.job, self._task.exposures
        middle_ns, exposure_s = int(job.schedule.exposed_ns[index]), float(exposures.time_s[index])
        plan = self._shutter.plan(self._poses, middle_ns, exposure_s, self._nearest_m(middle_ns))
        light = self._shutter.collect(plan, self._poses, self._view)
        irradiance = self._task.stage.illumination * float(job.schedule.lit[index])
        stream = np.random.SeedSequence(job.seed, spawn_key=(_NOISE_STREAM, index, self._number))
        gain = float(exposures.gain[index])
        return job.imaging.develop(light, irradiance, exposure_s, gain, np.random.default_rng(stream))

    def _view(self, t_ns: int) -> GreyImage:
        """Return what is seen at a time [ns]."""
        return self._eye.render(self._pose(t_ns))

    def _nearest_m(self, t_ns: int) -> float:
        """Return the depth of what is near at a time [m]; infinite where nothing is."""
        depth = self._glance.render_depth(self._pose(t_ns))
        depth = depth[np.isfinite(depth)]
        return float(np.percentile(depth, _NEAR_PERCENTILE)) if depth.size else np.inf

    def _pose(self, t_ns: int) -> Array:
        """Return the camera's pose (4, 4) at a time [ns]."""
        return np.asarray(self._poses(np.array([t_ns]))[0])


def at_a_glance(model: CameraModel) -> CameraModel:
    """Return a camera that sees the same in few pixels."""
    width, height = (max(size // _GLANCE_PX, 1) for size in (model.width, model.height))
    x, y = width / model.width, height / model.height
    return replace(
        model,
        width=width,
        height=height,
        fx=model.fx * x,
        fy=model.fy * y,
        cx=(model.cx + 0.5) * x - 0.5,
        cy=(model.cy + 0.5) * y - 0.5,
    )


def write_png(path: Path, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    """Write an image beside its place and then move it there, so that nobody ever sees half of it."""
    partial = path.with_suffix(PARTIAL)
    partial.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    partial.replace(path)
