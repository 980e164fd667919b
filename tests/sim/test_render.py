"""Parallel rendering: images do not depend on the number of workers, and no partial files remain."""

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import mujoco
import numpy as np
import psutil
import pytest

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, DefectError, GraphicsError, IncompleteError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.euroc import INCOMPLETE, EurocRecording, write_euroc
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, read_frame_truth
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rotation import pose_matrix, quat_wxyz_from_matrix, rotation_z
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.exposure import AutoExposure, FixedExposure
from dronevio.sim.cameras.imaging import Imaging
from dronevio.sim.cameras.schedule import FrameSchedule, nominal_stamps, schedule_frames
from dronevio.sim.rendering.render import link_frames, render_frames
from dronevio.sim.rendering.render_job import RenderJob

SMALL = CameraModel(width=188, height=120, fx=115.0, fy=115.0, cx=92.0, cy=62.0, distortion=(-0.28, 0.07, 0.0, 0.0))
R_LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
BASELINE = pose_matrix(np.eye(3), np.array([0.11, 0.0, 0.0]))
START_NS = 1_403_715_273_262_142_976  # as a real recording's


def rotating(stamps_ns: np.ndarray) -> Trajectory:
    """Return the path of a camera that rotates about the vertical and moves along x."""
    s = (stamps_ns - stamps_ns[0]) * 1e-9
    R = np.stack([rotation_z(6.0 * t) @ R_LEVEL for t in s])
    p = np.stack([4.0 * s - 0.5, 0.0 * s + 0.1, 0.0 * s + 1.2], axis=1)
    return Trajectory(stamps_ns, p, quat_wxyz_from_matrix(R))


def stationary() -> Trajectory:
    """Return the path of a camera that stays at the first pose of `rotating`."""
    path = rotating(np.arange(START_NS, START_NS + 300_000_000, 5_000_000))
    return replace(
        path, p_world_imu=np.tile(path.p_world_imu[0], (60, 1)), quat_wxyz=np.tile(path.quat_wxyz[0], (60, 1))
    )


def job(**changes: Any) -> RenderJob:
    """Return six frames in a room."""
    stamps_ns = nominal_stamps(START_NS, START_NS + 300_000_000, 20.0)
    whole = RenderJob(
        "room",
        3,
        Rig((RigCamera(SMALL, np.eye(4)),)),
        rotating(np.arange(START_NS, START_NS + 300_000_000, 5_000_000)),
        FrameSchedule(stamps_ns, stamps_ns, np.ones(6, dtype=bool)),
    )
    return replace(whole, **changes)


