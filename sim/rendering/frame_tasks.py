"""Tasks of the rendering processes: metering frames, and rendering and writing them."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.shutter import Shutter
from dronevio.sim.rendering.compiled_world import CompiledWorld
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.rendering.truth_images import FOLDERS, depth_image, flow_image, segmentation_image
from dronevio.sim.streams import generator

Array = npt.NDArray[np.float64]
GreyImage = npt.NDArray[np.uint8]

PARTIAL_SUFFIX = ".partial"
"""Suffix of the file of an image that is being written."""
_THUMBNAIL_PX = 8  # image pixels per pixel of a thumbnail along each axis
_NEAR_PERCENTILE = 25  # percentile of the depths: nearer surfaces fill a quarter of the image


@dataclass(frozen=True, eq=False)
class MeterTask:
    """Task that measures the brightness of frames."""

    job: RenderJob
    """Job of the frames."""
    scene: CompiledWorld
    """World to render."""
    indices: npt.NDArray[np.int64]
    """(K,) Indices of the frames in the schedule."""
    result: Path
    """File for the histograms (K, 256): the fraction of the first camera's pixels on each grey level."""

    def run(self) -> Iterator[None]:
        """Meter the frames, and yield after each."""
        exposed_ns = self.job.schedule.exposed_ns[self.indices]
        histograms = np.zeros((len(self.indices), 256))
        with _opened(self.scene.model_path) as (model, context):
            camera = OffscreenCamera(
                model, thumbnail(self.job.rig.cameras[0].model), supersampling=1.0, context=context
            )
            for row, (t_ns, T_world_cam) in enumerate(zip(exposed_ns, self.job.poses(0)(exposed_ns), strict=True)):
                image = camera.render(T_world_cam, self.scene.movers_at(int(t_ns)))
                histograms[row] = np.bincount(image.ravel(), minlength=256) / image.size
                yield
        np.save(self.result, histograms)


@dataclass(frozen=True, eq=False)
class RenderTask:
    """Task that renders and writes frames."""

    job: RenderJob
    """Job of the frames."""
    scene: CompiledWorld
    """World to render."""
    indices: npt.NDArray[np.int64]
    """(K,) Indices of the frames in the schedule."""
    truth: FrameTruth
    """True times and exposures of all frames of the job."""
    mav0: Path
    """Folder ``mav0``, which contains ``cam0/data`` and its siblings."""

    def run(self) -> Iterator[None]:
        """Render the frames, and yield after each frame of all cameras."""
        kinds = self.job.truth_images
        with ExitStack() as open_:
            model, context = open_.enter_context(_opened(self.scene.model_path))
            cameras = [_FrameRenderer(self, number, model, context) for number in range(len(self.job.rig.cameras))]
            truth_renderers: list[_DepthFlowRenderer | _SegmentationRenderer] = []
            if "depth" in kinds or "flow" in kinds:
                truth_renderers.append(_DepthFlowRenderer(self, model, context))
            if "segmentation" in kinds:
                truth_renderers.append(
                    _SegmentationRenderer(self, *open_.enter_context(_opened(self.scene.instances_path)))
                )
            for index in self.indices.tolist():
                name = f"{self.truth.t_ns[index]}.png"
                for renderer in truth_renderers:
                    for folder, image in renderer.render(index).items():
                        write_png(self.mav0 / folder / "data" / name, image)
                for number, camera in enumerate(cameras):
                    write_png(self.mav0 / f"cam{number}" / "data" / name, camera.render(index))
                yield


