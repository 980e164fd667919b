"""The page of a run's report: the scores first, then what the flight, its errors and their cost looked like."""

import base64
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
import numpy.typing as npt
from markupsafe import Markup
from matplotlib.axes import Axes

from dronevio.eval import style as palette
from dronevio.eval.metrics import ScoredTrajectory, nees_bounds
from dronevio.eval.report import plots as report_plots
from dronevio.eval.report.figures import drawing
from dronevio.eval.report.model import Subject
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.eval.run import tracks_of

SAMPLE_FRAMES = 4
TAIL_FRAMES = 8  # how far back the tail of a track reaches
_LEGEND_AGES_FRAMES = (1, 3, 8, 20, 60)
_PATH_IN, _GRAPH_IN = 3.7, 2.7  # heights of drawings


def page(subject: Subject, numbers: Mapping[str, object]) -> str:
    """Return the page as HTML."""
    info, scored = subject.info, subject.scored
    return render_page(
        "run.html.j2",
        info.title,
        _summary(numbers),
        tiles=list(_tiles(numbers)),
        path=list(_path_drawings(subject)),
        over_time=list(_time_drawings(subject)),
        by_length=[] if scored is None else list(_length_drawings(scored)),
        consistency=None if scored is None else _consistency(scored, subject.origin_ns),
        cost=list(_cost_drawings(subject)),
        frames=list(_frames(subject)),
        tail_frames=TAIL_FRAMES,
        age_colours=_colours(np.array(_LEGEND_AGES_FRAMES)),
        open_command=info.open_command,
        provenance=list(_provenance(subject, numbers)),
    )


def _tiles(numbers: Mapping[str, object]) -> Iterator[Tile]:
    """Yield the numbers that stand at the top of the page."""
    flight, timing = _part(numbers, "flight"), _part(numbers, "timing")
    if numbers["scores"] is not None:
        yield from _score_tiles(_part(numbers, "scores"))
    most = f"processor time; 99 % take under {number(timing['cpu_ms_p99'], 1)} ms"
    yield Tile("Time a frame", number(timing["cpu_ms_mean"], 1), "ms", most)
    yield Tile("Real-time factor", number(timing["real_time_factor"], 1), "×", "seconds of flight a second of one core")
    yield Tile("Path", number(flight["path_m"], 1), "m", f"in {number(flight['duration_s'], 1)} s")
    turning = f"turning at up to {number(flight['peak_turn_rate_deg_s'], 0)} °/s"
    yield Tile("Peak speed", number(flight["peak_speed_m_s"], 2), "m/s", turning)


def _score_tiles(scores: Mapping[str, object]) -> Iterator[Tile]:
    ate, ate_deg = _part(scores, "ate_m"), _part(scores, "ate_deg")
    how = {"yaw": "yaw and position aligned", "none": "not aligned"}.get(
        str(scores["alignment"]), f"{scores['alignment']} aligned"
    )
    yield Tile("ATE", number(ate["rmse"], 3), "m", f"r.m.s., {how}; {number(ate_deg['rmse'], 2)}°")
    if scores["rpe_m"] is not None:
        rpe, rpe_deg = _part(scores, "rpe_m"), _part(scores, "rpe_deg")
        over = f"r.m.s. over {scores['rpe_over']}; {number(rpe_deg['rmse'], 2)}°"
        yield Tile("RPE", number(rpe["rmse"], 3), "m", over)
    yield Tile("Scale error", number(scores["scale_error_percent"], 2, sign=True), "%", "of the estimated path")
    yield Tile("Coverage", number(scores["coverage_percent"], 1), "%", "of the frames later than 3 s have a pose")


def _summary(numbers: Mapping[str, object]) -> str:
    flight = _part(numbers, "flight")
    seed = "" if numbers["seed"] is None else f", seed {numbers['seed']}"
    duration_s, path_m = number(flight["duration_s"], 1), number(flight["path_m"], 1)
    return f"{flight['frames']} frames in {duration_s} s, {path_m} m flown{seed}"


def _path_drawings(subject: Subject) -> Iterator[Markup]:
    estimate, truth = subject.estimate, subject.recording.ground_truth
    for side in (report_plots.ABOVE, report_plots.FRONT):
        draw = partial(report_plots.draw_path, side=side, estimate=estimate, truth=truth, outline=subject.outline)
        yield drawing(_PATH_IN, draw, "the estimate" if truth is None else "the estimate on the truth")


def _time_drawings(subject: Subject) -> Iterator[Markup]:
    estimate, truth, scored = subject.estimate, subject.recording.ground_truth, subject.scored
    origin_ns = subject.origin_ns
    if scored is not None:
        ate_m, ate_deg = scored.scores.ate_m, scored.scores.ate_deg
        alt = f"r.m.s. {ate_m.rmse:.3f} m, at most {ate_m.max:.3f} m"
        yield drawing(_GRAPH_IN, lambda ax: report_plots.draw_position_error(ax, scored, origin_ns), alt)
        alt = f"r.m.s. {ate_deg.rmse:.2f}°, at most {ate_deg.max:.2f}°"
        yield drawing(_GRAPH_IN, lambda ax: report_plots.draw_orientation_error(ax, scored, origin_ns), alt)
    yield drawing(_GRAPH_IN, lambda ax: report_plots.draw_speed(ax, estimate, truth, origin_ns))
    if scored is not None:
        for what in filter(lambda what: what.known(scored), report_plots.STATE_ERRORS):
            draw = partial(report_plots.draw_state_error, what=what, scored=scored, origin_ns=origin_ns)
            yield drawing(_GRAPH_IN, draw)


