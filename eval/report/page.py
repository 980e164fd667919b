"""The page of a run: scores, path, errors over time, consistency, cost, sample frames and provenance."""

import base64
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from matplotlib.axes import Axes

from dronevio.eval import colours
from dronevio.eval.metrics import ScoredTrajectory, Scores, nees_bounds
from dronevio.eval.metrics.scores import SCORE_METRICS
from dronevio.eval.report import plots
from dronevio.eval.report.figures import svg_plot
from dronevio.eval.report.map_section import map_section
from dronevio.eval.report.model import RunReport, RunResults
from dronevio.eval.report.path3d import path_scene
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.eval.run import tracks_of

SAMPLE_FRAMES = 4
"""Number of camera frames that the page shows."""
TAIL_FRAMES = 8
"""Number of earlier frames in which the pixels of a track are drawn."""
_LEGEND_AGES_FRAMES = (1, 3, 8, 20, 60)
_PATH_HEIGHT_IN, _PLOT_HEIGHT_IN = 3.7, 2.7


def run_page(results: RunResults, report: RunReport) -> str:
    """Return the page as HTML.

    Args:
        results: The results of the run.
        report: Its figures.
    """
    info, scored = results.info, results.scored
    return render_page(
        "run.html.j2",
        info.title,
        _summary(report),
        tiles=list(_tiles(report)),
        script="path3d.js",
        path_scene=path_scene(results.estimate, results.recording.ground_truth, results.outline, results.corrected),
        path_plots=list(_path_plots(results)),
        time_plots=list(_time_plots(results)),
        map_section=map_section(results),
        length_plots=[] if scored is None else list(_length_plots(scored)),
        consistency=None if scored is None else _consistency(scored, results.origin_ns),
        cost_plots=list(_cost_plots(results)),
        frames=list(_sample_frames(results)),
        tail_frames=TAIL_FRAMES,
        age_colours=_age_colours(np.array(_LEGEND_AGES_FRAMES)),
        open_command=info.open_command,
        provenance=list(_provenance(report)),
    )


def _tiles(report: RunReport) -> Iterator[Tile]:
    """Yield the numbers at the top of the page."""
    flight, timing, policy, control = report.flight, report.timing, report.policy, report.control
    if report.scores is not None:
        yield from _score_tiles(report.scores)
    percentile = f"processor time; 99 % of the frames take less than {number(timing.cpu_ms_p99, 1)} ms"
    yield Tile("Time per frame", number(timing.cpu_ms_mean, 1), "ms", percentile)
    factor = "seconds of flight per second of processor time"
    yield Tile("Real-time factor", number(timing.real_time_factor, 1), "×", factor)
    yield Tile("Path length", number(flight.path_m, 1), "m", f"in {number(flight.duration_s, 1)} s")
    angular_rate = f"and angular rates of up to {number(flight.peak_angular_rate_deg_s, 0)} °/s"
    yield Tile("Peak speed", number(flight.peak_speed_m_s, 2), "m/s", angular_rate)
    if control is None:
        return
    if policy is not None:
        result = "accomplished" if policy.success else "not accomplished"
        meaning = f"{number(policy.distance_m, 3)} m from the goal after {number(policy.duration_s, 2)} s"
        meaning += f", flown on the {control.flown_on}; end: {policy.end}"
        yield Tile(f"Task of {policy.environment}", result, "", meaning)
    else:
        meaning = f"r.m.s., flown on the {control.flown_on}; at most {number(control.reference_max_m, 3)} m"
        meaning += "" if control.collision is None else f"; the drone {control.collision}"
        yield Tile("Distance from the reference", number(control.reference_rmse_m, 3), "m", meaning)


def _score_tiles(scores: Scores) -> Iterator[Tile]:
    shown = {name: (metric.text(metric.of(scores)), metric.unit) for name, metric in SCORE_METRICS.items()}
    words = {"yaw": "yaw and position aligned", "none": "not aligned"}
    alignment = words.get(scores.alignment, f"alignment {scores.alignment}")
    yield Tile("ATE", *shown["ate_m"], f"r.m.s., {alignment}; {''.join(shown['ate_deg'])}")
    if scores.rpe_m is not None:
        interval = f"r.m.s. over {scores.rpe_interval}; {''.join(shown['rpe_deg'])}"
        yield Tile("RPE", *shown["rpe_m"], interval)
    yield Tile("Scale error", *shown["scale_error_percent"], "of the estimated path")
    yield Tile("Coverage", shown["coverage_percent"][0], "%", "of the frames after 3 s have a pose")


def _summary(report: RunReport) -> str:
    flight, seed = report.flight, "" if report.info.seed is None else f", seed {report.info.seed}"
    duration_s, path_m = number(flight.duration_s, 1), number(flight.path_m, 1)
    return f"{flight.frames} frames in {duration_s} s, path of {path_m} m{seed}"


def _path_plots(results: RunResults) -> Iterator[Markup]:
    estimate, truth = results.estimate, results.recording.ground_truth
    for view in (plots.TOP_VIEW, plots.SIDE_VIEW):
        draw = partial(
            plots.draw_path,
            view=view,
            estimate=estimate,
            truth=truth,
            outline=results.outline,
            corrected=results.corrected,
        )
        yield svg_plot(_PATH_HEIGHT_IN, draw, "the estimate" if truth is None else "estimate and ground truth")