@pytest.fixture(autouse=True)
def small_world(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Replace every world by emissive pillars, which are built and rendered quickly."""
    rng = np.random.default_rng(5)
    spec = mujoco.MjSpec()
    for k in range(200):
        glow = spec.add_material(name=f"glow_{k}", emission=1.0, rgba=[*rng.uniform(0.05, 0.7, 3), 1.0])
        spec.worldbody.add_geom(
            name=f"pillar_{k}",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[0.2, 0.2, rng.uniform(0.2, 2.0)],
            pos=rotation_z(rng.uniform(0.0, 6.3)) @ [rng.uniform(2.0, 6.0), 0.0, rng.uniform(0.0, 2.0)],
            material=glow.name,
        )
    spec.stat.extent = 10.0
    world = SimpleNamespace(spec=spec, illumination=1.0, movers=())
    monkeypatch.setattr("dronevio.sim.rendering.compiled_world.build_world", lambda name, seed, light_seed: world)
    monkeypatch.setattr("dronevio.sim.rendering.compiled_world.instance_spec", lambda name, seed: spec)
    return world


def contents(folder: Path) -> dict[str, bytes]:
    """Return the files in and below a folder."""
    return {str(file.relative_to(folder)): file.read_bytes() for file in sorted(folder.rglob("*")) if file.is_file()}


def read(mav0: Path, stamp: int, camera: int = 0) -> np.ndarray:
    """Return an image."""
    image = cv2.imread(str(mav0 / f"cam{camera}" / "data" / f"{stamp}.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return image


@pytest.mark.slow
def test_images_do_not_depend_on_the_workers(tmp_path: Path) -> None:
    progress: list[tuple[int, int]] = []
    stereo = Rig((RigCamera(SMALL, np.eye(4), readout_s=0.01), RigCamera(SMALL, BASELINE)))
    work = job(rig=stereo, imaging=Imaging(control=AutoExposure(target_level=80.0, tolerance=0.0)))
    truth = render_frames(work, tmp_path / "one", lambda d, n: progress.append((d, n)), workers=1)
    render_frames(work, tmp_path / "three", workers=3)
    one = contents(tmp_path / "one")
    stamps = work.schedule.stamps_ns.tolist()
    assert sorted(one) == sorted(
        [f"cam{i}/data/{t}.png" for t in stamps for i in (0, 1)] + ["frame_groundtruth0/data.csv"]
    )
    assert one == contents(tmp_path / "three")
    assert progress[0] == (0, 6)
    assert progress[-1] == (6, 6)
    for t in stamps:
        left, right = read(tmp_path / "one", t, 0), read(tmp_path / "one", t, 1)
        assert left.shape == right.shape == (120, 188) and left.dtype == np.uint8
        assert left.std() > 20.0 and np.abs(left.astype(float) - right).mean() > 5.0
    back = read_frame_truth(tmp_path / "one" / FRAME_TRUTH_FILE)
    np.testing.assert_array_equal(back.exposed_ns, work.schedule.exposed_ns)
    np.testing.assert_array_equal(back.exposure_s, truth.exposure_s)
    assert len(np.unique(truth.exposure_s)) > 1


def test_frames_are_linked_to_those_of_another_recording(tmp_path: Path) -> None:
    twins = Rig((RigCamera(SMALL, np.eye(4)), RigCamera(SMALL, BASELINE)))
    work = job(rig=twins, schedule=job().schedule[:2])
    render_frames(work, tmp_path / "one", workers=1)
    link_frames(work, tmp_path / "one", tmp_path / "two")
    assert contents(tmp_path / "two") == contents(tmp_path / "one")
    images = sorted((tmp_path / "two").rglob("*.png"))
    assert len(images) == 4 and all(image.stat().st_nlink == 2 for image in images)


@pytest.mark.parametrize("changed", ["stamps_ns", "exposed_ns"])
def test_images_of_other_frames_are_not_linked(tmp_path: Path, changed: str) -> None:
    schedule = job().schedule[:2]
    render_frames(job(schedule=schedule), tmp_path / "one", workers=1)
    other = job(schedule=replace(schedule, **{changed: getattr(schedule, changed) + 1}))
    with pytest.raises(ConfigError, match="one has frames at other t"):
        link_frames(other, tmp_path / "one", tmp_path / "two")
    assert not (tmp_path / "two").exists()


def test_noise_differs_between_frames_and_cameras(tmp_path: Path) -> None:
    schedule = job().schedule
    twins = Rig((RigCamera(SMALL, np.eye(4)), RigCamera(SMALL, np.eye(4))))
    render_frames(job(rig=twins, trajectory=stationary(), schedule=schedule[:2]), tmp_path, workers=1)
    first, second = schedule.stamps_ns[:2].tolist()
    one = read(tmp_path, first).astype(float)
    for other in (read(tmp_path, second), read(tmp_path, first, 1)):
        difference = one - other
        assert 1.0 < difference.std() / np.sqrt(2.0) < 4.0
        assert abs(difference.mean()) < 0.05


def test_dark_frames_are_black_except_for_noise(tmp_path: Path) -> None:
    schedule = schedule_frames(job().schedule.stamps_ns, np.random.default_rng(0), dark_from_s=0.05, dark_for_s=0.05)
    render_frames(job(schedule=schedule[:3]), tmp_path, workers=1)
    means = [read(tmp_path, t).mean() for t in schedule.stamps_ns[:3].tolist()]
    assert means[1] < 1.0 and min(means[0], means[2]) > 50.0


def read_png(file: Path) -> np.ndarray:
    """Return an image as it is stored."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    assert image is not None
    return np.asarray(image)


def test_depth_segmentation_and_flow_are_consistent(tmp_path: Path) -> None:
    work = job(truth_images=("depth", "segmentation", "flow"))
    render_frames(work, tmp_path, workers=1)
    first, second, last = work.schedule.stamps_ns[[0, 1, -1]].tolist()
    depth, seg, flow = (read_png(tmp_path / folder / "data" / f"{first}.png") for folder in ("depth0", "seg0", "flow0"))
    assert depth.dtype == seg.dtype == flow.dtype == np.uint16
    assert depth.shape == seg.shape == (120, 188) and flow.shape == (120, 188, 3)
    names = (tmp_path / "seg0" / "names.csv").read_text().splitlines()
    assert len(names) == 201 and names[7].split(",") == ["7", "pillar_6"]
    assert (depth[seg == 0] == 0).all() and (depth[seg > 0] > 1000).all() and 0.2 < np.mean(seg > 0) < 1.0
    # The flow leads to the projection of the same point in the next frame, at its new depth.
    later = read_png(tmp_path / "depth0" / "data" / f"{second}.png")
    seen = flow[..., 0] == 1
    assert np.all(seg[seen] > 0) and seen.mean() > 0.3
    v, u = np.nonzero(seen)
    displacement = (flow[v, u][:, [2, 1]].astype(float) - 2**15) / 64.0
    p_cam = SMALL.normalize(np.stack([u, v], axis=-1))
    p_cam = np.concatenate([p_cam, np.ones((len(u), 1))], axis=-1) * depth[v, u][:, None] * 1e-3
    T_now, T_next = work.poses(0)(work.schedule.exposed_ns[:2])
    T_next_now = np.linalg.inv(T_next) @ T_now
    p_next = p_cam @ T_next_now[:3, :3].T + T_next_now[:3, 3]
    np.testing.assert_allclose(np.stack([u, v], axis=-1) + displacement, SMALL.project(p_next), atol=0.2)
    target = np.rint(np.stack([u, v], axis=-1) + displacement).astype(int)
    inside = np.all((target >= 0) & (target < [188, 120]), axis=-1)
    error = later[target[inside, 1], target[inside, 0]] * 1e-3 - p_next[inside, 2]
    assert np.median(np.abs(error)) < 0.02
    assert not (tmp_path / "flow0" / "data" / f"{last}.png").exists()
    assert (tmp_path / "depth0" / "data" / f"{last}.png").exists()


@pytest.mark.slow
def test_truth_images_are_independent_of_each_other(tmp_path: Path) -> None:
    render_frames(job(truth_images=("segmentation", "flow", "depth")), tmp_path / "all", workers=1)
    render_frames(job(truth_images=("depth", "flow")), tmp_path / "two", workers=1)
    both, two = (contents(tmp_path / name) for name in ("all", "two"))
    assert {name: both[name] for name in two} == two
    assert {name.split("/")[0] for name in set(both) - set(two)} == {"seg0"}


@pytest.mark.slow
def test_moving_bodies_are_rendered_at_the_exposure_time(tmp_path: Path, small_world: SimpleNamespace) -> None:
    glow = small_world.spec.add_material(name="lamp", emission=1.0, rgba=[1.0, 1.0, 1.0, 1.0])
    body = small_world.spec.worldbody.add_body(name="sphere", mocap=True)
    body.add_geom(name="lamp", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.03, 0.0, 0.0], material=glow.name)

    def poses(t_s: np.ndarray) -> np.ndarray:
        y = 0.3 - 3.0 * t_s  # to the right, 1.2 m in front of the first pose
        return pose_matrix(
            np.broadcast_to(np.eye(3), (len(t_s), 3, 3)), np.stack([0.7 + 0 * y, y, 1.2 + 0 * y], axis=1)
        )

    small_world.movers = (SimpleNamespace(body="sphere", poses=poses),)
    noiseless = Imaging(control=FixedExposure(0.02), nominal_exposure_s=0.02, read_sigma=0.0, shot_sigma=0.0)
    work = job(trajectory=stationary(), imaging=noiseless)
    render_frames(work, tmp_path / "moving", workers=1)
    small_world.movers = (SimpleNamespace(body="sphere", poses=lambda t_s: poses(0.0 * t_s - 100.0)),)
    render_frames(work, tmp_path / "gone", workers=1)
    for t_ns in work.schedule.stamps_ns.tolist()[1:4]:
        glowing = read(tmp_path / "moving", t_ns).astype(float) - read(tmp_path / "gone", t_ns)
        glowing = np.where(np.abs(glowing) > 4.0, glowing, 0.0)
        middle = SMALL.project((poses(np.array([t_ns - START_NS]) * 1e-9)[0, :3, 3] - [-0.5, 0.1, 1.2]) @ R_LEVEL)
        columns, rows = np.nonzero(glowing.any(axis=0))[0], np.nonzero(glowing.any(axis=1))[0]
        assert abs(np.mean([columns[0], columns[-1]]) - middle[0]) < 1.0
        assert abs(np.mean([rows[0], rows[-1]]) - middle[1]) < 1.0
        blur_px = 0.02 * 3.0 / 1.2 * SMALL.fx  # 5.75 px, in addition to the diameter of 5.75 px; its ends are faint
        assert abs(columns[-1] - columns[0] - blur_px - 5.75) < 3.0
        assert rows[-1] - rows[0] < 7.5


