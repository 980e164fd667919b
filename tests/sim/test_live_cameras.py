"""Frames one at a time during a flight: those of recordings to the byte, from a recent part of the motion."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import mujoco
import numpy as np
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, frame_truth_text
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import pose_matrix, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import CameraFrame, Trajectory
from dronevio.sim.cameras.exposure import AutoExposure
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.cameras.schedule import FrameSchedule, nominal_stamps
from dronevio.sim.rendering import compiled_world, loaded_world
from dronevio.sim.rendering.frame_files import write_frame
from dronevio.sim.rendering.live_cameras import LiveCameras
from dronevio.sim.rendering.loaded_world import LOADED_WORLDS
from dronevio.sim.rendering.render import render_frames
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.world import Mover

SMALL = CameraModel(width=120, height=80, fx=75.0, fy=75.0, cx=58.0, cy=41.0, distortion=(-0.28, 0.07, 0.0, 0.0))
R_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
BASELINE = pose_matrix(np.eye(3), np.array([0.11, 0.0, 0.0]))
RIG = Rig((RigCamera(SMALL, np.eye(4), readout_s=0.01), RigCamera(SMALL, BASELINE)))
IMAGING = Imaging(control=AutoExposure(target_level=80.0, tolerance=0.0))
START_NS = 1_403_715_273_262_142_976
RATE_RAD_S = 4.0


def flown() -> Trajectory:
    """Return the path of a camera that rotates about the vertical and moves along x, for 0.3 s."""
    t_ns = np.arange(START_NS, START_NS + 300_000_000, 5_000_000)
    s = (t_ns - START_NS) * 1e-9
    R = np.stack([rotation_z(RATE_RAD_S * t) @ R_LEVEL for t in s])
    return Trajectory(t_ns, np.stack([4.0 * s - 0.5, 0 * s, 0 * s + 1.2], axis=1), quat_wxyz_from_matrix(R))


def crossing(t_s: np.ndarray) -> np.ndarray:
    """Return the poses of a lamp that moves to the right, 1.2 m in front of the first pose."""
    p = np.stack([0.7 + 0 * t_s, 0.3 - 3.0 * t_s**2, 1.2 + 0 * t_s], axis=1)
    return pose_matrix(np.broadcast_to(np.eye(3), (len(t_s), 3, 3)), p)


@pytest.fixture(autouse=True)
def small_world(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Replace every world by emissive pillars and a moving lamp."""
    rng = np.random.default_rng(5)
    spec = mujoco.MjSpec()
    for k in range(60):
        glow = spec.add_material(name=f"glow_{k}", emission=1.0, rgba=[*rng.uniform(0.05, 0.7, 3), 1.0])
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.2, 0.2, rng.uniform(0.2, 2.0)],
            pos=rotation_z(rng.uniform(0.0, 6.3)) @ [rng.uniform(2.0, 6.0), 0.0, rng.uniform(0.0, 2.0)],
            material=glow.name,
        )
    lamp = spec.worldbody.add_body(name="lamp", mocap=True)
    lamp.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0.0, 0.0], material="glow_0")
    spec.stat.extent = 10.0
    world = SimpleNamespace(spec=spec, illumination=0.8, movers=(Mover("lamp", crossing),))
    monkeypatch.setattr(compiled_world, "build_world", lambda name, seed, light_seed: world)
    monkeypatch.setattr(compiled_world, "instance_spec", lambda name, seed: spec)
    monkeypatch.setattr(loaded_world, "_compiled", lambda key: (spec.compile(), world.illumination, world.movers))
    LOADED_WORLDS.clear()
    yield
    LOADED_WORLDS.clear()


def live(rig: Rig = RIG) -> LiveCameras:
    """Return cameras in the small world with the margins of a recording of the path."""
    return LiveCameras(rig, "small", 3, IMAGING, start_ns=START_NS, design_rate_rad_s=RATE_RAD_S)


def schedule() -> FrameSchedule:
    """Return five frames, the third of them dark."""
    stamps_ns = nominal_stamps(START_NS, START_NS + 250_000_000, 20.0)
    return FrameSchedule(stamps_ns - 1_000_000, stamps_ns, np.arange(5) != 2)


def frames_of(cameras: LiveCameras) -> list[CameraFrame]:
    """Return the frames along the path, each rendered from the motion up to the time at which it is ready."""
    truth, frames = flown(), []
    for t_ns, exposed_ns, lit in zip(*(part.tolist() for part in vars(schedule()).values()), strict=True):
        end = int(np.searchsorted(truth.t_ns, cameras.ready_ns(exposed_ns)))
        frames.append(cameras.frame(t_ns, exposed_ns, lit, truth[max(end - 8, 0) : end + 1]))
    return frames


@pytest.mark.slow
def test_live_frames_equal_those_of_recordings(tmp_path: Path) -> None:
    truth = render_frames(RenderJob("small", 3, RIG, flown(), schedule(), IMAGING), tmp_path / "recorded", workers=1)
    cameras = live()
    for frame in frames_of(cameras):
        assert [image.std() > 10.0 for image in frame.images] == [frame.t_ns != schedule().stamps_ns[2]] * 2
        write_frame(tmp_path / "live", frame)
    assert frame_truth_text(cameras.frames) == frame_truth_text(truth)
    assert len(np.unique(truth.exposure_s)) > 2
    recorded = sorted((tmp_path / "recorded").rglob("*.png"))
    assert len(recorded) == 10 == len(list((tmp_path / "live").rglob("*.png")))
    for file in recorded:
        assert file.read_bytes() == (tmp_path / "live" / file.relative_to(tmp_path / "recorded")).read_bytes()
    assert (tmp_path / "recorded" / FRAME_TRUTH_FILE).exists()
    cameras.close()


def test_a_flight_restarts_with_other_noise() -> None:
    cameras = live()
    first = frames_of(cameras)
    cameras.restart(3, START_NS)
    assert len(cameras.frames.t_ns) == 0
    again = frames_of(cameras)
    cameras.restart(4, START_NS)
    other = frames_of(cameras)
    for one, two, three in zip(first, again, other, strict=True):
        for image, same, differs in zip(one.images, two.images, three.images, strict=True):
            np.testing.assert_array_equal(image, same)
            assert np.any(image != differs)
            assert abs(image.mean() - differs.mean()) < 0.5
    cameras.close()


def test_closed_cameras_release_the_world() -> None:
    cameras, truth = live(), flown()
    assert len(LOADED_WORLDS) == 0  # nothing is loaded before the first frame
    first = cameras.frame(1, START_NS + 50_000_000, True, truth)
    LOADED_WORLDS.clear()
    assert len(LOADED_WORLDS) == 1
    cameras.close()
    cameras.close()
    LOADED_WORLDS.clear()
    assert len(LOADED_WORLDS) == 0
    cameras.restart(3, START_NS)
    again = cameras.frame(1, START_NS + 50_000_000, True, truth)
    np.testing.assert_array_equal(first.images[0], again.images[0])
    cameras.close()


def test_impossible_frames_are_refused() -> None:
    cameras, truth = live(), flown()
    with pytest.raises(ConfigError, match="true motion around it"):
        cameras.frame(1, START_NS - 1, True, truth)
    with pytest.raises(ConfigError, match="true motion around it"):
        cameras.frame(1, START_NS, True, truth[:1])
    cameras.frame(10, START_NS + 50_000_000, True, truth)
    with pytest.raises(ConfigError, match="increasing"):
        cameras.frame(10, START_NS + 100_000_000, True, truth)
    with pytest.raises(ConfigError, match="without a camera"):
        live(replace(RIG, cameras=()))
    cameras.close()
