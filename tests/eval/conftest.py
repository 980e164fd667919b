"""A flight made of formulas: a smooth path in a room, textured images, tracks of landmarks, a drifting estimate."""

import base64
import json
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, replace
from html.parser import HTMLParser
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from dronevio.eval.run import EstimatorRun
from dronevio.models.camera import CameraModel
from dronevio.models.imu import ImuSamples
from dronevio.models.rig import EUROC_T_IMU_CAM0, Rig, RigCamera
from dronevio.models.rotation import exp_so3, inverse_pose, pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import CameraFrame, Estimate, FeatureTracks, Health, NavState, Trajectory

ROOM_HALF_M = np.array([3.0, 2.5])
ROOM_HEIGHT_M = 3.0


@dataclass(frozen=True, eq=False)
class SyntheticRecording:
    """Implements the Recording protocol."""

    name: str
    rig: Rig
    imu: ImuSamples
    frame_times_ns: npt.NDArray[np.int64]
    ground_truth: Trajectory | None
    texture: npt.NDArray[np.uint8]

    def frame(self, index: int) -> CameraFrame:
        """Cut a moving window out of the texture, and add noise of the frame's own."""
        model = self.rig.cameras[0].model
        span = np.array(self.texture.shape) - [model.height, model.width]
        row, column = (span * (0.5 + 0.5 * np.sin(0.05 * index + np.array([0.0, 1.0])))).astype(int)
        window = self.texture[row : row + model.height, column : column + model.width]
        noise = np.random.default_rng(index).normal(0.0, 2.0, window.shape)
        return CameraFrame(int(self.frame_times_ns[index]), (np.clip(window + noise, 0, 255).astype(np.uint8),))


@dataclass(frozen=True, eq=False)
class SyntheticFlight:
    """A recording, what an estimator made of it, and the room around it."""

    recording: SyntheticRecording
    run: EstimatorRun
    outline: npt.NDArray[np.float64]


def make_flight(duration_s: float = 6.0, size: tuple[int, int] = (376, 240), seed: int = 0) -> SyntheticFlight:
    """Make a flight at 200 Hz IMU and 20 Hz camera; the estimate starts 0.5 s after the first frame."""
    rng = np.random.default_rng(seed)
    width, height = size
    scale = width / 752
    model = CameraModel(width, height, 458.0 * scale, 457.0 * scale, (width - 1) / 2, (height - 1) / 2)
    rig = Rig(cameras=(RigCamera(model, EUROC_T_IMU_CAM0),))
    truth = _truth(np.arange(0, int(duration_s * 200) + 1) * 5_000_000, rng)
    frame_times_ns = truth.t_ns[::10]
    texture = cv2.resize(rng.integers(0, 256, (60, 100), dtype=np.uint8), (width * 3, height * 3), interpolation=2)
    imu = ImuSamples(
        truth.t_ns, rng.normal(0.0, 0.5, (len(truth), 3)), rng.normal(0, 1, (len(truth), 3)) + [9.81, 0, 0]
    )
    recording = SyntheticRecording("synthetic", rig, imu, frame_times_ns, truth, texture)
    estimates = _estimates(truth[::10], rig, rng)
    cpu_ms = rng.uniform(5.0, 15.0, len(estimates))
    return SyntheticFlight(recording, EstimatorRun(estimates, cpu_ms, cpu_ms * 1.1), _outline())


def _truth(t_ns: npt.NDArray[np.int64], rng: np.random.Generator) -> Trajectory:
    """Fly a Lissajous figure, the camera along the motion; EuRoC's IMU has x up and z forward."""
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
    """Turn and shift the truth into an odometry frame, let it drift, and follow random landmarks."""
    camera = rig.cameras[0]
    landmarks = rng.uniform([-3.0, -2.5, 0.0], [6.0, 2.5, 3.0], (400, 3))
    T_odom_world = pose_matrix(exp_so3(np.array([0.0, 0.0, 1.1])), np.array([1.0, -2.0, 0.3]))
    drift_m = 0.03 * np.stack([np.sin(0.4 * truth.t_s), 0.5 * truth.t_s / 6.0, np.cos(0.5 * truth.t_s)], axis=1)
    first_seen = np.full(len(landmarks), -1)
    estimates = []
    for i, T_world_imu in enumerate(truth.Ts_world_imu):
        t_ns = int(truth.t_ns[i])
        T_cam_world = inverse_pose(T_world_imu @ camera.T_imu_cam)
        pixels = camera.model.project(landmarks @ T_cam_world[:3, :3].T + T_cam_world[:3, 3])
        seen = np.all((pixels >= 0) & (pixels <= [camera.model.width - 1, camera.model.height - 1]), axis=1)
        first_seen[~seen] = -1
        first_seen[seen & (first_seen < 0)] = i
        ids = np.flatnonzero(seen)
        tracks = FeatureTracks(ids.astype(np.int64), pixels[ids], (i - first_seen[ids] + 1).astype(np.int64))
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
        on_map = landmarks[ids] @ T_odom_world[:3, :3].T + T_odom_world[:3, 3] if i % 5 == 0 else None
        events = ("initialized",) if i == 10 else ("keyframe",) if i % 5 == 0 else ()
        estimates.append(Estimate(t_ns, Health.TRACKING, state, tracks, on_map, events))
    return tuple(estimates)