def test_an_interruption_leaves_complete_images_and_a_marker(tmp_path: Path) -> None:
    def interrupt(done: int, total: int) -> None:
        if done >= 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_frames(job(), tmp_path, interrupt, workers=2)
    files = sorted((tmp_path / "cam0" / "data").iterdir())
    assert 1 <= len(files) <= 6
    for file in files:
        assert file.suffix == ".png"
        assert read_png(file).shape == (120, 188)
    assert (tmp_path / INCOMPLETE).exists()


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full, which is a full disk")
def test_a_full_disk_leaves_a_readable_recording(tmp_path: Path) -> None:
    stereo = Rig((RigCamera(SMALL, np.eye(4)), RigCamera(SMALL, BASELINE)))
    work, mav0 = job(rig=stereo), tmp_path / "mav0"
    stamps = work.schedule.stamps_ns
    rest = ImuSamples(work.trajectory.t_ns, np.zeros((60, 3)), np.zeros((60, 3)), "point")
    write_euroc(tmp_path, stereo, rest, work.trajectory, stamps)
    (mav0 / "cam1" / "data" / f"{stamps[3]}.partial").symlink_to("/dev/full")
    with pytest.raises(IncompleteError, match=r"after 3 of 6 frames: No space left on device$"):
        render_frames(work, mav0, workers=1)
    recording = EurocRecording.open(tmp_path)
    assert not recording.complete
    np.testing.assert_array_equal(recording.frame_times_ns, stamps[:3])
    assert [image.shape for image in recording.frame(2).images] == [(120, 188)] * 2
    assert not list(mav0.rglob("*.partial"))


