"""The results that the report of a reconstruction shows, and their form in ``report.json``.

``report.json`` holds the following keys; values are ``null`` where they are not known:

    format         "dronevio-reconstruction-report/1"
    title, command, open_command, seed          as in `RunInfo`
    statistics     the fields of `ReconstructionStatistics`
    components     images, points, observations of each component
    cameras        component, images, observations, error_median_px of each camera, the fields of `CameraModel`, and
                   those of `SelfCalibration`, null for calibrated cameras
    images         name, component, camera, observations, error_median_px of each registered image
    unregistered   {image: reason}
    times_s        {stage: processing time}
    unit           unit of the world frames, such as m; empty if their scale is arbitrary
    up             up direction in the world frames, three numbers; null if it is not known
    positions      component, images, rmse_m, extent_m, rmse_percent, scale, reason of each component; empty without
                   true positions; the reason is null unless positions cannot be compared
    origin         latitude_deg, longitude_deg, altitude_m and reference of the origin of the world frame, in which x
                   points east, y north and z up; null if it is not known
    georeferences  component and the fields of `GeoReference` of each component that measured positions determine
    configuration, versions, machine            as in `RunInfo`
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.reconstruction import (
    PositionComparison,
    ReconstructionStatistics,
    compare_positions,
    reconstruction_statistics,
)
from dronevio.eval.provenance import RunInfo
from dronevio.models.arrays import Array, Image
from dronevio.models.camera import CameraModel
from dronevio.models.errors import EvaluationError
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.georeference import GeoReference
from dronevio.models.reconstruction import Reconstruction, SelfCalibration
from dronevio.models.serialization import to_jsonable

Indices = npt.NDArray[np.int64]
ReadImage = Callable[[str], Image | None]
"""Function that returns the image (H, W) or (H, W, 3) of a name, or None if there is none."""

FORMAT = "dronevio-reconstruction-report/1"


@dataclass(frozen=True, eq=False)
class ReconstructionResults:
    """Everything that the report of a reconstruction shows."""

    components: Sequence[Reconstruction]
    """The components of the reconstruction, each with a world frame of its own."""
    all_image_names: Sequence[str] | None = None
    """(I,) Names of all images in their order, registered or not; None if all are registered."""
    unregistered: Mapping[str, str] = field(default_factory=dict)
    """Reasons why images are not registered, by image name."""
    times_s: Mapping[str, float] = field(default_factory=dict)
    """Processing time of each stage by its name [s]."""
    match_counts: Indices | None = None
    """(I, I) Number of verified matches between each two images; None if it is not known."""
    read_image: ReadImage | None = None
    """Function that returns the image of a name; None to draw observations without images."""
    true_positions_m: Mapping[str, Array] = field(default_factory=dict)
    """True positions (3,) of cameras in a frame with z up, by image name [m]."""
    up: Array | None = None
    """(3,) Up direction in the world frames of the components; None to estimate it from the cameras."""
    unit: str = ""
    """Unit of the world frames, such as m; empty if their scale is arbitrary."""
    calibrations: Sequence[Sequence[SelfCalibration | None]] = ()
    """Which parameters of each camera of each component were estimated; None for calibrated ones, empty if unknown."""
    origin: GeodeticPoint | None = None
    """Where the origin of the world frame is on Earth, with x east, y north and z up; None if it is unknown."""
    georeferences: Sequence[GeoReference | None] = ()
    """How measured positions determine the world frame of each component; empty if they do not."""

    def __post_init__(self) -> None:
        """Check that the fields belong to each other.

        Raises:
            EvaluationError: A registered image is not among all images, or the matches have another shape.
        """
        missing = {name for component in self.components for name in component.image_names} - set(self.image_names)
        if missing:
            raise EvaluationError(f"image {min(missing)!r} is registered, but not in the list of all images")
        count = len(self.image_names)
        if self.match_counts is not None and self.match_counts.shape != (count, count):
            raise EvaluationError(f"match counts of shape {self.match_counts.shape}; expected ({count}, {count})")

    @property
    def image_names(self) -> tuple[str, ...]:
        """Names of all images in their order."""
        if self.all_image_names is not None:
            return tuple(self.all_image_names)
        registered = (name for component in self.components for name in component.image_names)
        return tuple(dict.fromkeys([*registered, *self.unregistered]))

    @cached_property
    def residuals_px(self) -> tuple[Array, ...]:
        """Residuals (M, 2) of the observations of each component, from observation to projection [px]."""
        return tuple(component.reprojection_residuals_px() for component in self.components)

    @property
    def errors_px(self) -> tuple[Array, ...]:
        """Reprojection errors (M,) of the observations of each component [px]."""
        return tuple(np.linalg.norm(residuals, axis=1) for residuals in self.residuals_px)

    @cached_property
    def statistics(self) -> ReconstructionStatistics:
        """Size and reprojection errors of all components together."""
        return reconstruction_statistics(self.components, len(self.image_names))

    def reasons(self) -> dict[str, str | None]:
        """Return the images without a pose, with the reason if it is known."""
        registered = {name for component in self.components for name in component.image_names}
        unregistered = {name: self.unregistered.get(name) for name in self.image_names if name not in registered}
        return unregistered | dict(self.unregistered)


@dataclass(frozen=True)
class ImageSummary:
    """Numbers of one registered image."""

    name: str
    """Name of the image."""
    component: int
    """Number of its component, from 1 on."""
    camera: int
    """Number of its camera, from 1 on; cameras are counted over all components."""
    observations: int
    """Number of its observations."""
    error_median_px: float | None
    """Median of its reprojection errors [px]; None without observations."""


@dataclass(frozen=True)
class CameraSummary:
    """Numbers of one camera."""

    component: int
    """Number of its component, from 1 on."""
    images: int
    """Number of its registered images."""
    observations: int
    """Number of observations in its images."""
    error_median_px: float | None
    """Median of its reprojection errors [px]; None without observations."""
    model: CameraModel
    """Intrinsics of the camera."""
    calibration: SelfCalibration | None = None
    """Which of them were estimated; None if they were given."""


@dataclass(frozen=True, eq=False)
class ComponentPositions:
    """Comparison of the positions of a component with the true ones."""

    component: int
    """Number of the component, from 1 on."""
    comparison: PositionComparison | None
    """Aligned positions; None if they cannot be compared."""
    reason: str = ""
    """Reason why they cannot be compared."""


def image_summaries(results: ReconstructionResults) -> list[ImageSummary]:
    """Return the numbers of each registered image, by component."""
    summaries, first_camera = [], 1
    for number, (component, errors) in enumerate(zip(results.components, results.errors_px, strict=True), start=1):
        for i, name in enumerate(component.image_names):
            of_image = errors[component.observation_image == i]
            camera = first_camera + int(component.image_camera[i])
            summaries.append(ImageSummary(name, number, camera, len(of_image), _median(of_image)))
        first_camera += len(component.cameras)
    return summaries


def camera_summaries(results: ReconstructionResults) -> list[CameraSummary]:
    """Return the numbers of each camera, by component."""
    summaries = []
    for number, (component, errors) in enumerate(zip(results.components, results.errors_px, strict=True), start=1):
        camera_of_observation = component.image_camera[component.observation_image]
        for index, model in enumerate(component.cameras):
            of_camera = errors[camera_of_observation == index]
            images = int(np.sum(component.image_camera == index))
            calibration = results.calibrations[number - 1][index] if results.calibrations else None
            summaries.append(CameraSummary(number, images, len(of_camera), _median(of_camera), model, calibration))
    return summaries


def position_comparisons(results: ReconstructionResults) -> Iterator[ComponentPositions]:
    """Yield the comparison of each component with the true positions; nothing without true positions."""
    if not results.true_positions_m:
        return
    for number, component in enumerate(results.components, start=1):
        try:
            yield ComponentPositions(number, compare_positions(component, results.true_positions_m))
        except EvaluationError as error:
            yield ComponentPositions(number, None, str(error))


def report_values(info: RunInfo, results: ReconstructionResults) -> dict[str, object]:
    """Return the content of ``report.json``."""
    return {
        "format": FORMAT,
        "title": info.title,
        "command": info.command,
        "open_command": info.open_command,
        "seed": info.seed,
        "statistics": asdict(results.statistics),
        "components": [
            {"images": len(c.image_names), "points": len(c.points), "observations": len(c.observation_px)}
            for c in results.components
        ],
        "cameras": [_camera_values(summary) for summary in camera_summaries(results)],
        "images": [asdict(summary) for summary in image_summaries(results)],
        "unregistered": results.reasons(),
        "times_s": dict(results.times_s),
        "unit": results.unit,
        "up": None if results.up is None else results.up.tolist(),
        "positions": [_position_values(positions) for positions in position_comparisons(results)],
        "origin": None if results.origin is None else asdict(results.origin),
        "georeferences": [
            {"component": number, **_georeference_values(geo)}
            for number, geo in enumerate(results.georeferences, start=1)
            if geo is not None
        ],
        "configuration": info.configuration,
        "versions": info.versions,
        "machine": info.machine,
    }


def _georeference_values(geo: GeoReference) -> dict[str, object]:
    values = to_jsonable(geo)
    assert isinstance(values, dict)
    values["residuals_m"] = [[v if math.isfinite(v) else None for v in row] for row in geo.residuals_m.tolist()]
    return values


def _camera_values(summary: CameraSummary) -> dict[str, object]:
    values = asdict(summary)
    model, calibration = values.pop("model"), values.pop("calibration") or {"sigmas": None, "held": None}
    return {**values, **model, **calibration}


def _position_values(positions: ComponentPositions) -> dict[str, object]:
    comparison = positions.comparison
    return {
        "component": positions.component,
        "images": None if comparison is None else len(comparison.image_names),
        "rmse_m": None if comparison is None else comparison.rmse_m,
        "extent_m": None if comparison is None else comparison.extent_m,
        "rmse_percent": None if comparison is None else comparison.rmse_percent,
        "scale": None if comparison is None else comparison.alignment.scale,
        "reason": positions.reason or None,
    }


def _median(errors: Array) -> float | None:
    finite = errors[np.isfinite(errors)]
    return float(np.median(finite)) if len(finite) else None
