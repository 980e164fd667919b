"""The page of a run's report: the scores first, then what the flight, its errors and their cost looked like."""

import base64
from collections.abc import Iterator, Mapping
from functools import partial
from html import escape

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from dronevio.eval import style as palette
from dronevio.eval.metrics import ScoredTrajectory, nees_bounds
from dronevio.eval.report import plots as report_plots
from dronevio.eval.report.model import Subject
from dronevio.eval.report.templating import Tile, details, document, drawing, figures, number, section, settings, tiles
from dronevio.eval.run import tracks_of

SAMPLE_FRAMES = 4
TAIL_FRAMES = 8  # how far back the tail of a track reaches
_PATH_IN, _GRAPH_IN = 3.7, 2.7  # heights of drawings


def page(subject: Subject, numbers: Mapping[str, object]) -> str:
    """Return the page as HTML."""
    info, scored = subject.info, subject.scored
    lengths, consistency = "", ""
    if scored is not None:
        lengths, consistency = figures(_length_figures(scored)), _consistency(scored, subject.origin_ns)
    return document(
        info.title,
        _summary(numbers),
        (
            section("", tiles(_tiles(numbers))),
            section("Path", figures(_path_figures(subject))),
            section("Over time", figures(_time_figures(subject))),
            section("By length of the way", lengths),
            section("Consistency", consistency),
            section("Cost", figures(_cost_figures(subject))),
            section(
                "What the camera saw",
                f"<p>Features that were followed, with the way of their last {TAIL_FRAMES} frames;"
                f" {_age_legend()}</p>" + figures(_frames(subject)),
            ),
            section("How to open the recording", f"<pre>{escape(info.open_command)}</pre>"),
            section("How it was made", _origin(subject, numbers)),
        ),
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


def _path_figures(subject: Subject) -> Iterator[str]:
    estimate, truth = subject.estimate, subject.recording.ground_truth
    for side in (report_plots.ABOVE, report_plots.FRONT):
        draw = partial(report_plots.draw_path, side=side, estimate=estimate, truth=truth, outline=subject.outline)
        yield drawing(_PATH_IN, draw, "the estimate" if truth is None else "the estimate on the truth")


def _time_figures(subject: Subject) -> Iterator[str]:
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


def _length_figures(scored: ScoredTrajectory) -> Iterator[str]:
    errors = report_plots.errors_by_length(scored)
    for values, title, axis in (
        (errors.translation_percent, "Relative position error", "of the length [%]"),
        (errors.rotation_deg, "Relative orientation error", "orientation error [°]"),
    ):
        draw = partial(report_plots.draw_length_errors, labels=errors.labels, values=values, title=title, axis=axis)
        if values:
            medians = (f"{np.median(v):.2f} after {label} m" for label, v in zip(errors.labels, values, strict=True))
            yield drawing(_GRAPH_IN, draw, f"{axis}, medians {', '.join(medians)}")


def _consistency(scored: ScoredTrajectory, origin_ns: int) -> str:
    """Return whether errors are as large as claimed, in words and as a drawing; nothing where nothing is claimed."""
    stated, scores = scored.consistency, scored.scores
    if stated is None:
        return ""
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
    body = "".join(
        f"<tr><th>{name}</th><td>{number(mean, 2)}</td><td>{number(inside, 1)}</td><td>{number(beyond, 2)}</td></tr>"
        for name, mean, inside, beyond in rows
    )
    table = (
        '<div class="wide"><table class="numbers"><thead><tr><th></th><th>mean NEES [–]</th><th>within 95 % [%]</th>'
        f"<th>beyond 3σ [%]</th></tr></thead><tbody>{body}"
        '<tr class="aside"><th>expected</th><td>3</td><td>95</td><td>0.27</td></tr></tbody></table></div>'
    )
    words = (
        "<p>Squared errors in units of the covariance that the estimator claims (NEES), position and yaw tied at the"
        f" first pose. An honest one has a mean of 3; 95 % of its poses lie between {low:.2f} and {high:.2f}. More is"
        " overconfident, less is too modest. The poses of one run hang together, so the mean of a run strays.</p>"
    )
    return figures(
        (f"<div>{words}{table}</div>", drawing(_GRAPH_IN, lambda ax: report_plots.draw_nees(ax, scored, origin_ns)))
    )


def _cost_figures(subject: Subject) -> Iterator[str]:
    interval_ms = 1e3 / subject.recording.rig.cameras[0].rate_hz

    def over_time(ax: Axes) -> None:
        report_plots.draw_cost(ax, subject.run, subject.origin_ns, interval_ms)

    yield drawing(_GRAPH_IN, over_time)
    if len(subject.run.cpu_ms):
        yield drawing(_GRAPH_IN, lambda ax: report_plots.draw_cost_histogram(ax, subject.run))


def _frames(subject: Subject) -> Iterator[str]:
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
        yield (
            f'<figure><svg class="frame" viewBox="-0.5 -0.5 {width} {height}" role="img" aria-label="{caption}">'
            f'<image x="-0.5" y="-0.5" width="{width}" height="{height}" href="{_jpeg(frame.images[0])}"/>'
            f"{''.join(_track_marks(subject, index))}</svg><figcaption>{caption}</figcaption></figure>"
        )


def _track_marks(subject: Subject, index: int) -> Iterator[str]:
    """Yield a dot for each track of a frame, and a line along its way there."""
    tracks = tracks_of(subject.run.estimates[index])
    earlier = [tracks_of(estimate) for estimate in subject.run.estimates[max(0, index - TAIL_FRAMES) : index]]
    before = [dict(zip(t.ids.tolist(), t.pixels.tolist(), strict=True)) for t in earlier]
    for identity, pixel, colour in zip(
        tracks.ids.tolist(), tracks.pixels.tolist(), palette.age_colours(tracks.ages).tolist(), strict=True
    ):
        way = [at[identity] for at in before if identity in at] + [pixel]
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in way)
        ink = "#{:02x}{:02x}{:02x}".format(*colour)
        if len(way) > 1:
            yield f'<polyline points="{points}" stroke="{ink}"/>'
        yield f'<circle cx="{pixel[0]:.1f}" cy="{pixel[1]:.1f}" r="4" fill="{ink}"/>'


def _jpeg(image: npt.NDArray[np.uint8]) -> str:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 80])
    return "data:image/jpeg;base64," + base64.b64encode(data.tobytes()).decode("ascii")


def _age_legend() -> str:
    ages = np.array([1, 3, 8, 20, 60])
    stops = ", ".join("#{:02x}{:02x}{:02x}".format(*c) for c in palette.age_colours(ages).tolist())
    return f'new <span class="ramp" style="background: linear-gradient(90deg, {stops})"></span> 60 frames and older.'


def _origin(subject: Subject, numbers: Mapping[str, object]) -> str:
    """Return the tables of what went in and what else came out."""
    info = subject.info
    made = {"command": info.command, "seed": "none: a recording" if info.seed is None else str(info.seed)}
    tables = (
        ("Run", made),
        ("Estimator", numbers["estimator"]),
        ("Scores", numbers["scores"]),
        ("Configuration", info.configuration),
        ("Versions", info.versions),
        ("Machine", info.machine),
    )
    return "".join(
        details(title, settings(content), opened=title in ("Run", "Versions", "Machine"))
        for title, content in tables
        if content
    )


def _part(numbers: Mapping[str, object], name: str) -> Mapping[str, object]:
    part = numbers[name]
    assert isinstance(part, Mapping)
    return part
