"""Alterations of a recording, one property each, as folders of files that a user could have recorded.

The recording is an EuRoC folder. Images that an alteration does not touch are linked, not copied.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from ruamel.yaml import YAML

from dronevio.models.arrays import Array
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rotation import log_so3
from dronevio.models.state import Trajectory

Times = npt.NDArray[np.int64]
Image = npt.NDArray[Any]

SECOND_NS = 10**9


@dataclass(frozen=True, eq=False)
class CameraFiles:
    """The files of a camera."""

    t_ns: Times
    """(M,) Time stamps in the order of the list [ns]."""
    files: tuple[Path, ...]
    """M image files."""
    yaml: dict[str, Any]
    """Contents of ``sensor.yaml``."""
    change: Callable[[int, Image], Image] | None = None
    """Function of the row and the image, with which each image is changed; None to link the files."""
    suffix: str = ".png"
    """Ending of the image files that are written."""


@dataclass(frozen=True, eq=False)
class Files:
    """The files of a recording."""

    imu_t_ns: Times
    """(N,) Time stamps of the IMU in the order of the table [ns]."""
    imu: Array
    """(N, 6) Angular velocity [rad/s] and specific force [m/s²]."""
    imu_yaml: dict[str, Any]
    """Contents of ``imu0/sensor.yaml``."""
    cameras: tuple[CameraFiles, ...]
    """The files of the cameras."""
    truth: Trajectory
    """Ground truth at its own times."""
    true_t_ns: Callable[[Times, int], Times] = lambda t_ns, _: t_ns
    """Function of time stamps (K,) and the segment that returns the times of the truth [ns]."""
    block_style: bool = False
    """Whether YAML is written with one number a line."""
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))
    """Random numbers of the alteration."""

    @property
    def middle_ns(self) -> int:
        """Time in the middle of the recording [ns]."""
        return int(self.cameras[0].t_ns[len(self.cameras[0].t_ns) // 2]) - 1_000_000


Alteration = Callable[[Files], Files]


def read_files(folder: Path, cameras: int, start_s: float = 0.0) -> Files:
    """Read the files of an EuRoC folder with ``groundtruth.tum``, from a time after the first frame on [s]."""
    mav0, yaml = folder / "mav0", YAML(typ="safe", pure=True)
    table = _rows(mav0 / "imu0" / "data.csv")
    imu_t_ns = table[:, 0].astype(np.int64)
    found, first_ns = [], 0
    for i in range(cameras):
        rows = _rows(mav0 / f"cam{i}" / "data.csv")
        t_ns = rows[:, 0].astype(np.int64)
        first_ns = int(t_ns[0]) + round(start_s * 1e9)
        kept = t_ns >= first_ns
        files = tuple(mav0 / f"cam{i}" / "data" / name for name in rows[kept, 1])
        found.append(CameraFiles(t_ns[kept], files, yaml.load(mav0 / f"cam{i}" / "sensor.yaml")))
    kept = imu_t_ns >= first_ns - 20_000_000
    values = table[kept, 1:].astype(np.float64)
    imu_yaml = yaml.load(mav0 / "imu0" / "sensor.yaml")
    return Files(imu_t_ns[kept], values, imu_yaml, tuple(found), read_tum(folder / "groundtruth.tum"))


def _rows(path: Path) -> npt.NDArray[np.str_]:
    """Return the cells of a table without its comments."""
    lines = [line.split(",") for line in path.read_text().splitlines() if line and not line.startswith("#")]
    return np.array(lines, dtype=np.str_)


def gyro_bias(files: Files) -> Array:
    """Return the mean difference (3,) of the gyroscope from the angular velocity of the truth [rad/s]."""
    truth = files.truth
    Rs, t_s = truth.rotations, (truth.t_ns - truth.t_ns[0]).astype(np.float64) * 1e-9
    rate = log_so3(np.swapaxes(Rs[:-1], 1, 2) @ Rs[1:]) / np.diff(t_s)[:, None]
    inside = (files.imu_t_ns >= truth.t_ns[0]) & (files.imu_t_ns <= truth.t_ns[-1])
    return np.asarray(files.imu[inside, :3].mean(axis=0) - rate.mean(axis=0))


def write_files(files: Files, folder: Path) -> None:
    """Write the files of a recording as an EuRoC folder, without its ground truth."""
    rows = (
        f"{t}," + ",".join(f"{v:.10g}" for v in row) + "\n" for t, row in zip(files.imu_t_ns, files.imu, strict=True)
    )
    (folder / "mav0" / "imu0").mkdir(parents=True)
    (folder / "mav0" / "imu0" / "data.csv").write_text("#timestamp [ns],w,a\n" + "".join(rows))
    _write_yaml(folder / "mav0" / "imu0" / "sensor.yaml", files.imu_yaml, files.block_style)
    for i, camera in enumerate(files.cameras):
        data = folder / "mav0" / f"cam{i}" / "data"
        data.mkdir(parents=True)
        names = [f"{row:06d}{camera.suffix if camera.change else file.suffix}" for row, file in enumerate(camera.files)]
        for row, (name, file) in enumerate(zip(names, camera.files, strict=True)):
            if camera.change is None:
                (data / name).symlink_to(file.resolve())
            else:
                image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
                cv2.imwrite(str(data / name), camera.change(row, np.asarray(image)), [cv2.IMWRITE_PNG_COMPRESSION, 1])
        listed = "".join(f"{t},{name}\n" for t, name in zip(camera.t_ns, names, strict=True))
        (data.parent / "data.csv").write_text("#timestamp [ns],filename\n" + listed)
        _write_yaml(data.parent / "sensor.yaml", camera.yaml, files.block_style)


def _write_yaml(path: Path, values: dict[str, Any], block_style: bool) -> None:
    yaml = YAML(typ="safe", pure=True)
    yaml.default_flow_style = False if block_style else None
    yaml.dump(values, path)


# Changes of a part


def of_imu(change: Callable[[Array, Array, np.random.Generator], Array]) -> Alteration:
    """Return the alteration of the samples (N, 6) by a function of their times (N,) since the first [s]."""

    def altered(files: Files) -> Files:
        t_s = (files.imu_t_ns - files.imu_t_ns[0]).astype(np.float64) * 1e-9
        return replace(files, imu=change(t_s, files.imu.copy(), files.rng))

    return altered


def of_imu_rows(rows: Callable[[int], Any]) -> Alteration:
    """Return the alteration that keeps some rows of the IMU, by a function of their number."""

    def altered(files: Files) -> Files:
        kept = rows(len(files.imu_t_ns))
        rate = float(files.imu_yaml["rate_hz"]) * len(files.imu_t_ns[kept]) / len(files.imu_t_ns)
        imu_yaml = files.imu_yaml | {"rate_hz": rate if isinstance(kept, slice) else files.imu_yaml["rate_hz"]}
        return replace(files, imu_t_ns=files.imu_t_ns[kept], imu=files.imu[kept], imu_yaml=imu_yaml)

    return altered


def of_times(
    imu: Callable[[Times, int], Times] | None = None, camera: Callable[[Times, int], Times] | None = None
) -> Alteration:
    """Return the alteration of time stamps by functions of the stamps and the time in the middle [ns]."""

    def altered(files: Files) -> Files:
        middle_ns = files.middle_ns
        cameras = files.cameras
        if camera is not None:
            cameras = tuple(replace(each, t_ns=camera(each.t_ns, middle_ns)) for each in cameras)
        imu_t_ns = files.imu_t_ns if imu is None else imu(files.imu_t_ns, middle_ns)
        return replace(files, imu_t_ns=imu_t_ns, cameras=cameras)

    return altered


def with_truth(alteration: Alteration, true_t_ns: Callable[[Times, int], Times]) -> Alteration:
    """Return an alteration after which the truth has other times than the stamps."""
    return lambda files: replace(alteration(files), true_t_ns=true_t_ns)


def shifted(shift_s: float, *, imu: bool = True, camera: bool = True, from_middle: bool = False) -> Alteration:
    """Return the alteration that adds a time to stamps, or to those from the middle of the recording on."""
    shift_ns = round(shift_s * 1e9)

    def moved(t_ns: Times, middle_ns: int) -> Times:
        return t_ns + shift_ns * (t_ns >= middle_ns if from_middle else np.ones(len(t_ns), np.int64))

    def true_t_ns(t_ns: Times, segment: int) -> Times:
        return t_ns - shift_ns * (camera and (segment > 0 or not from_middle))

    return with_truth(of_times(moved if imu else None, moved if camera else None), true_t_ns)


def similar(rate_hz: float, jitter_s: float = 0.0) -> Alteration:
    """Return the alteration that plays the recording at another rate as an exact similarity.

    Times are scaled by s, angular velocities by 1/s and lengths by s², while specific forces stay. A white noise of
    density σ has the standard deviation σ/√Δt, so that densities of the gyroscope scale by 1/√s, those of the
    accelerometer by √s, and random walks by s^(-3/2) and s^(-1/2).
    """

    def altered(files: Files) -> Files:
        first_ns = int(files.cameras[0].t_ns[0])
        s = float(files.cameras[0].yaml["rate_hz"]) / rate_hz
        bias = gyro_bias(files)

        def scaled(t_ns: Times) -> Times:
            return np.asarray(first_ns + np.rint((t_ns - first_ns) * s).astype(np.int64))

        imu = files.imu.copy()
        imu[:, :3] = (imu[:, :3] - bias) / s + bias
        powers = {"gyroscope_noise_density": -0.5, "accelerometer_noise_density": 0.5}
        powers |= {"gyroscope_random_walk": -1.5, "accelerometer_random_walk": -0.5}
        imu_yaml = files.imu_yaml | {key: float(files.imu_yaml[key]) * s**power for key, power in powers.items()}
        imu_yaml["rate_hz"] = float(files.imu_yaml["rate_hz"]) / s
        cameras = []
        for each in files.cameras:
            data = np.array(each.yaml["T_BS"]["data"], dtype=np.float64)
            data[[3, 7, 11]] *= s * s
            pose = each.yaml["T_BS"] | {"data": data.tolist()}
            yaml = each.yaml | {"rate_hz": rate_hz, "T_BS": pose}
            jitter_ns = np.rint(np.random.default_rng(1).normal(0.0, jitter_s, len(each.t_ns)) * 1e9).astype(np.int64)
            cameras.append(replace(each, t_ns=scaled(each.t_ns) + jitter_ns, yaml=yaml))
        return replace(
            files,
            imu_t_ns=scaled(files.imu_t_ns),
            imu=imu,
            imu_yaml=imu_yaml,
            cameras=tuple(cameras),
            truth=Trajectory(scaled(files.truth.t_ns), files.truth.p_world_imu * s * s, files.truth.quat_wxyz),
        )

    return altered


def bursts(size: int) -> Alteration:
    """Return the alteration by a serial driver, which stamps several samples with the time of the last of them."""

    def stamped(t_ns: Times, _: int) -> Times:
        last = np.minimum((np.arange(len(t_ns)) // size + 1) * size - 1, len(t_ns) - 1)
        return t_ns[last]

    return of_times(imu=stamped)


def late_rows(count: int, *, imu: bool) -> Alteration:
    """Return the alteration that writes single rows five rows later than their order."""

    def moved(files: Files) -> Files:
        times = files.imu_t_ns if imu else files.cameras[0].t_ns
        order = np.arange(len(times), dtype=np.float64)
        order[files.rng.choice(len(times) - 10, count, replace=False)] += 5.5
        rows = np.argsort(order)
        if imu:
            return replace(files, imu_t_ns=times[rows], imu=files.imu[rows])
        cameras = [
            replace(each, t_ns=each.t_ns[rows], files=tuple(each.files[row] for row in rows)) for each in files.cameras
        ]
        return replace(files, cameras=tuple(cameras))

    return moved


def of_frames(rows: Callable[[Times], Array | Any], camera: int | None = None) -> Alteration:
    """Return the alteration that keeps some frames, by a function of their stamps that returns a mask."""

    def altered(files: Files) -> Files:
        cameras = list(files.cameras)
        for i, each in enumerate(cameras):
            if camera in (None, i):
                kept = np.flatnonzero(rows(each.t_ns))
                cameras[i] = replace(each, t_ns=each.t_ns[kept], files=tuple(each.files[row] for row in kept))
        return replace(files, cameras=tuple(cameras))

    return altered


def of_file_order(index_of: Callable[[int, int], int]) -> Alteration:
    """Return the alteration that shows the image of another row, by a function of the row and the number of rows."""

    def altered(files: Files) -> Files:
        cameras = tuple(
            replace(each, files=tuple(each.files[index_of(row, len(each.files))] for row in range(len(each.files))))
            for each in files.cameras
        )
        return replace(files, cameras=cameras)

    return altered


def of_images(
    change: Callable[[int, Image], Image], suffix: str = ".png", cameras: tuple[int, ...] = (0, 1)
) -> Alteration:
    """Return the alteration of images by a function of their row."""

    def altered(files: Files) -> Files:
        changed = tuple(
            replace(each, change=change, suffix=suffix) if i in cameras else each
            for i, each in enumerate(files.cameras)
        )
        return replace(files, cameras=changed)

    return altered


def of_calibration(change: Callable[[dict[str, Any]], dict[str, Any]], cameras: tuple[int, ...] = (0, 1)) -> Alteration:
    """Return the alteration of ``sensor.yaml`` of cameras."""

    def altered(files: Files) -> Files:
        changed = tuple(
            replace(each, yaml=change(each.yaml)) if i in cameras else each for i, each in enumerate(files.cameras)
        )
        return replace(files, cameras=changed)

    return altered


def both(*alterations: Alteration) -> Alteration:
    """Return several alterations in succession, which are one property of a recording together."""

    def altered(files: Files) -> Files:
        for each in alterations:
            files = each(files)
        return files

    return altered


# Functions of samples and images


def _outliers(count: int, gyro_rad_s: float, accel_m_s2: float) -> Alteration:
    def change(_: Array, imu: Array, rng: np.random.Generator) -> Array:
        rows = rng.choice(np.arange(10, len(imu) - 10, 4), count, replace=False)
        sign = rng.choice([-1.0, 1.0], (count, 6))
        imu[rows] = sign * np.repeat([gyro_rad_s, accel_m_s2], 3)
        return imu

    return of_imu(change)


def _vibration(t_s: Array, imu: Array, rng: np.random.Generator) -> Array:
    wave = np.sin(2.0 * np.pi * 87.0 * t_s[:, None] + rng.uniform(0.0, 2.0 * np.pi, 6))
    return np.asarray(imu + wave * np.repeat([0.3, 15.0], 3))


def _accel_delayed(delay_s: float) -> Alteration:
    def change(t_s: Array, imu: Array, _: np.random.Generator) -> Array:
        delayed = [np.interp(t_s - delay_s, t_s, axis) for axis in imu[:, 3:].T]
        return np.column_stack([imu[:, :3], *delayed])

    return of_imu(change)


def _scaled(gyro: float = 1.0, accel: float = 1.0) -> Alteration:
    return of_imu(lambda _, imu, __: imu * np.repeat([gyro, accel], 3))


def _added(gyro: float = 0.0, accel: float = 0.0) -> Alteration:
    return of_imu(lambda _, imu, __: imu + np.repeat([gyro, accel], 3))


def _clipped(gyro_rad_s: float, accel_m_s2: float) -> Alteration:
    limit = np.repeat([gyro_rad_s, accel_m_s2], 3)
    return of_imu(lambda _, imu, __: np.clip(imu, -limit, limit))


def _bits(bits: int) -> Callable[[int, Image], Image]:
    def change(row: int, image: Image) -> Image:
        noise = np.random.default_rng(row).integers(0, 1 << (bits - 8), image.shape)
        return (image.astype(np.uint16) * (1 << (bits - 8)) + noise.astype(np.uint16)).astype(np.uint16)

    return change


def _grey(gain: float, offset: float = 0.0, noise: float = 0.0) -> Callable[[int, Image], Image]:
    def change(row: int, image: Image) -> Image:
        values = image.astype(np.float64) * gain + offset
        values += np.random.default_rng(row).normal(0.0, noise, image.shape) if noise else 0.0
        return np.clip(np.rint(values), 0, 255).astype(np.uint8)

    return change


def _flicker(row: int, image: Image) -> Image:
    return _grey(1.0 + 0.3 * np.sin(1.7 * row))(row, image)


def _hot_pixels(_: int, image: Image) -> Image:
    rng, changed = np.random.default_rng(5), image.copy()
    changed[rng.integers(0, image.shape[0], 300), rng.integers(0, image.shape[1], 300)] = 255
    return changed


def _blurred(_: int, image: Image) -> Image:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), 3.0))


def _half(_: int, image: Image) -> Image:
    return np.asarray(cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def _half_calibration(yaml: dict[str, Any]) -> dict[str, Any]:
    fx, fy, cx, cy = yaml["intrinsics"]
    intrinsics = [fx / 2.0, fy / 2.0, (cx + 0.5) / 2.0 - 0.5, (cy + 0.5) / 2.0 - 0.5]
    return yaml | {"intrinsics": intrinsics, "resolution": [size // 2 for size in yaml["resolution"]]}


def _cropped_calibration(yaml: dict[str, Any]) -> dict[str, Any]:
    fx, fy, cx, cy = yaml["intrinsics"]
    return yaml | {"intrinsics": [fx, fy, cx - 40.0, cy - 20.0], "resolution": [680, 440]}


def _focal(factor: float) -> Alteration:
    return of_calibration(
        lambda y: y | {"intrinsics": [*(np.array(y["intrinsics"][:2]) * factor).tolist(), *y["intrinsics"][2:]]}
    )


def _drift(ppm: float) -> Alteration:
    return of_times(imu=lambda t_ns, _: t_ns + np.rint((t_ns - t_ns[0]) * ppm * 1e-6).astype(np.int64))


def _jittered(sigma_s: float) -> Callable[[Times, int], Times]:
    return lambda t_ns, _: (
        t_ns + np.rint(np.random.default_rng(2).normal(0.0, sigma_s, len(t_ns)) * 1e9).astype(np.int64)
    )


def _no_origin(origin_ns: int) -> Alteration:
    def altered(files: Files) -> Files:
        shift_s = (origin_ns - int(files.cameras[0].t_ns[0])) * 1e-9
        return shifted(shift_s)(files)

    return altered


def _gap(start_s: float, length_s: float) -> Callable[[Times], Any]:
    def kept(t_ns: Times) -> Any:
        t_s = (t_ns - t_ns[0]) * 1e-9
        return (t_s < start_s) | (t_s >= start_s + length_s)

    return kept


def _imu_gap(start_s: float, length_s: float) -> Alteration:
    def altered(files: Files) -> Files:
        kept = _gap(start_s, length_s)(files.imu_t_ns)
        return replace(files, imu_t_ns=files.imu_t_ns[kept], imu=files.imu[kept])

    return altered


def _not_finite(_: Array, imu: Array, rng: np.random.Generator) -> Array:
    imu[rng.choice(len(imu), 20, replace=False)] = np.nan
    return imu


_SWAPPED_AXES = [1, 0, 2]
_FREEZE = 80, 40  # first frame and number of frames

ALTERATIONS: Mapping[str, tuple[int, Alteration]] = {
    # name: number of cameras, alteration
    "none, one camera": (1, lambda files: files),
    "none, two cameras": (2, lambda files: files),
    **{f"similar at {rate:g} Hz": (1, similar(rate)) for rate in (10, 12.5, 15, 24, 25, 29.97, 30)},
    "similar at 25 Hz, jitter .1 ms": (1, similar(25.0, 1e-4)),
    "similar at 15 Hz, two cameras": (2, similar(15.0)),
    "similar at 25 Hz, two cameras": (2, similar(25.0)),
    **{f"both clocks step by {s:+g} s": (1, shifted(s, from_middle=True)) for s in (-3.013, -3.0, -1.0, 5.0)},
    "camera clock steps by +0.1 s": (1, shifted(0.1, imu=False, from_middle=True)),
    "IMU clock steps by -0.5 s": (1, shifted(-0.5, camera=False, from_middle=True)),
    **{
        f"camera stamps {s * 1e3:+g} ms": (1, with_truth(shifted(s, imu=False), lambda t_ns, _: t_ns))
        for s in (-0.2, -0.1, -0.05, -0.02, 0.02, 0.05, 0.1, 0.2)
    },
    "IMU stamps +500 ms": (1, shifted(0.5, camera=False)),
    "IMU stamps in bursts of 4": (1, bursts(4)),
    "IMU stamps in bursts of 16": (1, bursts(16)),
    **{f"clock drift {ppm} ppm": (1, _drift(ppm)) for ppm in (50, 500)},
    "stamps from 0 on": (1, _no_origin(0)),
    "stamps from -20 s on": (1, _no_origin(-20 * SECOND_NS)),
    "jitter of image stamps 2 ms": (1, of_times(camera=_jittered(2e-3))),
    "stamps at the start of the exposure": (1, of_times(camera=lambda t_ns, _: t_ns - 5_000_000)),
    "10 late rows of the IMU": (1, late_rows(10, imu=True)),
    "5 late rows of the camera": (1, late_rows(5, imu=False)),
    "IMU gap of .3 s": (1, _imu_gap(4.0, 0.3)),
    "image gap of 1 s": (1, of_frames(_gap(4.0, 1.0))),
    "half of the frames": (1, of_frames(lambda t_ns: np.arange(len(t_ns)) % 2 == 0)),
    "each image twice": (1, of_file_order(lambda row, _: row - row % 2)),
    "images frozen for 2 s": (
        1,
        of_file_order(lambda row, _: _FREEZE[0] if _FREEZE[0] <= row < sum(_FREEZE) else row),
    ),
    "reversed images": (1, of_file_order(lambda row, count: count - 1 - row)),
    "second camera at half size": (2, both(of_images(_half, cameras=(1,)), of_calibration(_half_calibration, (1,)))),
    "second camera cropped": (
        2,
        both(
            of_images(lambda _, image: image[20:460, 40:720], cameras=(1,)),
            of_calibration(_cropped_calibration, (1,)),
        ),
    ),
    "second camera lacks every third image": (2, of_frames(lambda t_ns: np.arange(len(t_ns)) % 3 > 0, camera=1)),
    "second camera lacks 2 s": (2, of_frames(_gap(4.0, 2.0), camera=1)),
    "second camera dark": (2, of_images(_grey(0.02), cameras=(1,))),
    "cameras swapped": (2, lambda files: replace(files, cameras=_exchanged(files.cameras))),
    "12 bits in 16-bit PNG": (1, of_images(_bits(12))),
    "10 bits in 16-bit TIFF": (1, of_images(_bits(10), ".tiff")),
    "12 bits in 16-bit PNG, two cameras": (2, of_images(_bits(12))),
    "JPEG": (1, of_images(lambda _, image: image, ".jpg")),
    "dark images": (1, of_images(_grey(0.1, noise=1.0))),
    "overexposed images": (1, of_images(_grey(1.8, 40.0))),
    "noise of 10 grey values": (1, of_images(_grey(1.0, noise=10.0))),
    "brightness flickers by 30 %": (1, of_images(_flicker)),
    "300 hot pixels": (1, of_images(_hot_pixels)),
    "blurred images": (1, of_images(_blurred)),
    "mirrored images": (1, of_images(lambda _, image: np.ascontiguousarray(image[:, ::-1]))),
    **{f"{count} IMU outliers": (1, _outliers(count, 30.0, 150.0)) for count in (2, 12, 50)},
    "12 IMU outliers of 20 m/s², 3 rad/s": (1, _outliers(12, 3.0, 20.0)),
    "vibration": (1, of_imu(_vibration)),
    "IMU at 100 Hz": (1, of_imu_rows(lambda n: slice(0, n, 2))),
    "IMU at 50 Hz": (1, of_imu_rows(lambda n: slice(0, n, 4))),
    "accelerometer 5 ms late": (1, _accel_delayed(0.005)),
    "accelerometer 10 ms late": (1, _accel_delayed(0.010)),
    "gyroscope scale +1 %": (1, _scaled(gyro=1.01)),
    "gyroscope scale -1 %": (1, _scaled(gyro=0.99)),
    "accelerometer scale +1 %": (1, _scaled(accel=1.01)),
    "gyroscope bias +.1 rad/s": (1, _added(gyro=0.1)),
    "accelerometer bias +.3 m/s²": (1, _added(accel=0.3)),
    "gyroscope range .4 rad/s": (1, _clipped(0.4, 1e3)),
    "20 samples not finite": (1, of_imu(_not_finite)),
    "gyroscope and accelerometer swapped": (1, of_imu(lambda _, imu, __: imu[:, [3, 4, 5, 0, 1, 2]])),
    "accelerometer in g": (1, _scaled(accel=1.0 / GRAVITY_M_S2)),
    "gyroscope in °/s": (1, _scaled(gyro=float(np.degrees(1.0)))),
    "axes of the gyroscope": (1, of_imu(lambda _, imu, __: imu[:, [*_SWAPPED_AXES, 3, 4, 5]])),
    "axes of the accelerometer": (1, of_imu(lambda _, imu, __: imu[:, [0, 1, 2, *(3 + np.array(_SWAPPED_AXES))]])),
    "calibration in block style": (1, lambda files: replace(files, block_style=True)),
    "focal length +1 %": (1, _focal(1.01)),
    "focal length +20 %": (1, _focal(1.2)),
    "no lens distortion": (1, of_calibration(lambda y: y | {"distortion_coefficients": [0.0] * 4})),
}
"""Alterations by name, each with the number of cameras that are used."""


def _exchanged(cameras: tuple[CameraFiles, ...]) -> tuple[CameraFiles, ...]:
    """Return two cameras with the calibrations of each other."""
    first, second = cameras
    return replace(first, yaml=second.yaml), replace(second, yaml=first.yaml)