class _FrameRenderer:
    """Renderer of the frames of one camera, with shutter and image sensor."""

    def __init__(self, task: RenderTask, number: int, model: mujoco.MjModel, context: RenderContext) -> None:
        """Create the renderers of a camera."""
        self._task, self._number = task, number
        camera = task.job.rig.cameras[number]
        self._poses, self._readout_s = task.job.poses(number), camera.readout_s
        self._shutter = Shutter(camera, task.job.margin_px(number))
        self._camera = OffscreenCamera(model, self._shutter.drawn, context=context)
        self._thumbnail = OffscreenCamera(model, thumbnail(camera.model), supersampling=1.0, context=context)

    def render(self, index: int) -> GreyImage:
        """Return the frame (H, W) with an index."""
        job, scene, truth = self._task.job, self._task.scene, self._task.truth
        middle_ns, exposure_s = int(truth.exposed_ns[index]), float(truth.exposure_s[index])
        half_ns = round(0.5e9 * (exposure_s + self._readout_s))
        p_world_cam = self._pose(middle_ns)[:3, 3]
        swept_rad = scene.angle_swept_rad(middle_ns - half_ns, middle_ns + half_ns, p_world_cam)
        plan = self._shutter.plan(self._poses, middle_ns, exposure_s, self._nearest_m(middle_ns), swept_rad)
        light = self._shutter.expose(plan, self._poses, self._view)
        irradiance = scene.illumination * float(truth.lit[index])
        gain = float(truth.gain[index])
        return job.imaging.digitize(
            light, irradiance, exposure_s, gain, generator(job.seed, "images", index, self._number)
        )

    def _view(self, t_ns: int, rows: slice) -> GreyImage:
        """Return rows of the noise-free image at a time [ns]."""
        return self._camera.render(self._pose(t_ns), self._task.scene.movers_at(t_ns), rows)

    def _nearest_m(self, t_ns: int) -> float:
        """Return the depth of near surfaces at a time [m]; infinite if there are none."""
        depth = self._thumbnail.render_depth(self._pose(t_ns), self._task.scene.movers_at(t_ns))
        depth = depth[np.isfinite(depth)]
        return float(np.percentile(depth, _NEAR_PERCENTILE)) if depth.size else np.inf

    def _pose(self, t_ns: int) -> Array:
        """Return the pose T_world_cam (4, 4) at a time [ns]."""
        return np.asarray(self._poses(np.array([t_ns]))[0])


class _DepthFlowRenderer:
    """Renderer of the depth and flow images of the first camera."""

    def __init__(self, task: RenderTask, model: mujoco.MjModel, context: RenderContext) -> None:
        """Create the renderer."""
        self._task, self._poses = task, task.job.poses(0)
        self._camera = OffscreenCamera(model, task.job.rig.cameras[0].model, context=context)

    def render(self, index: int) -> dict[str, npt.NDArray[np.uint16]]:
        """Return the depth and flow images of a frame that the job requests, by folder."""
        kinds = self._task.job.truth_images
        exposed_ns = self._task.truth.exposed_ns[index : index + 2]
        poses, movers = self._poses(exposed_ns), [self._task.scene.movers_at(t_ns) for t_ns in exposed_ns.tolist()]
        seen = self._camera.render_surfaces(poses[0], movers[0])
        images = {"depth": depth_image(seen)}
        if "flow" in kinds and len(poses) == 2:
            images["flow"] = flow_image(self._camera.render_flow(*poses, *movers))
        return {FOLDERS[kind]: images[kind] for kind in kinds if kind in images}


class _SegmentationRenderer:
    """Renderer of the segmentation images of the first camera."""

    def __init__(self, task: RenderTask, things: mujoco.MjModel, context: RenderContext) -> None:
        """Create the renderer."""
        self._task, self._poses = task, task.job.poses(0)
        self._camera = OffscreenCamera(things, task.job.rig.cameras[0].model, context=context)

    def render(self, index: int) -> dict[str, npt.NDArray[np.uint16]]:
        """Return the segmentation image of a frame, by folder."""
        exposed_ns = self._task.truth.exposed_ns[index : index + 1]
        seen = self._camera.render_surfaces(self._poses(exposed_ns)[0], self._task.scene.movers_at(int(exposed_ns[0])))
        return {FOLDERS["segmentation"]: segmentation_image(seen)}


@contextmanager
def _opened(model_path: Path) -> Iterator[tuple[mujoco.MjModel, RenderContext]]:
    """Load a model into graphics memory for the duration of the context."""
    model = mujoco.MjModel.from_binary_path(str(model_path))
    context = RenderContext(model)
    try:
        yield model, context
    finally:
        context.close()


def thumbnail(model: CameraModel) -> CameraModel:
    """Return a camera with the same field of view and an image of 1/8 of the width and height."""
    width, height = (max(size // _THUMBNAIL_PX, 1) for size in (model.width, model.height))
    return model.resized(width, height)


def write_png(path: Path, image: npt.NDArray[np.uint8] | npt.NDArray[np.uint16]) -> None:
    """Write an image to a temporary name and rename it, so that no partial image is visible."""
    partial = path.with_suffix(PARTIAL_SUFFIX)
    partial.write_bytes(cv2.imencode(".png", image)[1].tobytes())
    partial.replace(path)
