"""Fixtures of the evaluation tests: an analytic flight, a reconstruction; readers of HTML and rerun files."""

import subprocess
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path

import av
import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from dronevio.eval.run import EstimatorRun
from dronevio.models.camera import CameraModel
from dronevio.models.imu import ImuSamples
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.slam_map import SlamMap
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, NavState, Trajectory

ROOM_HALF_M = np.array([3.0, 2.5])
ROOM_HEIGHT_M = 3.0

EntityColumns = dict[str, dict[str, pa.Array]]
"""Columns of each entity of a rerun file, by component name; the times are the column "time" or "image"."""
ReadRrd = Callable[[Path], EntityColumns]
"""Function that reads a rerun file."""
VerifyRrd = Callable[[Path], None]
"""Function that fails if a rerun file is invalid."""
DecodeAv1 = Callable[[Iterable[bytes]], list[npt.NDArray[np.uint8]]]
"""Function that decodes AV1 temporal units into grey images (H, W)."""


@dataclass(frozen=True, eq=False)
class SyntheticRecording:
    """A recording in memory, which implements the Recording protocol."""

    name: str
    rig: Rig
    imu: ImuSamples
    frame_times_ns: npt.NDArray[np.int64]
    ground_truth: Trajectory | None
    texture: npt.NDArray[np.uint8]

    def frame(self, index: int) -> CameraFrame:
        """Return a window of the texture that moves from frame to frame, with noise that depends on the frame."""
        model = self.rig.cameras[0].model
        span = np.array(self.texture.shape) - [model.height, model.width]
        row, column = (span * (0.5 + 0.5 * np.sin(0.05 * index + np.array([0.0, 1.0])))).astype(int)
        window = self.texture[row : row + model.height, column : column + model.width]
        noise = np.random.default_rng(index).normal(0.0, 2.0, window.shape)
        return CameraFrame(int(self.frame_times_ns[index]), (np.clip(window + noise, 0, 255).astype(np.uint8),))


@dataclass(frozen=True, eq=False)
class SyntheticFlight:
    """A recording, the true trajectory behind it, the run of an estimator, and the room."""

    recording: SyntheticRecording
    truth: Trajectory
    """True trajectory, also of a recording without ground truth."""
    run: EstimatorRun
    outline: npt.NDArray[np.float64]
    """(L, 2, 3) Edges of the room in the world frame [m]."""


