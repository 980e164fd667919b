"""Tasks of the rendering processes: metering frames, and rendering and writing them."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.sim.cameras.atlas_renderer import RenderContext
from dronevio.sim.cameras.camera import OffscreenCamera
from dronevio.sim.cameras.exposure import Exposure
from dronevio.sim.rendering.compiled_world import CompiledWorld
from dronevio.sim.rendering.frame_files import frame_file, write_png
from dronevio.sim.rendering.frame_renderer import FrameExposure, FrameRenderer, Thumbnail, image_noise
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.rendering.truth_images import FOLDERS, depth_image, flow_image, segmentation_image


@dataclass(frozen=True, eq=False)
class MeterTask:
    """Task that measures the brightness of frames."""

    job: RenderJob
    """Job of the frames."""
    world: CompiledWorld
    """World to render."""
    indices: npt.NDArray[np.int64]
    """(K,) Indices of the frames in the schedule."""
    result: Path
    """File for the histograms (K, 256): the fraction of the first camera's pixels on each grey level."""

    def run(self) -> Iterator[None]:
        """Meter the frames, and yield after each."""
        exposed_ns = self.job.schedule.exposed_ns[self.indices]
        histograms = np.zeros((len(self.indices), 256))
        with _opened(self.world.model_path) as (model, context):
            small = Thumbnail(self.job.rig.cameras[0].model, model, context)
            for row, (t_ns, T_world_cam) in enumerate(zip(exposed_ns, self.job.poses(0)(exposed_ns), strict=True)):
                histograms[row] = small.histogram(T_world_cam, self.world.scene.movers_at(int(t_ns)))
                yield
        np.save(self.result, histograms)


@dataclass(frozen=True, eq=False)
class RenderTask:
    """Task that renders and writes frames."""

    job: RenderJob
    """Job of the frames."""
    world: CompiledWorld
    """World to render."""
    indices: npt.NDArray[np.int64]
    """(K,) Indices of the frames in the schedule."""
    truth: FrameTruth
    """True times and exposures of all frames of the job."""
    mav0: Path
    """Folder ``mav0``, which contains ``cam0/data`` and its siblings."""

    def run(self) -> Iterator[None]:
        """Render the frames, and yield after each frame of all cameras."""
        job, kinds = self.job, self.job.truth_images
        with ExitStack() as open_:
            model, context = open_.enter_context(_opened(self.world.model_path))
            cameras = [
                FrameRenderer(camera, job.imaging, model, context, job.margin_px(number))
                for number, camera in enumerate(job.rig.cameras)
            ]
            all_poses = [job.poses(number) for number in range(len(cameras))]
            truth_renderers: list[_DepthFlowRenderer | _SegmentationRenderer] = []
            if "depth" in kinds or "flow" in kinds:
                truth_renderers.append(_DepthFlowRenderer(self, model, context))
            if "segmentation" in kinds:
                truth_renderers.append(
                    _SegmentationRenderer(self, *open_.enter_context(_opened(self.world.instances_path)))
                )
            for index in self.indices.tolist():
                t_ns = int(self.truth.t_ns[index])
                for renderer in truth_renderers:
                    for folder, image in renderer.render(index).items():
                        write_png(frame_file(self.mav0, folder, t_ns), image)
                frame = _exposure_of(self.truth, index)
                for number, (camera, poses) in enumerate(zip(cameras, all_poses, strict=True)):
                    grey = camera.render(frame, poses, self.world.scene, image_noise(job.seed, index, number))
                    write_png(frame_file(self.mav0, f"cam{number}", t_ns), grey)
                yield


class _DepthFlowRenderer:
    """Renderer of the depth and flow images of the first camera."""

    def __init__(self, task: RenderTask, model: mujoco.MjModel, context: RenderContext) -> None:
        """Create the renderer."""
        self._task, self._poses, self._scene = task, task.job.poses(0), task.world.scene
        self._camera = OffscreenCamera(model, task.job.rig.cameras[0].model, context=context)

    def render(self, index: int) -> dict[str, npt.NDArray[np.uint16]]:
        """Return the depth and flow images of a frame that the job requests, by folder."""
        kinds = self._task.job.truth_images
        exposed_ns = self._task.truth.exposed_ns[index : index + 2]
        poses, movers = self._poses(exposed_ns), [self._scene.movers_at(t_ns) for t_ns in exposed_ns.tolist()]
        seen = self._camera.render_surfaces(poses[0], movers[0])
        images = {"depth": depth_image(seen)}
        if "flow" in kinds and len(poses) == 2:
            images["flow"] = flow_image(self._camera.render_flow(*poses, *movers))
        return {FOLDERS[kind]: images[kind] for kind in kinds if kind in images}


class _SegmentationRenderer:
    """Renderer of the segmentation images of the first camera."""

    def __init__(self, task: RenderTask, things: mujoco.MjModel, context: RenderContext) -> None:
        """Create the renderer."""
        self._task, self._poses, self._scene = task, task.job.poses(0), task.world.scene
        self._camera = OffscreenCamera(things, task.job.rig.cameras[0].model, context=context)

    def render(self, index: int) -> dict[str, npt.NDArray[np.uint16]]:
        """Return the segmentation image of a frame, by folder."""
        exposed_ns = self._task.truth.exposed_ns[index : index + 1]
        seen = self._camera.render_surfaces(self._poses(exposed_ns)[0], self._scene.movers_at(int(exposed_ns[0])))
        return {FOLDERS["segmentation"]: segmentation_image(seen)}


def _exposure_of(truth: FrameTruth, index: int) -> FrameExposure:
    """Return time, exposure and light of the frame with an index."""
    exposure = Exposure(float(truth.exposure_s[index]), float(truth.gain[index]))
    return FrameExposure(int(truth.exposed_ns[index]), exposure, bool(truth.lit[index]))


@contextmanager
def _opened(model_path: Path) -> Iterator[tuple[mujoco.MjModel, RenderContext]]:
    """Load a model into graphics memory for the duration of the context."""
    model = mujoco.MjModel.from_binary_path(str(model_path))
    context = RenderContext(model, grey=True)
    try:
        yield model, context
    finally:
        context.close()
