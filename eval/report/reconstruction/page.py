"""The page of a reconstruction: numbers, pictures of points and cameras, errors, tracks, photographs and tables."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from markupsafe import Markup

from dronevio.eval.metrics.reconstruction import ReconstructionStatistics, residual_field
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.figures import as_svg, figure, svg_plot
from dronevio.eval.report.reconstruction import clouds, plots, tables
from dronevio.eval.report.reconstruction.model import (
    ComponentPositions,
    ReconstructionResults,
    camera_summaries,
    image_summaries,
    position_comparisons,
)
from dronevio.eval.report.reconstruction.photographs import hex_colours, photographs
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.eval.scene import VIEW_ASPECT, ResidualStyle
from dronevio.models.reconstruction import Reconstruction

MAX_COMPONENTS = 3
"""Number of components of which the page shows pictures."""
MAX_FIELDS = 4
"""Number of cameras whose residual fields the page shows, those with the most observations."""
_CLOUD_HEIGHT_IN, _PLOT_HEIGHT_IN, _MATRIX_HEIGHT_IN = 3.7, 2.7, 4.2
_PERSPECTIVE_WIDTH_IN = 9.6


def reconstruction_page(info: RunInfo, results: ReconstructionResults) -> str:
    """Return the page as HTML."""
    statistics = results.statistics
    style = ResidualStyle.of(results.components)
    shown = results.components[:MAX_COMPONENTS]
    positions = list(position_comparisons(results))
    return render_page(
        "reconstruction.html.j2",
        info.title,
        _summary(statistics),
        script="report.js",
        tiles=list(_tiles(statistics, results)),
        component_table=tables.component_table(results) if len(results.components) > 1 else None,
        components=[_component_pictures(i, component, results) for i, component in enumerate(shown)],
        hidden_components=len(results.components) - len(shown),
        up_is_estimated=results.up is None,
        number_plots=list(_number_plots(results)),
        field_plots=list(_field_plots(results)),
        photographs=list(photographs(results, style)),
        style=style,
        scale_colours=hex_colours(np.linspace(0.0, 1.0, 5), 1.0),
        match_plot=_match_plot(results),
        positions=[(p.component, p.reason) for p in positions if p.comparison is None],
        position_table=tables.position_table(positions),
        position_plots=list(_position_plots(positions)),
        origin=results.origin,
        georeference_table=tables.georeference_table(results),
        measured_position_table=tables.measured_position_table(results),
        georeference_notes=list(_georeference_notes(results)),
        camera_table=tables.camera_table(results),
        image_table=tables.image_table(results),
        unregistered=tables.unregistered_table(results),
        times=tables.time_table(results),
        open_command=info.open_command,
        provenance=list(_provenance(info)),
    )


def perspective(component: Reconstruction) -> Markup:
    """Return a wide picture of an upright component as an ``<svg>`` element."""
    with figure(_PERSPECTIVE_WIDTH_IN, _PERSPECTIVE_WIDTH_IN / VIEW_ASPECT) as (fig, axes):
        fig.set_dpi(clouds.RASTER_DPI)
        clouds.draw_perspective(axes[0], component)
    cameras, points = len(component.image_names), len(component.points)
    return as_svg(fig, f"Perspective view of {points} points and {cameras} cameras")


def _summary(statistics: ReconstructionStatistics) -> str:
    components = "" if statistics.components == 1 else f" in {statistics.components} components"
    return (
        f"{statistics.registered_images} of {statistics.images} images registered{components}, "
        f"{statistics.points} points, {statistics.observations} observations"
    )


def _tiles(statistics: ReconstructionStatistics, results: ReconstructionResults) -> Iterator[Tile]:
    """Yield the numbers at the top of the page."""
    components = statistics.components
    note = "in one component" if components == 1 else f"in {components} components"
    yield Tile("Registered images", str(statistics.registered_images), f"of {statistics.images}", note)
    rest = f"median; r.m.s. {number(statistics.error_rms_px, 2)} px, 95 % below {number(statistics.error_p95_px, 2)} px"
    yield Tile("Reprojection error", number(statistics.error_median_px, 2), "px", rest)
    yield Tile("Points", f"{statistics.points}", "", f"from {statistics.observations} observations")
    per_image = f"{number(statistics.mean_observations_per_image, 0)} observations per image"
    yield Tile("Mean track length", number(statistics.mean_track_length, 2), "images", per_image)
    if results.times_s:
        yield Tile("Processing time", number(sum(results.times_s.values()), 1), "s", "sum of all stages")
    invalid = statistics.invalid_observations
    if invalid:
        yield Tile("Invalid observations", str(invalid), "", "whose point does not project into the image")


@dataclass(frozen=True)
class ComponentPictures:
    """The pictures of one component."""

    title: str
    """Heading of the pictures."""
    perspective: Markup
    """Wide picture as seen from behind the cameras."""
    views: list[Markup]
    """Orthographic views from above and from the side."""


def _component_pictures(index: int, component: Reconstruction, results: ReconstructionResults) -> ComponentPictures:
    upright = clouds.upright(component, results.up)
    counts = f"{len(component.image_names)} images, {len(component.points)} points"
    views = []
    for view in (clouds.FROM_ABOVE, clouds.FROM_SIDE):
        with figure(4.8, _CLOUD_HEIGHT_IN) as (fig, axes):
            fig.set_dpi(clouds.RASTER_DPI)
            clouds.draw_cloud(axes[0], view, upright, results.unit)
        views.append(as_svg(fig, f"{view.title}: {counts}"))
    return ComponentPictures(f"Component {index + 1}: {counts}", perspective(upright), views)


def _field_plots(results: ReconstructionResults) -> Iterator[Markup]:
    """Yield the residual fields of the cameras with the most observations."""
    cameras = [(component, camera) for component in results.components for camera in range(len(component.cameras))]
    summaries = camera_summaries(results)
    order = sorted(range(len(cameras)), key=lambda i: -summaries[i].observations)[:MAX_FIELDS]
    for index in order:
        component, camera = cameras[index]
        field, model = residual_field(component, camera), component.cameras[camera]
        title = f"Mean residuals, camera {index + 1}"
        draw = partial(plots.draw_residual_field, field=field, model=model, title=title)
        yield svg_plot(1.0 + 3.9 * min(model.height / model.width, 1.0), draw)


def _number_plots(results: ReconstructionResults) -> Iterator[Markup]:
    """Yield the plots of errors, track lengths, and numbers of the images."""
    errors_px = np.concatenate([np.zeros(0), *results.errors_px])
    errors_px = errors_px[np.isfinite(errors_px)]
    if len(errors_px):
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_error_histogram(ax, errors_px))
    lengths = np.concatenate([np.zeros(0, np.int64), *(c.track_lengths() for c in results.components)])
    if lengths.any():
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_track_lengths(ax, lengths))
    images = {summary.name: summary for summary in image_summaries(results)}
    counts = [images[name].observations if name in images else 0 for name in results.image_names]
    medians = [images[name].error_median_px if name in images else None for name in results.image_names]
    if any(counts):
        errors = [np.nan if median is None else median for median in medians]
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_observations_per_image(ax, counts))
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_error_per_image(ax, errors))


def _match_plot(results: ReconstructionResults) -> Markup | None:
    counts = results.match_counts
    if counts is None or not len(counts):
        return None
    pairs = int(np.sum(np.triu(counts, 1) > 0))
    with figure(4.8, _MATRIX_HEIGHT_IN) as (fig, axes):
        fig.set_dpi(clouds.RASTER_DPI)
        plots.draw_match_counts(axes[0], counts)
    return as_svg(fig, f"Verified matches of {pairs} pairs of {len(counts)} images")


def _georeference_notes(results: ReconstructionResults) -> Iterator[str]:
    """Yield what was left out of the measured positions, and how gimbals compare with the result."""
    georeferences = [geo for geo in results.georeferences if geo is not None]
    yield from dict.fromkeys(note for geo in georeferences for note in geo.notes)
    for geo in georeferences:
        if geo.gimbal_deviation_deg is not None:
            tilt, yaw = (number(value, 2) for value in geo.gimbal_deviation_deg)
            yield f"the gimbals differ from the estimated orientations by {tilt}° in tilt and {yaw}° in yaw (medians)"


def _position_plots(positions: list[ComponentPositions]) -> Iterator[Markup]:
    for item in positions[:MAX_COMPONENTS]:
        comparison = item.comparison
        if comparison is not None:
            alt = f"r.m.s. {comparison.rmse_m:.3g} m"
            yield svg_plot(_CLOUD_HEIGHT_IN, partial(plots.draw_positions, comparison=comparison), alt)
            yield svg_plot(_CLOUD_HEIGHT_IN, partial(plots.draw_position_errors, comparison=comparison), alt)


def _provenance(info: RunInfo) -> Iterator[tuple[str, Mapping[str, object], bool]]:
    """Yield title and content of the tables at the end of the page, and whether each is open."""
    run: dict[str, object] = {"command": info.command}
    if info.seed is not None:
        run["seed"] = info.seed
    for title, content in (
        ("Run", run),
        ("Configuration", info.configuration),
        ("Versions", info.versions),
        ("Machine", info.machine),
    ):
        if content:
            yield title, content, title != "Configuration"
