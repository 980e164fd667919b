"""Frames of a flight, drawn in parallel processes once the physics are done.

Drawing is the whole cost of a simulated flight, and every frame is independent of the others. So a few processes share
them, each with its own OpenGL; what a frame shows depends on the seed and its index alone, never on who drew it.
"""

import os
import pickle
import selectors
import signal
import subprocess
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError, DronevioError, GraphicsError
from dronevio.models.imu import Times
from dronevio.models.progress import Progress, silent
from dronevio.sim.camera import ImageNoise, OffscreenCamera
from dronevio.sim.scenario import Scenario
from dronevio.sim.world import build_world

Array = npt.NDArray[np.float64]

_NOISE_STREAM = 20  # beside those of `dronevio.sim.scenario` and `dronevio.sim.world`
_MOST_WORKERS = 4  # each holds the world's textures, some 350 MB
_FRAMES_WORTH_A_WORKER = 15  # it takes a second to start
_PNG_COMPRESSION = 1  # noise hardly compresses, so do not try for long
_PARTIAL = ".partial"
_WORKER = "from dronevio.sim.render import work; work()"
_KNOWN_ERROR = 3  # exit code of a worker whose last line on stderr is meant for the user


@dataclass(frozen=True, eq=False)
class _Share:
    """What one worker draws."""

    model_path: Path
    """The world, compiled."""
    camera: CameraModel
    """What looks at it."""
    noise: ImageNoise
    """What the sensor adds."""
    seed: int
    """What the noise is drawn from."""
    indices: npt.NDArray[np.int64]
    """(K,) The frames' places in the flight."""
    times_ns: Times
    """(K,) The frames' time stamps, which name the files."""
    Ts_world_cam: Array
    """(K, 4, 4) Where the camera was."""
    folder: Path
    """Where the images go."""

    def part(self, number: int, of: int) -> "_Share":
        """Return every ``of``-th frame from ``number`` on."""
        rows = slice(number, None, of)
        return replace(
            self, indices=self.indices[rows], times_ns=self.times_ns[rows], Ts_world_cam=self.Ts_world_cam[rows]
        )


def render_frames(
    scenario: Scenario,
    Ts_world_cam: Array,
    frame_times_ns: Times,
    folder: Path,
    progress: Progress = silent,
    workers: int | None = None,
    noise: ImageNoise | None = None,
) -> None:
    """Write what the rig's main camera sees on a flight, one grey ``<t_ns>.png`` a frame.

    Args:
        scenario: Says world, camera and seed.
        Ts_world_cam: (M, 4, 4) Poses of the camera.
        frame_times_ns: (M,) Time stamps [ns].
        folder: Where the images go; it is made where it is missing.
        progress: Told how many frames are done.
        workers: Processes; as many as there are cores by default. The images do not depend on it.
        noise: The sensor's; that of a typical one by default.

    Raises:
        ConfigError: Poses and times do not belong together, or no world has the scenario's name.
        GraphicsError: No off-screen OpenGL, or a worker failed.
    """
    count = len(frame_times_ns)
    if Ts_world_cam.shape != (count, 4, 4):
        raise ConfigError(f"camera poses with shape {Ts_world_cam.shape}; expected ({count}, 4, 4)")
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="dronevio-") as scratch:
        model_path = Path(scratch) / "world.mjb"
        mujoco.mj_saveModel(build_world(scenario.world, scenario.seed).spec.compile(), str(model_path), None)
        camera = scenario.rig.cameras[0].model
        indices = np.arange(count, dtype=np.int64)
        share = _Share(
            model_path, camera, noise or ImageNoise(), scenario.seed, indices, frame_times_ns, Ts_world_cam, folder
        )
        crew = workers or _default_workers(count)
        progress(0, count)
        with _started([share.part(number, crew) for number in range(crew)], folder) as processes:
            _follow(processes, count, progress)


def _default_workers(frames: int) -> int:
    """Return how many processes are worth starting."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, min(cores, _MOST_WORKERS, -(-frames // _FRAMES_WORTH_A_WORKER)))


@contextmanager
def _started(shares: Sequence[_Share], folder: Path) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Run a worker a share; whatever happens, leave neither a process nor half an image behind.

    These are plain processes: multiprocessing would run the caller's script again in each.
    """
    environment = {**os.environ, "LP_NUM_THREADS": "1"}  # Mesa's renderer would start a thread a core in each
    processes: list[subprocess.Popen[bytes]] = []
    try:
        for share in shares:
            process = subprocess.Popen(
                [sys.executable, "-c", _WORKER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                env=environment,
                start_new_session=True,  # Ctrl-C reaches the parent only, which ends the workers
            )
            processes.append(process)
            assert process.stdin is not None
            pickle.dump(share, process.stdin)
            process.stdin.close()
        yield processes
    finally:
        for process in processes:
            process.kill()
            process.wait()
            for stream in (process.stdin, process.stdout, process.stderr):
                if stream is not None:
                    stream.close()
        for half_written in folder.glob(f"*{_PARTIAL}"):
            half_written.unlink()


def _follow(processes: Sequence["subprocess.Popen[bytes]"], count: int, progress: Progress) -> None:
    """Report the workers' progress, a byte on stdout a frame, until all are done.

    Raises:
        GraphicsError: One of them failed.
    """
    done = 0
    with selectors.DefaultSelector() as selector:
        for process in processes:
            assert process.stdout is not None
            selector.register(process.stdout, selectors.EVENT_READ, process)
        while selector.get_map():
            for key, _ in selector.select():
                marks = os.read(key.fd, 4096)
                if marks:
                    done += len(marks)
                    progress(done, count)
                    continue
                selector.unregister(key.fileobj)
                _check(key.data)


def _check(process: "subprocess.Popen[bytes]") -> None:
    """Raise a worker's error as our own."""
    assert process.stderr is not None
    said = process.stderr.read().decode(errors="replace").strip().splitlines() or ["it said nothing"]
    code = process.wait()
    if code == _KNOWN_ERROR:
        raise GraphicsError(said[-1])
    if code < 0:
        raise GraphicsError(f"a rendering process was killed by {signal.Signals(-code).name}")
    if code:
        raise GraphicsError(f"a rendering process failed: {said[-1]}")


def work() -> None:
    """Draw a share of the frames: what a worker's process does. The share comes pickled on stdin."""
    cv2.setNumThreads(1)
    share: _Share = pickle.load(sys.stdin.buffer)
    try:
        for _ in _drawn(share):
            os.write(1, b".")
    except DronevioError as error:
        print(error, file=sys.stderr)  # noqa: T201
        sys.exit(_KNOWN_ERROR)
    except Exception:
        traceback.print_exc()
        sys.exit(1)


def _drawn(share: _Share) -> Iterator[Path]:
    """Draw and write the frames of a share, and yield each one's path."""
    model = mujoco.MjModel.from_binary_path(str(share.model_path))
    with OffscreenCamera(model, share.camera) as camera:
        for index, t_ns, T_world_cam in zip(share.indices, share.times_ns, share.Ts_world_cam, strict=True):
            stream = np.random.SeedSequence(share.seed, spawn_key=(_NOISE_STREAM, int(index)))
            image = share.noise.apply(camera.render(T_world_cam), np.random.default_rng(stream))
            path = share.folder / f"{t_ns}.png"
            partial = path.with_suffix(_PARTIAL)
            encoded = cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_COMPRESSION])[1]
            partial.write_bytes(encoded.tobytes())
            partial.replace(path)
            yield path
