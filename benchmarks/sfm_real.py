"""Structure from motion of real images that are kept for checks, beside COLMAP and what is known of their cameras.

Two sets, neither of which any threshold was chosen on:

- ``burst``: ten stereo pairs of EuRoC's V1_01 in motion, in the folder that the variable ``DRONEVIO_DATA`` names. The
  images are reconstructed without their mounting, which is the truth: the pose of the right camera in the left one is
  the same for each pair, up to scale.
- ``motorcycle``: two rectified images with true disparities of the Middlebury 2014 stereo benchmark (Scharstein et al.,
  GCPR 2014), as ``motorcycle_left.png``, ``motorcycle_right.png`` and ``motorcycle_disp.npz`` of the wheel of
  scikit-image 0.17.2. The true rotation is zero, and the true translation along x. An error of the direction is largely
  one along the optical axis, which two images determine badly.

Use::

    DRONEVIO_DATA=data .venv/bin/python benchmarks/sfm_real.py
    .venv/bin/python benchmarks/sfm_real.py --motorcycle motorcycle
"""

import os
import tempfile
from dataclasses import astuple, dataclass, replace
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import tyro
from measuring import print_rows, text

from dronevio.estimator.sfm.pipeline import reconstruct
from dronevio.models.arrays import Array
from dronevio.models.camera import CameraModel
from dronevio.models.image_sets import ImageSet, image_folder, joined
from dronevio.models.reconstruction import Reconstruction
from dronevio.models.reconstructions import read_reconstruction
from dronevio.models.rig import EUROC_CAM0, EUROC_CAM1, EUROC_T_IMU_CAM0, EUROC_T_IMU_CAM1
from dronevio.models.rotation import inverse_pose, log_so3

MOTORCYCLE_FOCAL_PX, MOTORCYCLE_CENTRE_PX, MOTORCYCLE_DX_PX = 994.978, (311.193, 254.877), 31.086
"""Calibration of the two images of the motorcycle, as scikit-image documents it [px]."""


@dataclass(frozen=True)
class RealCommand:
    """Reconstruct real images that are kept for checks."""

    motorcycle: Path | None = None
    """Folder with the two images of the motorcycle and their disparities; None to leave them out."""
    colmap: bool = True
    """Whether COLMAP reconstructs the images, too."""


@dataclass(frozen=True, eq=False)
class RealSet:
    """Real images whose pairs are known to have one relative pose."""

    name: str
    """Name of the set."""
    images: ImageSet
    """The images, with calibrated cameras."""
    pairs: tuple[tuple[str, str], ...]
    """Names of the left and the right image of each pair."""
    T_left_right: Array
    """(4, 4) True pose of the right camera in the left one [m]."""
    disparities_px: Array | None = None
    """(H, W) True disparities of the left image, infinite where they are unknown; None without any [px]."""


@dataclass(frozen=True)
class Differences:
    """Differences of the relative poses of the pairs to the true one."""

    rotation_deg: float
    """Median angle between the rotations [deg]."""
    direction_deg: float
    """Median angle between the directions of the translations [deg]."""
    baseline_percent: float
    """Standard deviation of the lengths of the translations relative to their mean [%]."""
    disparity_px: float
    """Median error of the disparities of the points, whose scale is that of the baseline [px]; NaN without truth."""


def burst(data: Path) -> RealSet:
    """Return the stereo pairs of EuRoC's V1_01."""
    folder = data / "euroc" / "V1_01_burst"
    left, right = (image_folder(folder / f"cam{k}", model=m) for k, m in enumerate((EUROC_CAM0, EUROC_CAM1)))
    named = [_renamed(images, f"cam{k}") for k, images in enumerate((left, right))]
    pairs = tuple((f"cam0/{name}", f"cam1/{name}") for name in left.names)
    return RealSet("EuRoC V1_01", joined(*named), pairs, inverse_pose(EUROC_T_IMU_CAM0) @ EUROC_T_IMU_CAM1)


def motorcycle(folder: Path) -> RealSet:
    """Return the two images of the motorcycle."""
    images = image_folder(folder)
    height, width = images.read(0).shape[:2]
    f, (cx, cy) = MOTORCYCLE_FOCAL_PX, MOTORCYCLE_CENTRE_PX
    cameras = tuple(CameraModel(width, height, f, f, x, cy) for x in (cx, cx + MOTORCYCLE_DX_PX))
    images = replace(
        images,
        image_camera=np.arange(2),
        cameras=cameras,
        is_calibrated=np.array([True, True]),
        is_ordered=False,
        focal_source=(),
    )
    T = np.eye(4)
    T[0, 3] = 0.193001
    disparities = np.load(folder / "motorcycle_disp.npz")["arr_0"].astype(np.float64)
    return RealSet("motorcycle", images, (("motorcycle_left.png", "motorcycle_right.png"),), T, disparities)


def _renamed(images: ImageSet, folder: str) -> ImageSet:
    return replace(images, names=tuple(f"{folder}/{name}" for name in images.names))