def _length_drawings(scored: ScoredTrajectory) -> Iterator[Markup]:
    errors = report_plots.errors_by_length(scored)
    for values, title, axis in (
        (errors.translation_percent, "Relative position error", "of the length [%]"),
        (errors.rotation_deg, "Relative orientation error", "orientation error [°]"),
    ):
        draw = partial(report_plots.draw_length_errors, labels=errors.labels, values=values, title=title, axis=axis)
        if values:
            medians = (f"{np.median(v):.2f} after {label} m" for label, v in zip(errors.labels, values, strict=True))
            yield drawing(_GRAPH_IN, draw, f"{axis}, medians {', '.join(medians)}")


def _consistency(scored: ScoredTrajectory, origin_ns: int) -> dict[str, object] | None:
    """Return whether errors are as large as claimed, in numbers and as a drawing; None where nothing is claimed."""
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
        "drawing": drawing(_GRAPH_IN, lambda ax: report_plots.draw_nees(ax, scored, origin_ns)),
    }


def _cost_drawings(subject: Subject) -> Iterator[Markup]:
    interval_ms = 1e3 / subject.recording.rig.cameras[0].rate_hz

    def over_time(ax: Axes) -> None:
        report_plots.draw_cost(ax, subject.run, subject.origin_ns, interval_ms)

    yield drawing(_GRAPH_IN, over_time)
    if len(subject.run.cpu_ms):
        yield drawing(_GRAPH_IN, lambda ax: report_plots.draw_cost_histogram(ax, subject.run))


@dataclass(frozen=True)
class Track:
    """A feature track in a sample frame."""

    colour: str
    """Its colour, by age."""
    tail: list[tuple[float, float]]
    """Its pixels in the last frames, in time order up to this one."""


@dataclass(frozen=True)
class SampleFrame:
    """A frame with its feature tracks."""

    width: int
    """Width of the image [px]."""
    height: int
    """Height of the image [px]."""
    caption: str
    """Time and number of tracks, in words."""
    jpeg_base64: str
    """The image as JPEG, base64."""
    tracks: list[Track]
    """The feature tracks of the frame."""


def _frames(subject: Subject) -> Iterator[SampleFrame]:
    """Yield sample frames, evenly spread over those that have a pose, with their tracks."""
    estimates = subject.run.estimates
    candidates = [i for i, e in enumerate(estimates) if e.state is not None] or list(range(len(estimates)))
    shares = (np.arange(SAMPLE_FRAMES) + 0.5) / SAMPLE_FRAMES
    for index in sorted({candidates[int(share * len(candidates))] for share in shares}):
        frame = subject.recording.frame(index)
        height, width = frame.images[0].shape
        seconds = (frame.t_ns - subject.origin_ns) * 1e-9
        ages = tracks_of(estimates[index]).ages
        caption = f"{seconds:.2f} s: {len(ages)} tracks" + (f", median age {np.median(ages):.0f}" if len(ages) else "")
        yield SampleFrame(width, height, caption, _jpeg_base64(frame.images[0]), _tracks(subject, index))


def _tracks(subject: Subject, index: int) -> list[Track]:
    """Return the tracks of a frame, each with its last pixels."""
    tracks = tracks_of(subject.run.estimates[index])
    recent = [tracks_of(estimate) for estimate in subject.run.estimates[max(0, index - TAIL_FRAMES) : index + 1]]
    pixels = [dict(zip(t.ids.tolist(), t.pixels.tolist(), strict=True)) for t in recent]
    return [
        Track(colour, [(x, y) for of_frame in pixels if track_id in of_frame for x, y in (of_frame[track_id],)])
        for track_id, colour in zip(tracks.ids.tolist(), _colours(tracks.ages), strict=True)
    ]


def _jpeg_base64(image: npt.NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return base64.b64encode(data.tobytes()).decode("ascii")


def _colours(ages_frames: npt.NDArray[np.int64]) -> list[str]:
    """Return the colours of tracks of some ages."""
    return ["#{:02x}{:02x}{:02x}".format(*rgb) for rgb in palette.age_colours(ages_frames).tolist()]


def _provenance(subject: Subject, numbers: Mapping[str, object]) -> Iterator[tuple[str, object, bool]]:
    """Yield the tables of what went in and what else came out: title, content, and whether it is opened."""
    info = subject.info
    run = {"command": info.command, "seed": "none: a recording" if info.seed is None else str(info.seed)}
    for title, content in (
        ("Run", run),
        ("Estimator", numbers["estimator"]),
        ("Scores", numbers["scores"]),
        ("Configuration", info.configuration),
        ("Versions", info.versions),
        ("Machine", info.machine),
    ):
        if content:
            yield title, content, title in ("Run", "Versions", "Machine")


def _part(numbers: Mapping[str, object], name: str) -> Mapping[str, object]:
    part = numbers[name]
    assert isinstance(part, Mapping)
    return part