def make_flight(duration_s: float = 6.0, size: tuple[int, int] = (376, 240), seed: int = 0) -> SyntheticFlight:
    """Return a flight with an IMU at 200 Hz and a camera at 20 Hz; the estimate starts 0.5 s after the first frame."""
    rng = np.random.default_rng(seed)
    width, height = size
    scale = width / 752
    model = CameraModel(width, height, 458.0 * scale, 457.0 * scale, (width - 1) / 2, (height - 1) / 2)
    rig = Rig(cameras=(RigCamera(model, EUROC_T_IMU_CAM0),))
    truth = _truth(np.arange(0, int(duration_s * 200) + 1) * 5_000_000, rng)
    frame_times_ns = truth.t_ns[::10]
    coarse = rng.integers(0, 256, (60, 100), dtype=np.uint8)
    texture = np.asarray(cv2.resize(coarse, (width * 3, height * 3), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    imu = ImuSamples(
        truth.t_ns, rng.normal(0.0, 0.5, (len(truth), 3)), rng.normal(0, 1, (len(truth), 3)) + [9.81, 0, 0]
    )
    recording = SyntheticRecording("synthetic", rig, imu, frame_times_ns, truth, texture)
    estimates = _estimates(truth[::10], rig, rng)
    cpu_ms = rng.uniform(5.0, 15.0, len(estimates))
    return SyntheticFlight(recording, truth, EstimatorRun(estimates, cpu_ms, cpu_ms * 1.1), _outline())


def _truth(t_ns: npt.NDArray[np.int64], rng: np.random.Generator) -> Trajectory:
    """Return a Lissajous path whose camera looks forward; the x axis of EuRoC's IMU is up, its z axis forward."""
    t = t_ns * 1e-9
    ramp = np.clip((t - 0.5) / 2.0, 0.0, 1.0) ** 2
    phase = 0.9 * t
    p = (
        np.stack([2.0 * np.sin(phase), 1.5 * np.sin(2.0 * phase), 1.0 + 0.5 * np.sin(0.7 * phase)], axis=1)
        * ramp[:, None]
    )
    velocity = np.gradient(p, t, axis=0)
    yaw = 0.5 * np.sin(0.6 * t)
    R_world_level = exp_so3(np.stack([0 * yaw, 0 * yaw, yaw], axis=1))
    R_vehicle_imu = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
    R = R_world_level @ exp_so3(np.stack([0.1 * np.sin(t), 0.1 * np.cos(t), 0 * t], axis=1)) @ R_vehicle_imu
    walk = np.cumsum(rng.normal(0.0, 1.0, (len(t), 3)), axis=0)
    return Trajectory(t_ns, p, quat_wxyz_from_matrix(R), velocity, 0.01 + 1e-5 * walk, 0.05 + 1e-4 * walk)


def _estimates(truth: Trajectory, rig: Rig, rng: np.random.Generator) -> tuple[Estimate, ...]:
    """Return the truth in a rotated and shifted odometry frame, with drift and tracks of random landmarks."""
    assert truth.velocity_m_s is not None
    assert truth.gyro_bias_rad_s is not None and truth.accel_bias_m_s2 is not None
    camera = rig.cameras[0]
    landmarks = rng.uniform([-3.0, -2.5, 0.0], [6.0, 2.5, 3.0], (400, 3))
    T_odom_world = pose_matrix(exp_so3(np.array([0.0, 0.0, 1.1])), np.array([1.0, -2.0, 0.3]))
    drift_m = 0.03 * np.stack([np.sin(0.4 * truth.t_s), 0.5 * truth.t_s / 6.0, np.cos(0.5 * truth.t_s)], axis=1)
    first_visible = np.full(len(landmarks), -1)
    estimates = []
    for i, T_world_imu in enumerate(truth.Ts_world_imu):
        t_ns = int(truth.t_ns[i])
        T_cam_world = inverse_pose(T_world_imu @ camera.T_imu_cam)
        pixels = camera.model.project(landmarks @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        visible = np.all((pixels >= 0) & (pixels <= [camera.model.width - 1, camera.model.height - 1]), axis=1)
        first_visible[~visible] = -1
        first_visible[visible & (first_visible < 0)] = i
        ids = np.flatnonzero(visible)
        tracks = FeatureTracks(ids.astype(np.int64), pixels[ids], (i - first_visible[ids] + 1).astype(np.int64))
        if i < 10:
            estimates.append(Estimate(t_ns, Health.INITIALIZING, None, tracks))
            continue
        T = T_odom_world @ T_world_imu
        T[:3, 3] += drift_m[i] - drift_m[10]
        age_s = (i - 10) * 0.05
        sigmas = np.repeat([1e-3 + 1e-4 * age_s, 5e-3 + 8e-3 * age_s, 1e-2, 1e-3, 1e-2], 3)
        state = NavState(
            t_ns,
            T,
            T_odom_world[:3, :3] @ truth.velocity_m_s[i],
            truth.gyro_bias_rad_s[i] + 1e-3,
            truth.accel_bias_m_s2[i] + 1e-2,
            np.diag(sigmas**2),
        )
        landmarks_odom = landmarks[ids] @ T_odom_world[:3, :3].T + T_odom_world[:3, 3] if i % 5 == 0 else None
        events = ("initialized",) if i == 10 else ("keyframe",) if i % 5 == 0 else ()
        estimates.append(Estimate(t_ns, Health.TRACKING, state, tracks, landmarks_odom, events))
    return tuple(estimates)


def _outline() -> npt.NDArray[np.float64]:
    """Return the twelve edges of the room (12, 2, 3) [m]."""
    (x, y), z = ROOM_HALF_M, ROOM_HEIGHT_M
    floor = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    ceiling = floor + [0.0, 0.0, z]
    horizontal = [np.stack([corners, np.roll(corners, -1, axis=0)], axis=1) for corners in (floor, ceiling)]
    return np.concatenate([*horizontal, np.stack([floor, ceiling], axis=1)])


@pytest.fixture(scope="session")
def flight() -> SyntheticFlight:
    """Return a synthetic flight of six seconds."""
    return make_flight()


@pytest.fixture(scope="session")
def flight_without_truth(flight: SyntheticFlight) -> SyntheticFlight:
    """Return the same flight as a recording without ground truth."""
    return replace(flight, recording=replace(flight.recording, ground_truth=None))


@pytest.fixture(scope="session")
def mapped(flight: SyntheticFlight) -> SyntheticFlight:
    """Return the flight with a map of its true poses, which corrects the odometry at each tenth frame from the 80th on.

    Two loops are closed at the 80th frame, one at the 90th, and one is rejected.
    """
    estimates = list(flight.run.estimates)
    keyframes = [estimates[i] for i in range(10, len(estimates), 10)]
    Ts_odom = np.stack([e.state.T_world_imu for e in keyframes if e.state is not None])
    T_map_world = Ts_odom[0] @ inverse_pose(flight.truth.Ts_world_imu[100])
    Ts_map = T_map_world @ flight.truth.Ts_world_imu[100::100]
    for i in range(10, len(estimates)):
        row = i // 10 - 1
        T_map_odom = Ts_map[row] @ inverse_pose(Ts_odom[row]) if i >= 80 else np.eye(4)
        loops = {80: ((10, 70), (20, 70)), 90: ((30, 80),)}.get(i, ())
        times = tuple((estimates[then].t_ns, estimates[now].t_ns) for then, now in loops)
        estimates[i] = replace(estimates[i], T_map_odom=T_map_odom, closed_loops_ns=times)
    rows = np.array([[0, 6], [1, 6], [2, 7], [3, 8]])
    slam_map = SlamMap(
        np.array([e.t_ns for e in keyframes], dtype=np.int64),
        Ts_map,
        Ts_odom,
        rows,
        inverse_pose(Ts_map[rows[:, 0]]) @ Ts_map[rows[:, 1]],
        np.array([False, False, False, True]),
        np.random.default_rng(0).uniform(-2.0, 2.0, (300, 3)),
        track=np.zeros(len(keyframes), np.int64),
        starts_ns=np.array([-1]),
    )
    return replace(flight, run=replace(flight.run, estimates=tuple(estimates), map=slam_map))


@dataclass(frozen=True, eq=False)
class SyntheticReconstruction:
    """A reconstruction of a wall and the floor before it, with its photographs and the true camera positions."""

    reconstruction: Reconstruction
    """Reconstruction in a rotated world frame of another scale, with noise of 0.3 px."""
    up: npt.NDArray[np.float64]
    """(3,) Up direction in the world frame of the reconstruction."""
    images: dict[str, npt.NDArray[np.uint8]]
    """Photograph (H, W, 3) of each image name."""
    true_positions_m: dict[str, npt.NDArray[np.float64]]
    """True position (3,) of each camera by image name, in a frame with z up [m]."""


def make_reconstruction(images: int = 12, points: int = 400, seed: int = 0) -> SyntheticReconstruction:
    """Return level cameras on an arc of 6 m around a wall, which they look at from the side of negative y."""
    rng = np.random.default_rng(seed)
    camera = CameraModel(376, 240, 230.0, 229.0, 187.5, 119.5, (-0.05, 0.01, 0.0, 0.0))
    wall = rng.uniform([-3.0, 0.0, 0.0], [3.0, 0.0, 2.5], (points // 2, 3))
    floor = rng.uniform([-3.0, -2.0, 0.0], [3.0, 0.0, 0.0], (points - points // 2, 3))
    p_true = np.concatenate([wall, floor])
    colours = rng.integers(40, 256, (points, 3), dtype=np.uint8)
    angle = np.linspace(-0.7, 0.7, images)
    position = np.stack([6.0 * np.sin(angle), -6.0 * np.cos(angle), 1.5 + 0.3 * np.sin(5.0 * angle)], axis=1)
    right = np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], axis=1)
    forward = np.stack([-np.sin(angle), np.cos(angle), 0.0 * angle], axis=1)
    down = np.tile([0.0, 0.0, -1.0], (images, 1))
    Ts = pose_matrix(np.stack([right, down, forward], axis=2), position)
    names = tuple(f"photos/{i:03d}.jpg" for i in range(images))
    rows = []
    for i, T in enumerate(inverse_pose(Ts)):
        pixels = camera.project(p_true @ T[:3, :3].T + T[:3, 3]) + rng.normal(0.0, 0.3, (points, 2))
        inside = np.all((pixels >= 0.0) & (pixels <= [camera.width - 1, camera.height - 1]), axis=1)
        rows += [(i, k, *pixels[k]) for k in np.flatnonzero(inside)]
    table = np.array(rows)
    world = Reconstruction(
        cameras=(camera,),
        image_names=names,
        image_camera=np.zeros(images, np.int64),
        Ts_world_cam=Ts,
        points=p_true,
        colours=colours,
        observation_image=table[:, 0].astype(np.int64),
        observation_point=table[:, 1].astype(np.int64),
        observation_px=table[:, 2:],
    )
    R = exp_so3(np.array([0.4, -1.1, 0.7]))
    photographs = {name: _photograph(world, i) for i, name in enumerate(names)}
    true_positions_m = dict(zip(names, position, strict=True))
    transformed = world.transformed(0.2, R, np.array([1.0, 2.0, -3.0]))
    return SyntheticReconstruction(transformed, R[:, 2], photographs, true_positions_m)


def _photograph(world: Reconstruction, index: int) -> npt.NDArray[np.uint8]:
    """Return an image with a disc in the colour of each observed point."""
    camera = world.cameras[0]
    image = np.full((camera.height, camera.width, 3), 90, np.uint8)
    seen = world.observation_image == index
    for (x, y), point in zip(world.observation_px[seen], world.observation_point[seen], strict=True):
        cv2.circle(image, (round(x), round(y)), 2, world.colours[point].tolist(), cv2.FILLED)
    return image


@pytest.fixture(scope="session")
def synthetic() -> SyntheticReconstruction:
    """Return a synthetic reconstruction of 400 points from twelve photographs."""
    return make_reconstruction()


VOID_ELEMENTS = {"meta", "br", "img", "link", "input", "hr"}


class Page(HTMLParser):
    """Collects the text, elements, links and alternative texts of a page, and checks that elements are nested."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.links: list[str] = []
        self.alts: list[str] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Add an element and mark it as open."""
        self.handle_startendtag(tag, attrs)
        if tag not in VOID_ELEMENTS:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Add an element with its links and its alternative text."""
        self.tags.append(tag)
        self.links += [value or "" for name, value in attrs if name in ("href", "src", "xlink:href", "data", "srcset")]
        self.alts += [dict(attrs).get("aria-label") or ""] if tag == "svg" else []

    def handle_endtag(self, tag: str) -> None:
        """Check that the element is the one that was opened last."""
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Add text."""
        self.text.append(data)


ReadPage = Callable[[str], Page]
"""Function that parses HTML and fails if it is not well formed."""


@pytest.fixture(scope="session")
def read_page() -> ReadPage:
    """Return a parser of HTML that fails if the elements are not nested."""
    return Page


@pytest.fixture(scope="session")
def read_rrd() -> ReadRrd:
    """Return a reader of rerun files, which concatenates the rows of all chunks of an entity."""

    def read(path: Path) -> EntityColumns:
        columns: dict[str, dict[str, list[pa.Array]]] = {}
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            assert set(chunk.timeline_names) <= {"time", "image"}, chunk.entity_path
            for name, values in zip(batch.schema.names, batch.columns, strict=True):
                if not name.startswith("rerun"):
                    columns.setdefault(chunk.entity_path.strip("/"), {}).setdefault(name, []).append(values)
        return {
            entity: {name.split(":")[-1]: pa.concat_arrays(parts) for name, parts in entity_columns.items()}
            for entity, entity_columns in columns.items()
        }

    return read


@pytest.fixture(scope="session")
def decode_av1() -> DecodeAv1:
    """Return a decoder of AV1 by dav1d."""

    def decode(samples: Iterable[bytes]) -> list[npt.NDArray[np.uint8]]:
        decoder = av.CodecContext.create("libdav1d", "r")
        assert isinstance(decoder, av.VideoCodecContext)
        packets = [av.Packet(sample) for sample in samples]
        frames = [frame for packet in [*packets, None] for frame in decoder.decode(packet)]
        return [np.asarray(frame.to_ndarray(format="gray"), dtype=np.uint8) for frame in frames]

    return decode


@pytest.fixture(scope="session")
def rerun_program() -> str:
    """Return the path of the rerun executable."""
    spec = find_spec("rerun_cli")
    assert spec is not None and spec.origin is not None
    return str(Path(spec.origin).with_name("rerun"))


@pytest.fixture(scope="session")
def verify_rrd(rerun_program: str) -> VerifyRrd:
    """Return a check of rerun files by `rerun rrd verify`."""

    def verify(path: Path) -> None:
        done = subprocess.run([rerun_program, "rrd", "verify", str(path)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    return verify
