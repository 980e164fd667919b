"""Rendering of a world at one time into an atlas of pinhole views in graphics memory."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError, GraphicsError
from dronevio.models.rotation import inverse_pose, pose_matrix, quat_wxyz_from_matrix
from dronevio.sim.cameras.gl import (
    Context,
    blend_no_mipmaps,
    create_context,
    free,
    is_usable,
    make_current,
    read_rgba,
    replace_texture,
)
from dronevio.sim.cameras.views import PinholeView, Views

Colours = npt.NDArray[np.uint8]
InverseDepth = npt.NDArray[np.float32]
MoverPoses = Mapping[str, Array]
"""Poses T_world_body (4, 4) of moving objects by the name of their mocap body."""

NO_MOVERS: MoverPoses = MappingProxyType({})
"""No poses: all objects are at the poses of the world's specification."""


class RenderContext:
    """Graphics memory with the meshes and textures of a world and a frame buffer. Close it after use."""

    def __init__(self, model: mujoco.MjModel, blend_mipmaps: bool = True, grey: bool = False) -> None:
        """Load a world into graphics memory.

        Args:
            model: The compiled world.
            blend_mipmaps: Whether the sizes of a texture are blended; without that, small images are rendered faster.
            grey: Whether the images will be grey. Textures then have one channel, which is rendered faster; grey
                levels differ by at most 2 from those of colours.

        Raises:
            GraphicsError: Off-screen OpenGL is not available.
        """
        self._gl: Context | None = create_context(1, 1)  # images are rendered into a frame buffer of their own
        self.mjr_context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
        """MuJoCo's rendering context."""
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self.mjr_context)
        self.mjr_context.readDepthMap = mujoco.mjtDepthMap.mjDEPTH_ZEROFAR
        if grey:
            _make_grey(model, self.mjr_context)
        if not blend_mipmaps:
            types, numbers = self.mjr_context.textureType, self.mjr_context.texture
            flat = mujoco.mjtTexture.mjTEXTURE_2D
            blend_no_mipmaps([int(numbers[k]) for k in range(self.mjr_context.ntexture) if types[k] == flat])

    def activate(self, width: int, height: int) -> None:
        """Make the context current with a frame buffer of at least the given size [px].

        Raises:
            GraphicsError: The graphics memory has been released or lost, or the process was forked after rendering.
        """
        if self._gl is None:
            raise GraphicsError("the camera has been closed")
        make_current(self._gl)
        size = self.mjr_context.offWidth, self.mjr_context.offHeight
        if width > size[0] or height > size[1]:
            mujoco.mjr_resizeOffscreen(max(width, size[0]), max(height, size[1]), self.mjr_context)

    def usable(self) -> bool:
        """Return whether the graphics memory is neither released nor lost."""
        return self._gl is not None and is_usable(self._gl)

    def close(self) -> None:
        """Release the graphics memory; further calls have no effect.

        Raises:
            GraphicsError: The graphics memory has been lost, or the process was forked after rendering.
        """
        if self._gl is not None:
            make_current(self._gl)
            self.mjr_context.free()
            free(self._gl)
            self._gl = None