def _time_plots(results: RunResults) -> Iterator[Markup]:
    estimate, truth, scored = results.estimate, results.recording.ground_truth, results.scored
    origin_ns = results.origin_ns
    if scored is not None:
        ate_m, ate_deg = scored.scores.ate_m, scored.scores.ate_deg
        alt = f"r.m.s. {ate_m.rmse:.3f} m, at most {ate_m.max:.3f} m"
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_position_error(ax, scored, origin_ns), alt)
        alt = f"r.m.s. {ate_deg.rmse:.2f}°, at most {ate_deg.max:.2f}°"
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_orientation_error(ax, scored, origin_ns), alt)
    yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_speed(ax, estimate, truth, origin_ns))
    if scored is not None:
        for quantity in filter(lambda quantity: quantity.is_known(scored), plots.STATE_ERRORS):
            draw = partial(plots.draw_state_error, quantity=quantity, scored=scored, origin_ns=origin_ns)
            yield svg_plot(_PLOT_HEIGHT_IN, draw)


def _length_plots(scored: ScoredTrajectory) -> Iterator[Markup]:
    errors = plots.length_errors(scored)
    for values, title, axis in (
        (errors.translation_percent, "Relative position error", "error [% of the length]"),
        (errors.rotation_deg, "Relative orientation error", "error [°]"),
    ):
        draw = partial(plots.draw_length_errors, labels=errors.labels, values=values, title=title, axis=axis)
        if values:
            medians = (f"{np.median(v):.2f} over {label} m" for label, v in zip(errors.labels, values, strict=True))
            yield svg_plot(_PLOT_HEIGHT_IN, draw, f"{axis}, medians {', '.join(medians)}")


def _consistency(scored: ScoredTrajectory, origin_ns: int) -> dict[str, object] | None:
    """Return the NEES with its bounds, as values and as a plot; None without covariances."""
    scores = scored.scores
    if scored.consistency is None:
        return None
    low, high = nees_bounds(3)
    rows = (
        ("position", scores.nees_position, scores.nees_position_inside_percent, scores.position_beyond_3_sigma_percent),
        (
            "orientation",
            scores.nees_orientation,
            scores.nees_orientation_inside_percent,
            scores.orientation_beyond_3_sigma_percent,
        ),
    )
    return {
        "low": low,
        "high": high,
        "rows": [dict(zip(("name", "mean", "inside", "beyond"), row, strict=True)) for row in rows],
        "plot": svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_nees(ax, scored, origin_ns)),
    }


def _cost_plots(results: RunResults) -> Iterator[Markup]:
    interval_ms = 1e3 / results.recording.rig.cameras[0].rate_hz

    def over_time(ax: Axes) -> None:
        plots.draw_cost(ax, results.run, results.origin_ns, interval_ms)

    yield svg_plot(_PLOT_HEIGHT_IN, over_time)
    if len(results.run.cpu_ms):
        yield svg_plot(_PLOT_HEIGHT_IN, lambda ax: plots.draw_cost_histogram(ax, results.run))


@dataclass(frozen=True)
class Track:
    """A feature track in a sample frame."""

    colour: str
    """Colour by age, as ``#rrggbb``."""
    tail: list[tuple[float, float]]
    """Pixels in the last frames, in time order up to the sample frame."""


@dataclass(frozen=True)
class SampleFrame:
    """A camera frame with its feature tracks."""

    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    caption: str
    """Time, number and age of the tracks, in words."""
    jpeg_base64: str
    """The image as JPEG in base64."""
    tracks: list[Track]
    """The tracks of the frame."""


def _sample_frames(results: RunResults) -> Iterator[SampleFrame]:
    """Yield frames that are evenly spread over those that have a pose, or over all if none has."""
    estimates = results.run.estimates
    candidates = [i for i, e in enumerate(estimates) if e.state is not None] or list(range(len(estimates)))
    shares = (np.arange(SAMPLE_FRAMES) + 0.5) / SAMPLE_FRAMES
    for index in sorted({candidates[int(share * len(candidates))] for share in shares}):
        frame = results.recording.frame(index)
        if not frame.images[0].size:
            continue  # the camera has no image at this time
        height, width = frame.images[0].shape
        seconds = (frame.t_ns - results.origin_ns) * 1e-9
        ages = tracks_of(estimates[index]).ages
        caption = f"{seconds:.2f} s: {len(ages)} tracks" + (f", median age {np.median(ages):.0f}" if len(ages) else "")
        yield SampleFrame(width, height, caption, _jpeg_base64(frame.images[0]), _tracks(results, index))


def _tracks(results: RunResults, index: int) -> list[Track]:
    """Return the tracks of a frame with their pixels in the last frames."""
    tracks = tracks_of(results.run.estimates[index])
    recent = [tracks_of(estimate) for estimate in results.run.estimates[max(0, index - TAIL_FRAMES) : index + 1]]
    pixels = [dict(zip(t.ids.tolist(), t.pixels.tolist(), strict=True)) for t in recent]
    return [
        Track(colour, [(x, y) for of_frame in pixels if track_id in of_frame for x, y in (of_frame[track_id],)])
        for track_id, colour in zip(tracks.ids.tolist(), _age_colours(tracks.ages), strict=True)
    ]


def _jpeg_base64(image: npt.NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return base64.b64encode(data.tobytes()).decode("ascii")


def _age_colours(ages_frames: npt.NDArray[np.int64]) -> list[str]:
    """Return the colours of tracks of some ages as ``#rrggbb``."""
    return ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in colours.age_colours(ages_frames).tolist()]


def _provenance(report: RunReport) -> Iterator[tuple[str, object, bool]]:
    """Yield title and content of the tables at the end of the page, and whether each is open."""
    info, values = report.info, report.values
    run = {"command": info.command, "seed": "none: a recording" if info.seed is None else str(info.seed)}
    for title, content in (
        ("Run", run),
        ("Estimator", values["estimator"]),
        ("Defects of the recording", report.defects),
        ("Scores", values["scores"]),
        ("Configuration", info.configuration),
        ("Versions", info.versions),
        ("Machine", info.machine),
    ):
        if content:
            yield title, content, title in ("Run", "Versions", "Machine")