def test_a_worker_that_is_killed_is_reported(tmp_path: Path) -> None:
    def kill(done: int, total: int) -> None:
        if done:
            for process in psutil.Process().children():
                with suppress(psutil.NoSuchProcess):  # it has ended already
                    if "worker_pool" in " ".join(process.cmdline()):  # not the resource tracker of multiprocessing
                        process.kill()

    stamps_ns = job().trajectory.t_ns
    many = job(schedule=FrameSchedule(stamps_ns, stamps_ns, np.ones(60, dtype=bool)))
    with pytest.raises(IncompleteError, match=r"of 60 frames: a rendering process was killed by SIGKILL") as end:
        render_frames(many, tmp_path, kill, workers=1)
    assert isinstance(end.value.__cause__, DefectError)  # exit code 70
    assert (tmp_path / INCOMPLETE).exists()


def test_invalid_jobs_are_refused() -> None:
    with pytest.raises(ConfigError, match="without a camera"):
        job(rig=Rig(()))
    with pytest.raises(ConfigError, match="no frame"):
        job(schedule=job().schedule[:0])
    with pytest.raises(ConfigError, match=r"0\.06 s; expected at most 0\.05 s"):
        job(imaging=Imaging(control=AutoExposure(longest_s=0.06)))


def test_a_worker_that_fails_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("MUJOCO_GL", "osmosis")
    with pytest.raises(GraphicsError, match="osmosis"):
        render_frames(job(), tmp_path, workers=1)