class AtlasRenderer:
    """Renderer of an atlas of views with its scene."""

    def __init__(self, model: mujoco.MjModel, views: Views, context: RenderContext) -> None:
        """Create the scene.

        Args:
            model: The compiled world without the drone; its textures contain the lighting.
            views: The views of the atlas.
            context: Graphics memory of the world, which several renderers may share.
        """
        self._model, self._views, self._context = model, views, context
        self.near_m, self.far_m = (float(v * model.stat.extent) for v in (model.vis.map.znear, model.vis.map.zfar))
        self._scene = unlit_scene(model)
        geoms = self._scene.geoms[: self._scene.ngeom]
        self._reflects = any(geom.reflectance > 0.0 for geom in geoms)
        self._geom_of_id = np.full(len(geoms) + 1, -1, np.int32)  # mark 0 is the background
        for geom in geoms:
            self._geom_of_id[geom.segid + 1] = geom.objid
        self._data = mujoco.MjData(model)
        self._mocap_start = self._data.mocap_pos.copy(), self._data.mocap_quat.copy()
        self._mocap_of = {
            str(model.body(number).name): int(mocap) for number, mocap in enumerate(model.body_mocapid) if mocap >= 0
        }
        self._moving = [geom for geom in geoms if self._mover_of(geom.objid) >= 0]
        self._colours = np.empty((views.height, views.width, 3), np.uint8)
        self._rgba = np.empty((views.height, views.width, 4), np.uint8)
        self._grey = np.empty((views.height, views.width), np.uint8)
        self._inverse_depth = np.empty((views.height, views.width), np.float32)

    def colours(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> Colours:
        """Return the RGB atlas (H', W', 3) at a camera pose (4, 4); valid until the next rendering.

        The first row is the lowest one, as in OpenGL.

        Raises:
            GraphicsError: The graphics memory has been released.
            ConfigError: A moving object is unknown.
        """
        self._draw_textured(T_world_cam, mover_poses, None)
        return self._read_colours(0, self._views.height)

    def grey(
        self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS, rows: Sequence[tuple[int, int]] | None = None
    ) -> npt.NDArray[np.uint8]:
        """Return the grey atlas (H', W') at a camera pose (4, 4); valid until the next rendering.

        The first row is the lowest one, as in OpenGL.

        Args:
            T_world_cam: (4, 4) Pose of the camera.
            mover_poses: Poses (4, 4) of moving objects by name.
            rows: First row to render of each view and the row after the last; other rows are undefined. None renders
                all rows.

        Raises:
            GraphicsError: The graphics memory has been released.
            ConfigError: A moving object is unknown.
        """
        drawn = [extent for extent in rows if extent[1] > extent[0]] if rows is not None else [(0, self._views.height)]
        if not drawn:
            return self._grey
        self._draw_textured(T_world_cam, mover_poses, rows)
        low, high = min(first for first, _ in drawn), max(end for _, end in drawn)
        if self._context.mjr_context.offSamples == 0:  # four channels are copied without conversion
            read_rgba(self._rgba[low:high], low)
            cv2.cvtColor(self._rgba[low:high], cv2.COLOR_RGBA2GRAY, dst=self._grey[low:high])
        else:
            cv2.cvtColor(self._read_colours(low, high)[low:high], cv2.COLOR_RGB2GRAY, dst=self._grey[low:high])
        return self._grey

    def surfaces(self, T_world_cam: Array, mover_poses: MoverPoses = NO_MOVERS) -> tuple[InverseDepth, Colours]:
        """Return inverse depth (H', W') and identifier colours (H', W', 3) of the atlas at a camera pose (4, 4).

        Both are valid until the next rendering. Inverse depth is affine in the inverse of the z of a view: 1 at the
        near plane, 0 at the far plane. `geoms` decodes the identifier colours.

        Raises:
            GraphicsError: The graphics memory has been released.
            ConfigError: A moving object is unknown.
        """
        id_flags = (mujoco.mjtRndFlag.mjRND_SEGMENT, mujoco.mjtRndFlag.mjRND_IDCOLOR)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for flag in id_flags:  # without textures, which is several times as fast
            self._scene.flags[flag] = True
        self._draw(T_world_cam, mover_poses, None)
        drawn = mujoco.MjrRect(0, 0, self._views.width, self._views.height)
        mujoco.mjr_readPixels(self._colours, self._inverse_depth, drawn, self._context.mjr_context)
        for flag in id_flags:
            self._scene.flags[flag] = False
        return self._inverse_depth, self._colours

    def geoms(self, id_colours: Colours) -> npt.NDArray[np.int32]:
        """Return the indices (N,) in the model of the geoms with identifier colours (N, 3); −1 for the background."""
        return self._geom_of_id[id_colours.astype(np.int32) @ np.array([1, 256, 65536], np.int32)]

    def motion_of_geoms(self, now: MoverPoses, then: MoverPoses) -> dict[int, Array]:
        """Return for each moving geom the transformation (4, 4) of its points in the world from one time to another."""
        if not self._moving:
            return {}
        Ts_then_now = self._poses_of_bodies(then) @ inverse_pose(self._poses_of_bodies(now))
        return {int(geom.objid): Ts_then_now[self._model.geom_bodyid[geom.objid]] for geom in self._moving}

    def _draw_textured(
        self, T_world_cam: Array, mover_poses: MoverPoses, rows: Sequence[tuple[int, int]] | None
    ) -> None:
        """Render rows of the views into graphics memory, with reflections where the world has any."""
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = self._reflects
        self._draw(T_world_cam, mover_poses, rows)

    def _read_colours(self, low: int, high: int) -> Colours:
        """Return the RGB atlas, of which rows were read from graphics memory."""
        drawn = mujoco.MjrRect(0, low, self._views.width, high - low)
        mujoco.mjr_readPixels(self._colours[low:high], None, drawn, self._context.mjr_context)
        return self._colours

    def _draw(self, T_world_cam: Array, mover_poses: MoverPoses, rows: Sequence[tuple[int, int]] | None) -> None:
        """Render rows of the views into graphics memory; None renders all rows."""
        views = self._views.views
        self._context.activate(self._views.width, self._views.height)
        self._place(mover_poses)
        for geom in self._moving:
            geom.pos, geom.mat = self._data.geom_xpos[geom.objid], self._data.geom_xmat[geom.objid].reshape(3, 3)
        for view, (low, high) in zip(views, rows or [(0, view.height) for view in views], strict=True):
            part = view.rows(low, high)
            if part.height > 0:
                set_camera(self._scene, T_world_cam, part, self.near_m, self.far_m)
                place = mujoco.MjrRect(part.column, low, part.width, part.height)
                mujoco.mjr_render(place, self._scene, self._context.mjr_context)

    def _place(self, mover_poses: MoverPoses) -> None:
        """Set the poses of the mocap bodies; bodies without a pose get their initial one."""
        if not self._moving and not mover_poses:
            return
        self._data.mocap_pos[:], self._data.mocap_quat[:] = self._mocap_start
        if unknown := [name for name in mover_poses if name not in self._mocap_of]:
            raise ConfigError(f"unknown moving object {unknown[0]!r}")
        if mover_poses:
            mocaps, Ts_world_body = [self._mocap_of[name] for name in mover_poses], np.stack([*mover_poses.values()])
            self._data.mocap_pos[mocaps] = Ts_world_body[:, :3, 3]
            self._data.mocap_quat[mocaps] = quat_wxyz_from_matrix(Ts_world_body[:, :3, :3])
        mujoco.mj_kinematics(self._model, self._data)

    def _poses_of_bodies(self, mover_poses: MoverPoses) -> Array:
        """Return the poses T_world_body (B, 4, 4) of all bodies."""
        self._place(mover_poses)
        return pose_matrix(self._data.xmat.reshape(-1, 3, 3).copy(), self._data.xpos.copy())

    def _mover_of(self, geom: int) -> int:
        """Return the index of the mocap body of a geom; −1 for static geoms."""
        return int(self._model.body_mocapid[self._model.body_rootid[self._model.geom_bodyid[geom]]])


def set_camera(scene: mujoco.MjvScene, T_world_cam: Array, view: PinholeView, near_m: float, far_m: float) -> None:
    """Set the camera of a scene to a view of a camera at a pose (4, 4)."""
    _, down, ahead = (T_world_cam[:3, :3] @ view.R_cam_view).T
    for eye in scene.camera:  # two eyes; MuJoCo renders from their mean
        eye.pos, eye.forward, eye.up = T_world_cam[:3, 3], ahead, -down
        eye.frustum_near, eye.frustum_far = near_m, far_m
        eye.frustum_center, eye.frustum_width, eye.frustum_bottom, eye.frustum_top = view.frustum(near_m)


def _make_grey(model: mujoco.MjModel, context: mujoco.MjrContext) -> None:
    """Replace the flat RGB textures in graphics memory by grey ones, but for those of tinted materials."""
    tinted = np.ptp(model.mat_rgba[:, :3], axis=1) > 0.0
    coloured = set(model.mat_texid[tinted].ravel().tolist())
    flat, linear = mujoco.mjtTexture.mjTEXTURE_2D, model.tex_colorspace != mujoco.mjtColorSpace.mjCOLORSPACE_SRGB
    for number in np.flatnonzero((model.tex_type == flat) & (model.tex_nchannel == 3) & linear).tolist():
        if number not in coloured:
            start, size = model.tex_adr[number], (model.tex_height[number], model.tex_width[number], 3)
            colours = model.tex_data[start : start + int(np.prod(size))].reshape(size)
            replace_texture(int(context.texture[number]), np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY)))


def disable_lights(scene: mujoco.MjvScene) -> None:
    """Disable lights and expensive effects of a scene, whose textures contain the lighting."""
    scene.nlight = 0
    for effect in ("SHADOW", "REFLECTION", "SKYBOX", "FOG", "HAZE"):
        scene.flags[getattr(mujoco.mjtRndFlag, f"mjRND_{effect}")] = False


def unlit_scene(model: mujoco.MjModel) -> mujoco.MjvScene:
    """Return a scene of the geoms at their initial poses, without lights."""
    data, scene = mujoco.MjData(model), mujoco.MjvScene(model, maxgeom=model.ngeom + 10)
    mujoco.mj_kinematics(model, data)
    view = mujoco.MjvCamera()
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, view, mujoco.mjtCatBit.mjCAT_ALL, scene)
    disable_lights(scene)
    return scene
