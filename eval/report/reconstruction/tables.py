"""Tables of the report of a reconstruction: components, cameras, images, positions and processing times."""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dronevio.eval.metrics.metric import DASH
from dronevio.eval.report.reconstruction.model import (
    ComponentPositions,
    ReconstructionResults,
    camera_summaries,
    image_summaries,
)
from dronevio.eval.report.tables import Cell, Table
from dronevio.eval.report.templating import number
from dronevio.models.arrays import Array


def component_table(results: ReconstructionResults) -> Table:
    """Return the size of each component."""
    rows = tuple(
        (
            _count(index),
            _count(len(component.image_names)),
            _count(len(component.points)),
            _count(len(component.observation_px)),
        )
        for index, component in enumerate(results.components, start=1)
    )
    return Table("Components", ("component", "images", "points", "observations"), rows)


def camera_table(results: ReconstructionResults) -> Table:
    """Return the intrinsics of each camera with the number of its images and its median reprojection error."""
    columns = ("camera", "images", "error [px]", "size [px]", "fx [px]", "fy [px]", "cx [px]", "cy [px]", "lens")
    rows = []
    for index, summary in enumerate(camera_summaries(results), start=1):
        model = summary.model
        sigmas, held = (summary.calibration.sigmas, summary.calibration.held) if summary.calibration else ({}, ())
        focal = _value(model.fx, 2)
        if "f" in sigmas:
            focal = replace(focal, detail=f"± {sigmas['f']:.2g}")
        rows.append(
            (
                _count(index),
                _count(summary.images),
                _value(summary.error_median_px, 2),
                Cell(f"{model.width} × {model.height}"),
                replace(focal, warning="not determined by the images" if "f" in held else ""),
                *(_value(value, 2) for value in (model.fy, model.cx, model.cy)),
                Cell(model.lens, detail=", ".join(f"{value:.4g}".replace("-", "−") for value in model.distortion)),
            )
        )
    return Table("Cameras", columns, tuple(rows))


def image_table(results: ReconstructionResults) -> Table:
    """Return the registered images with their observations and their median reprojection errors."""
    several = len(results.components) > 1
    columns = ("image", *(("component",) if several else ()), "camera", "observations", "error [px]")
    rows = tuple(
        (
            Cell(summary.name),
            *((_count(summary.component),) if several else ()),
            _count(summary.camera),
            _count(summary.observations),
            _value(summary.error_median_px, 2),
        )
        for summary in image_summaries(results)
    )
    return Table("Registered images", columns, rows)


def unregistered_table(results: ReconstructionResults) -> Table:
    """Return the images that are not registered, with their reasons."""
    rows = tuple((Cell(name), Cell(reason or DASH)) for name, reason in results.reasons().items())
    return Table("Images without a pose", ("image", "reason"), rows, text_columns=frozenset((1,)))


def position_table(positions: Sequence[ComponentPositions]) -> Table:
    """Return the position errors of the components that can be compared with true positions."""
    columns = ("component", "images", "RMSE [m]", "RMSE [% of the extent]", "largest [m]", "scale")
    rows = tuple(
        (
            _count(item.component),
            _count(len(comparison.image_names)),
            Cell(f"{comparison.rmse_m:.4g}", order=comparison.rmse_m),
            Cell(f"{comparison.rmse_percent:.3g}", order=comparison.rmse_percent),
            Cell(f"{comparison.errors_m.max():.4g}", order=float(comparison.errors_m.max())),
            Cell(f"{comparison.alignment.scale:.6g}", order=comparison.alignment.scale),
        )
        for item in positions
        if (comparison := item.comparison) is not None
    )
    return Table("Positions against the true ones", columns, rows)


def georeference_table(results: ReconstructionResults) -> Table:
    """Return how well measured positions determine the world frame of each component."""
    columns = (
        "component",
        "positions",
        "outliers",
        "residuals, RMS east, north, up [m]",
        "factor on their σ",
        "σ of the scale [%]",
        "σ of north [°]",
        "σ of the vertical [°]",
    )
    rows = tuple(
        (
            _count(index),
            Cell(str(len(geo.image_names) + len(geo.point_names)), detail=geo.source),
            _count(int(geo.is_outlier.sum() + geo.point_is_outlier.sum())),
            Cell(", ".join(f"{value:.3g}" for value in _rms(np.concatenate([geo.residuals_m, geo.point_residuals_m])))),
            _value(geo.noise_factor, 2),
            _value(100.0 * geo.scale_sigma, 3),
            _value(math.degrees(geo.north_sigma_rad), 3),
            _value(math.degrees(geo.tilt_sigma_rad), 3),
        )
        for index, geo in enumerate(results.georeferences, start=1)
        if geo is not None
    )
    return Table("World frame by measured positions", columns, rows)


def measured_position_table(results: ReconstructionResults) -> Table:
    """Return the residuals of the measured positions of images and of control points."""
    columns = ("position", "east [m]", "north [m]", "up [m]", "error [px]")
    rows = []
    for geo in results.georeferences:
        if geo is None:
            continue
        points = zip(geo.point_names, geo.point_residuals_m, geo.point_errors_px, geo.point_is_outlier, strict=True)
        images = zip(geo.image_names, geo.residuals_m, geo.is_outlier, strict=True)
        listed: list[tuple[str, Array, float | None, bool]] = [
            (f"control point {name}", r, float(px), out) for name, r, px, out in points
        ]
        listed += [(name, r, None, out) for name, r, out in images]
        for name, residual, error_px, is_outlier in listed:
            values = (_value(float(v) if math.isfinite(v) else None, 3) for v in residual)
            rows.append((Cell(name, warning="outlier" if is_outlier else ""), *values, _value(error_px, 2)))
    return Table("Measured minus estimated positions", columns, tuple(rows))


def _rms(residuals: Array) -> Array:
    """Return the root mean square (3,) of residuals (N, 3), NaN left out."""
    known = np.isfinite(residuals)
    squares = np.where(known, residuals, 0.0) ** 2
    return np.asarray(np.sqrt(squares.sum(axis=0) / np.maximum(known.sum(axis=0), 1)))


def time_table(results: ReconstructionResults) -> Table:
    """Return the processing time of each stage with its share, and their sum."""
    total = sum(results.times_s.values())
    rows = tuple(
        (Cell(stage), _value(seconds, 2), _value(100.0 * seconds / total if total > 0.0 else None, 1))
        for stage, seconds in results.times_s.items()
    )
    sums = (Cell("all stages"), _value(total, 2), Cell("100"))
    return Table("Processing times", ("stage", "time [s]", "share [%]"), rows, sums if len(rows) > 1 else ())


def _count(value: int) -> Cell:
    return Cell(str(value), order=float(value))


def _value(value: float | None, decimals: int) -> Cell:
    return Cell(number(value, decimals), order=float("inf") if value is None else value)
