import os

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before NumPy is imported: threads that spin make small systems slower
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("DRONEVIO_WORLD_FILES", "0")  # tests neither depend on files of earlier runs nor leave any

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.models.actions import ActionLimits
from dronevio.models.camera import CameraModel
from dronevio.models.imu import ImuSamples, Sampling, Times
from dronevio.models.policies import Layer, NamedShape, Network, Policy, Provenance, Scaling
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.rig import Rig
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import CameraFrame, Trajectory
from tests.browser import PROGRAMS, Browser, chromium

SCRIPTS = [Path(__file__).resolve().parents[1] / folder for folder in ("benchmarks", "tools")]


@pytest.fixture(scope="session")
def script() -> Callable[[str], Any]:
    """Gives a module of benchmarks or tools by name; they belong to no package, and import each other by name."""

    def load(name: str) -> Any:
        folder = next((folder for folder in SCRIPTS if (folder / f"{name}.py").exists()), None)
        if folder is None:
            pytest.skip("benchmarks and tools are in the repository, not in the package")
        with pytest.MonkeyPatch.context() as patch:
            patch.syspath_prepend(folder)
            return importlib.import_module(name)

    return load


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of public data sets that the project does not carry; tests that need it are skipped where it is not."""
    folder = os.environ.get("DRONEVIO_DATA")
    if not folder:
        pytest.skip("DRONEVIO_DATA is not set: it names a folder of public data sets")
    return Path(folder)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    """A page in headless Chromium."""
    program = chromium()
    if program is None:
        pytest.skip(f"no browser is installed: none of {', '.join(PROGRAMS)}")
    opened = Browser(program, tmp_path_factory.mktemp("browser"))
    yield opened
    opened.close()


@dataclass(frozen=True, eq=False)
class NoiseRecording:
    """A recording of noise, in memory: what counts is that it comes back."""

    name: str
    rig: Rig
    imu: ImuSamples
    frame_times_ns: Times
    ground_truth: Trajectory | None
    frame_truth: FrameTruth | None
    complete: bool = True

    def frame(self, index: int) -> CameraFrame:
        def image(number: int, model: CameraModel) -> np.ndarray:
            rng = np.random.default_rng([index, number])
            return rng.integers(0, 256, (model.height, model.width), dtype=np.uint8)

        images = tuple(image(number, camera.model) for number, camera in enumerate(self.rig.cameras))
        return CameraFrame(int(self.frame_times_ns[index]), images)


@pytest.fixture(scope="session")
def noise_recording() -> Callable[..., NoiseRecording]:
    """Makes recordings of noise, with a named rig whose images are small."""

    def make(rig: str = "euroc-stereo", frames: int = 4, sampling: Sampling = "point") -> NoiseRecording:
        rng = np.random.default_rng(frames)
        named = rig_named(rig)
        cameras = tuple(replace(c, model=replace(c.model, width=32, height=24)) for c in named.cameras)
        t_ns = 1403715273262142976 + 5_000_000 * np.arange(10 * frames)
        quat_wxyz = rng.normal(size=(len(t_ns), 4))
        quat_wxyz /= np.linalg.norm(quat_wxyz, axis=1, keepdims=True)
        gyro, accel, p, v, b_gyro, b_accel = rng.normal(size=(6, len(t_ns), 3))
        times = t_ns[3::10]
        frame_truth = FrameTruth(
            times,
            times + rng.integers(-(10**6), 10**6, frames),
            rng.random(frames),
            rng.random(frames),
            rng.random(frames) > 0.5,
        )
        truth = Trajectory(t_ns, p, quat_wxyz, v, b_gyro, b_accel)
        whole = replace(named, cameras=cameras, time_offset_s=-1e-3 / 7)
        return NoiseRecording("noise", whole, ImuSamples(t_ns, gyro, accel, sampling), times, truth, frame_truth)

    return make


@pytest.fixture(scope="session")
def assert_same_recording() -> Callable[..., None]:
    """Compares two recordings to the bit, all but their names."""

    def same(ours: NoiseRecording, theirs: NoiseRecording, order: tuple[int, ...] | None = None) -> None:
        assert_same_arrays(ours.imu, theirs.imu, ("t_ns", "gyro_rad_s", "accel_m_s2"))
        assert ours.imu.sampling == theirs.imu.sampling
        poses = ("t_ns", "p_world_imu", "quat_wxyz", "velocity_m_s", "gyro_bias_rad_s", "accel_bias_m_s2")
        assert_same_arrays(ours.ground_truth, theirs.ground_truth, poses)
        assert_same_arrays(ours.frame_truth, theirs.frame_truth, ("t_ns", "exposed_ns", "exposure_s", "gain", "lit"))
        assert ours.rig.imu == theirs.rig.imu and ours.rig.time_offset_s == theirs.rig.time_offset_s
        np.testing.assert_array_equal(ours.rig.T_vehicle_imu, theirs.rig.T_vehicle_imu)
        for a, b in zip(ours.rig.cameras, theirs.rig.cameras, strict=True):
            assert (a.model, a.rate_hz, a.readout_s) == (b.model, b.rate_hz, b.readout_s)
            np.testing.assert_array_equal(a.T_imu_cam, b.T_imu_cam)
        np.testing.assert_array_equal(ours.frame_times_ns, theirs.frame_times_ns)
        for index in order or range(len(ours.frame_times_ns)):
            frame, other = ours.frame(index), theirs.frame(index)
            assert frame.t_ns == other.t_ns
            for left, right in zip(frame.images, other.images, strict=True):
                np.testing.assert_array_equal(left, right)

    return same


def assert_same_arrays(ours: object, theirs: object, names: tuple[str, ...]) -> None:
    if ours is None or theirs is None:
        assert ours is theirs
        return
    for name in names:
        a, b = getattr(ours, name), getattr(theirs, name)
        assert (a is None) == (b is None), name
        if a is not None:
            np.testing.assert_array_equal(a, b, err_msg=name)
            assert a.dtype == b.dtype


@pytest.fixture(scope="session")
def hovering_policy() -> Policy:
    """A linear controller as a policy: it hovers at the goal of the task Hover by thrust and body rates."""
    weight = np.zeros((4, 15))
    position, tilt_x, tilt_y, velocity = 0, 3 + 2, 3 + 5, 12  # columns; the tilt is the vehicle's z axis in the world
    weight[0, [position + 2, velocity + 2]] = -0.8, -0.6  # thrust
    weight[2, [position, velocity, tilt_x]] = np.array([-0.25, -0.25, -1.0])  # rate about y
    weight[1, [position + 1, velocity + 1, tilt_y]] = np.array([0.25, 0.25, 1.0])  # rate about x
    layer = Layer(weight.astype(np.float32), np.zeros(4, np.float32))
    return Policy(
        environment="dronevio/Hover-v0",
        vehicle="research",
        inputs=(NamedShape("position", (3,)), NamedShape("rotation", (3, 3)), NamedShape("velocity", (3,))),
        scaling=Scaling.identity(15),
        network=Network((layer,), "tanh"),
        action_mode="rates",
        action_limits=ActionLimits(),
        action_rate_hz=50.0,
        imu_rate_hz=200.0,
        provenance=Provenance("linear controller", 0, 0),
    )