def _outline() -> npt.NDArray[np.float64]:
    """Return the twelve edges of the room (12, 2, 3) [m]."""
    (x, y), z = ROOM_HALF_M, ROOM_HEIGHT_M
    floor = np.array([[-x, -y, 0.0], [x, -y, 0.0], [x, y, 0.0], [-x, y, 0.0]])
    ceiling = floor + [0.0, 0.0, z]
    around = [np.stack([ring, np.roll(ring, -1, axis=0)], axis=1) for ring in (floor, ceiling)]
    return np.concatenate([*around, np.stack([floor, ceiling], axis=1)])


@pytest.fixture(scope="session")
def flight() -> SyntheticFlight:
    """Six seconds of synthetic flight."""
    return make_flight()


@pytest.fixture(scope="session")
def flight_without_truth(flight: SyntheticFlight) -> SyntheticFlight:
    """The same, where nobody knows the truth."""
    return replace(flight, recording=replace(flight.recording, ground_truth=None))


VOID = {"meta", "br", "img", "link", "input", "hr"}


class Page(HTMLParser):
    """Collects a page's text, elements, links and alternative texts, and checks that elements are closed in order."""

    def __init__(self, html: str) -> None:
        super().__init__()
        self.text: list[str] = []
        self.tags: list[str] = []
        self.links: list[str | None] = []
        self.alts: list[str | None] = []
        self._open: list[str] = []
        self.feed(html)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what begins."""
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Note what stands there."""
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name in ("href", "src", "xlink:href", "data", "srcset")]
        self.alts += [dict(attrs).get("aria-label")] if tag == "svg" else []

    def handle_endtag(self, tag: str) -> None:
        """Check that what ends is what was begun last."""
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        """Keep the text."""
        self.text.append(data)


@pytest.fixture(scope="session")
def read_page() -> Callable[[str], Page]:
    """Reads HTML, and fails where it is not well formed."""
    return Page


@pytest.fixture
def browse(tmp_path: Path) -> Callable[[Path, int, str], Any]:
    """Opens a page in a browser of a given width and returns what an expression says there; `r` is its root."""
    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser is None:
        pytest.skip("no chromium to look at the report with")

    def look(page: Path, width: int, expression: str) -> Any:
        # A frame of that width, because a headless window has a least width of its own.
        probe = tmp_path / "probe.html"
        probe.write_text(
            f'<iframe id="f" src="{page.as_uri()}" width="{width}" height="900" style="border:0"></iframe>'
            "<script>onload = () => { const page = document.getElementById('f').contentDocument;"
            " const said = ((document, r) => JSON.stringify(" + expression + "))(page, page.documentElement);"
            " document.body.append(`said ${btoa(unescape(encodeURIComponent(said)))} so`) }</script>"
        )
        flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files", "--dump-dom"]
        command = [browser, *flags, f"--user-data-dir={tmp_path}/profile", probe.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
        found = re.search(r"said (\S+) so</body>", done.stdout)
        assert found, done.stdout[-500:] + done.stderr[-500:]
        return json.loads(base64.b64decode(found[1]))

    return look


@pytest.fixture(scope="session")
def read_rrd() -> Callable[[Path], dict[str, dict[str, Any]]]:
    """Reads a rerun file: the columns of each entity, the rows of all chunks together; times under "time"."""

    def read(path: Path) -> dict[str, dict[str, Any]]:
        columns: dict[str, dict[str, list[Any]]] = {}
        for chunk in RrdReader(path).stream():
            batch = chunk.to_record_batch()
            assert set(chunk.timeline_names) <= {"time"}, chunk.entity_path
            for name, values in zip(batch.schema.names, batch.columns, strict=True):
                if not name.startswith("rerun"):
                    columns.setdefault(chunk.entity_path.strip("/"), {}).setdefault(name, []).append(values)
        return {
            entity: {name.split(":")[-1]: pa.concat_arrays(parts) for name, parts in entity_columns.items()}
            for entity, entity_columns in columns.items()
        }

    return read


@pytest.fixture(scope="session")
def verify_rrd() -> Callable[[Path], None]:
    """Checks a rerun file with rerun's own tool."""
    rerun = str(Path(find_spec("rerun_cli").origin).with_name("rerun"))

    def verify(path: Path) -> None:
        done = subprocess.run([rerun, "rrd", "verify", str(path)], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr

    return verify
