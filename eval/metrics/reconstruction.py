"""Quality of reconstructions from images: size, tracks, reprojection errors, and positions against true ones.

Images alone determine a reconstruction only up to a similarity, and a set of images may fall into components that have
no points in common. A component is one `Reconstruction` with a world frame of its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.alignment import Alignment, umeyama
from dronevio.models.arrays import Array
from dronevio.models.errors import EvaluationError
from dronevio.models.reconstruction import Reconstruction

Indices = npt.NDArray[np.int64]

FIELD_COLUMNS = 16
"""Number of columns of cells into which `residual_field` divides an image by default."""
MIN_CELL_OBSERVATIONS = 5
"""Smallest number of observations of a cell whose mean residual is computed."""
_MIN_COMMON_IMAGES = 3


@dataclass(frozen=True)
class ReconstructionStatistics:
    """Size and reprojection errors of the components of a reconstruction; numbers that do not exist are None."""

    images: int
    """Number of images from which the reconstruction was made, registered or not."""
    registered_images: int
    """Number of images with a pose."""
    components: int
    """Number of components, each with a world frame of its own."""
    points: int
    """Number of points in all components."""
    observations: int
    """Number of observations of points in images."""
    mean_track_length: float | None
    """Mean number of observations per point."""
    mean_observations_per_image: float | None
    """Mean number of observations per registered image."""
    error_median_px: float | None
    """Median of the reprojection errors, which are distances in the image [px]."""
    error_rms_px: float | None
    """Root mean square of the reprojection errors [px]."""
    error_p95_px: float | None
    """95th percentile of the reprojection errors [px]."""
    invalid_observations: int
    """Number of observations whose point does not project into the image; the errors leave them out."""


@dataclass(frozen=True, eq=False)
class ResidualField:
    """Mean reprojection residuals in R × K cells of the images of a camera, which show errors of its lens model."""

    centres_px: Array
    """(R, K, 2) Centres of the cells [px]."""
    mean_px: Array
    """(R, K, 2) Mean vector from observation to projection [px]; NaN in cells with too few observations."""
    counts: Indices
    """(R, K) Number of observations in each cell."""


@dataclass(frozen=True, eq=False)
class PositionComparison:
    """Positions of K cameras after alignment with the true ones by rotation, translation and scale."""

    image_names: tuple[str, ...]
    """(K,) Names of the images whose true position is known."""
    alignment: Alignment
    """Similarity from the world frame of the reconstruction to that of the true positions."""
    true_m: Array
    """(K, 3) True positions [m]."""
    aligned_m: Array
    """(K, 3) Reconstructed positions after alignment [m]."""

    @property
    def errors_m(self) -> Array:
        """(K,) Distances between the true and the aligned positions [m]."""
        return np.asarray(np.linalg.norm(self.aligned_m - self.true_m, axis=1))

    @property
    def rmse_m(self) -> float:
        """Root mean square of the distances [m]."""
        return _rms(self.errors_m)

    @property
    def extent_m(self) -> float:
        """Root mean square distance of the true positions from their mean [m]."""
        return _rms(np.linalg.norm(self.true_m - self.true_m.mean(axis=0), axis=1))

    @property
    def rmse_percent(self) -> float:
        """Root mean square of the distances as a share of the extent [%]."""
        return 100.0 * self.rmse_m / self.extent_m


def reconstruction_statistics(
    reconstructions: Sequence[Reconstruction], images: int | None = None
) -> ReconstructionStatistics:
    """Return the size and the reprojection errors of all components together.

    Args:
        reconstructions: The components.
        images: Number of images from which they were made; None if all are registered. An image that is registered in
            two components counts once.
    """
    registered = len({name for component in reconstructions for name in component.image_names})
    points = sum(len(component.points) for component in reconstructions)
    observations = sum(len(component.observation_px) for component in reconstructions)
    errors = valid_errors_px(reconstructions)
    return ReconstructionStatistics(
        images=registered if images is None else images,
        registered_images=registered,
        components=len(reconstructions),
        points=points,
        observations=observations,
        mean_track_length=observations / points if points else None,
        mean_observations_per_image=observations / registered if registered else None,
        error_median_px=float(np.median(errors)) if len(errors) else None,
        error_rms_px=_rms(errors) if len(errors) else None,
        error_p95_px=float(np.percentile(errors, 95.0)) if len(errors) else None,
        invalid_observations=observations - len(errors),
    )


def valid_errors_px(reconstructions: Sequence[Reconstruction]) -> Array:
    """Return the reprojection errors (E,) of all components [px], without those that are NaN."""
    errors = np.concatenate([np.zeros(0), *(component.reprojection_errors_px() for component in reconstructions)])
    return np.asarray(errors[np.isfinite(errors)])


def residual_field(
    reconstruction: Reconstruction,
    camera: int,
    columns: int = FIELD_COLUMNS,
    min_observations: int = MIN_CELL_OBSERVATIONS,
) -> ResidualField:
    """Return the mean residual of all images of a camera in cells that are about square.

    If the lens model is correct, residuals are random and their means are close to zero. A pattern, such as vectors
    that all point away from the centre, is an error of the intrinsics or of the distortion.

    Args:
        reconstruction: The reconstruction.
        camera: Index of the camera.
        columns: Number of columns of cells.
        min_observations: Number of observations below which a cell has no mean.
    """
    model = reconstruction.cameras[camera]
    rows = max(1, round(columns * model.height / model.width))
    residuals = reconstruction.reprojection_residuals_px()
    is_used = reconstruction.image_camera[reconstruction.observation_image] == camera
    is_used &= np.isfinite(residuals).all(axis=1)
    size, cells = np.array([model.width, model.height]), np.array([columns, rows])
    column, row = np.clip((reconstruction.observation_px[is_used] + 0.5) / size * cells, 0, cells - 1).astype(int).T
    flat = row * columns + column
    counts = np.bincount(flat, minlength=rows * columns)
    sums = np.stack([np.bincount(flat, residuals[is_used, axis], rows * columns) for axis in (0, 1)], axis=1)
    mean = np.where(counts[:, None] >= max(1, min_observations), sums / np.maximum(counts, 1)[:, None], np.nan)
    grid = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), axis=-1)
    return ResidualField(
        centres_px=(grid + 0.5) * size / cells - 0.5,
        mean_px=mean.reshape(rows, columns, 2),
        counts=counts.reshape(rows, columns).astype(np.int64),
    )


def compare_positions(reconstruction: Reconstruction, true_positions_m: Mapping[str, Array]) -> PositionComparison:
    """Return the positions of the cameras after alignment with the true ones (Sim3).

    Args:
        reconstruction: The reconstruction.
        true_positions_m: True position (3,) of the camera of images, by image name [m]; others are left out.

    Raises:
        EvaluationError: Fewer than three images have a true position, or their positions are on a straight line.
    """
    rows = [i for i, name in enumerate(reconstruction.image_names) if name in true_positions_m]
    if len(rows) < _MIN_COMMON_IMAGES:
        raise EvaluationError(
            f"{len(rows)} registered images have a true position; expected at least {_MIN_COMMON_IMAGES}"
        )
    names = tuple(reconstruction.image_names[i] for i in rows)
    true, estimated = np.stack([true_positions_m[name] for name in names]), reconstruction.positions[rows]
    alignment = umeyama(true, estimated, with_scale=True)
    return PositionComparison(names, alignment, true, alignment.positions(estimated))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