def differences(found: Reconstruction, real: RealSet) -> Differences:
    """Return the differences between a reconstruction and what is known of the cameras."""
    row = {name: i for i, name in enumerate(found.image_names)}
    both = [(row[a], row[b]) for a, b in real.pairs if a in row and b in row]
    relative = np.stack([inverse_pose(found.Ts_world_cam[a]) @ found.Ts_world_cam[b] for a, b in both])
    true = real.T_left_right
    rotation = np.linalg.norm(log_so3(true[:3, :3].T @ relative[:, :3, :3]), axis=1)
    lengths = np.linalg.norm(relative[:, :3, 3], axis=1)
    cosine = relative[:, :3, 3] @ true[:3, 3] / (lengths * np.linalg.norm(true[:3, 3]))
    return Differences(
        float(np.degrees(np.median(rotation))),
        float(np.degrees(np.median(np.arccos(np.clip(cosine, -1.0, 1.0))))),
        float(100.0 * lengths.std() / lengths.mean()),
        _disparity_error(found, real, both[0][0], float(lengths[0])),
    )


def _disparity_error(found: Reconstruction, real: RealSet, left: int, baseline: float) -> float:
    """Return the median error of the disparities of the points that the left image observes [px]."""
    if real.disparities_px is None:
        return float("nan")
    observed = np.flatnonzero(found.observation_image == left)
    depth = found.points_in_cameras()[observed, 2] / baseline
    column, line = np.round(found.observation_px[observed]).astype(int).T
    true = real.disparities_px[line, column]
    disparity = MOTORCYCLE_FOCAL_PX / depth - MOTORCYCLE_DX_PX
    return float(np.median(np.abs(disparity - true)[np.isfinite(true)]))


def colmap(images: ImageSet) -> Reconstruction | None:
    """Return COLMAP's reconstruction of all pairs of images, None if it finds none."""
    import pycolmap

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        written: dict[str, str] = {}
        for i, image in enumerate(images.names):
            path = folder / "images" / f"camera{images.image_camera[i]}" / f"{i:03d}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            pixels = images.read(i)
            cv2.imwrite(str(path), pixels if pixels.ndim == 2 else pixels[..., ::-1])
            written[f"{path.parent.name}/{path.name}"] = image
        pycolmap.set_random_seed(0)
        for k, camera in enumerate(images.cameras):
            values = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5, *camera.distortion)
            reader = pycolmap.ImageReaderOptions(camera_model="OPENCV", camera_params=",".join(map(str, values)))
            pycolmap.extract_features(
                folder / "database.db",
                folder / "images",
                image_names=[name for name in written if name.startswith(f"camera{k}/")],
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=pycolmap.FeatureExtractionOptions(num_threads=2, use_gpu=False),
            )
        pairs = combinations(written, 2)
        (folder / "pairs.txt").write_text("\n".join(f"{a} {b}" for a, b in pairs))
        pairing = pycolmap.ImportedPairingOptions(match_list_path=folder / "pairs.txt")
        matching = pycolmap.FeatureMatchingOptions(num_threads=2, use_gpu=False)
        pycolmap.match_image_pairs(folder / "database.db", matching_options=matching, pairing_options=pairing)
        options = pycolmap.IncrementalPipelineOptions(
            num_threads=2,
            ba_refine_focal_length=False,
            ba_refine_principal_point=False,
            ba_refine_extra_params=False,
        )
        models = pycolmap.incremental_mapping(folder / "database.db", folder / "images", folder / "models", options)
        if not models:
            return None
        largest = max(models, key=lambda number: models[number].num_reg_images())
        found = read_reconstruction(folder / "models" / str(largest))
    names = tuple(written[name] for name in found.image_names)
    return Reconstruction(**{**vars(found), "image_names": names})


def row(real: RealSet, program: str, found: Reconstruction | None) -> dict[str, str]:
    """Return a row of the table."""
    known = None if found is None else differences(found, real)
    values = astuple(known) if known else (None,) * 4
    headings = ("rotation [°]", "direction [°]", "baselines, σ [%]", "disparity [px]")
    return {
        "set": real.name,
        "program": program,
        "registered": f"{0 if found is None else len(found.image_names)} of {len(real.images)}",
        "points": "–" if found is None else f"{len(found.points)}",
        "error, median [px]": text(None if found is None else float(np.median(found.reprojection_errors_px()))),
        **{heading: text(value) for heading, value in zip(headings, values, strict=True)},
    }


def measure(command: RealCommand) -> None:
    """Reconstruct the sets that there are, and print the table."""
    sets: list[RealSet] = []
    data = os.environ.get("DRONEVIO_DATA")
    if data is not None:
        sets.append(burst(Path(data)))
    if command.motorcycle is not None:
        sets.append(motorcycle(command.motorcycle))
    if not sets:
        raise SystemExit("no images; expected the variable DRONEVIO_DATA or the option --motorcycle")
    rows: list[dict[str, str]] = []
    for real in sets:
        ours = reconstruct(real.images).reconstructions
        rows.append(row(real, "dronevio", ours[0] if ours else None))
        if command.colmap:
            rows.append(row(real, "COLMAP", colmap(real.images)))
    print_rows("Real images", rows, left=("program",))


if __name__ == "__main__":
    measure(tyro.cli(RealCommand, description=__doc__))
