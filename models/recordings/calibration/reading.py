"""Reading of calibration files, whose format is recognized from their contents: Kalibr's YAML or Basalt's JSON."""

from collections.abc import Sequence
from pathlib import Path

from dronevio.models.errors import InputError
from dronevio.models.recordings.calibration.basalt import basalt_calibration, is_basalt
from dronevio.models.recordings.calibration.calibration import Calibration
from dronevio.models.recordings.calibration.kalibr import CAMCHAIN_FILE, IMU_FILE, kalibr_calibration
from dronevio.models.recordings.calibration.yaml_document import YamlDocument, read_yaml
from dronevio.models.rig import Rig, RigCamera


def read_calibrated_rig(path: Path, *more: Path) -> Rig:
    """Read a rig.

    Args:
        path: A file with cameras and IMU, a ``camchain.yaml`` with an ``imu.yaml`` in the same folder, or that folder.
        more: Further files, if cameras and IMU are in different folders.

    Raises:
        InputError: As `read_calibration`, or the cameras or the IMU are missing.
    """
    path = Path(path)
    chain = path / CAMCHAIN_FILE if path.is_dir() else path
    beside = chain.with_name(IMU_FILE)
    calibration = read_calibration([chain, *more])
    if calibration.imu is None and beside.exists():
        calibration = read_calibration([chain, *more, beside])
    return calibration.rig()


def read_cameras(path: Path) -> tuple[RigCamera, ...]:
    """Read the cameras of a calibration, which needs no IMU: without one, the frame of the rig is that of ``cam0``.

    Raises:
        InputError: The file is missing or damaged, has no camera, or a camera model is not supported.
    """
    calibration = read_calibration([path])
    if not calibration.cameras:
        raise InputError(path, "no camera", "Kalibr's camchain.yaml: cam0 with intrinsics")
    return calibration.cameras


def read_calibration(paths: Sequence[Path], rate_hz: float = 20.0) -> Calibration:
    """Read the calibration of one or more files.

    Args:
        paths: Files of Kalibr or Basalt in any order: cameras, IMU, or both in one file.
        rate_hz: Frame rate of cameras without ``rate_hz`` [Hz], which neither program specifies.

    Raises:
        InputError: A file is missing or damaged, a field is missing, invalid or specified twice, or a camera model is
            not supported.
    """
    return calibration_of([read_yaml(Path(path)) for path in paths], rate_hz)


def calibration_of(files: Sequence[YamlDocument], rate_hz: float = 20.0) -> Calibration:
    """Return the calibration of parsed files; see `read_calibration`.

    Raises:
        InputError: As `read_calibration`.
    """
    return Calibration.combined(
        [basalt_calibration(file, rate_hz) if is_basalt(file) else kalibr_calibration(file, rate_hz) for file in files]
    )
