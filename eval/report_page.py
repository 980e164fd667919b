"""The page of a report: HTML that needs nothing but itself, on a wide screen and on a telephone, by day and night."""

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from dronevio.eval import palette, plots
from dronevio.eval.report import Subject
from dronevio.eval.runs import tracks_of

SAMPLE_FRAMES = 4
TAIL_FRAMES = 8  # how far back the tail of a track reaches
_STYLE_SHEET = Path(__file__).with_name("report.css")


@dataclass(frozen=True)
class Tile:
    """One number that a reader looks for first."""

    label: str
    value: str
    unit: str
    note: str = ""


def page(subject: Subject, numbers: Mapping[str, object]) -> str:
    """Return the page as HTML."""
    info = subject.info
    title = escape(info.title)
    sections = "\n".join(
        (
            _section("", f'<div class="tiles">{"".join(map(_tile, tiles(numbers)))}</div>'),
            _section("", f'<div class="figures">{"".join(_figures(subject))}</div>'),
            _section(
                "What the camera saw",
                f"<p>Features that were followed, with the way of their last {TAIL_FRAMES} frames;"
                f" {_age_legend()}</p>" + f'<div class="figures">{"".join(_frames(subject))}</div>',
            ),
            _section("How to open the recording", f"<pre>{escape(info.open_command)}</pre>"),
            _section("How it was made", _origin(subject, numbers)),
        )
    )
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        '<meta name="color-scheme" content="light dark">\n'
        f"<title>{title} · dronevio</title>\n<style>\n{_STYLE_SHEET.read_text(encoding='utf-8')}</style>\n</head>\n"
        f"<body>\n<header><h1>{title}</h1><p>{escape(_summary(numbers))}</p></header>\n<main>\n{sections}\n</main>\n"
        "</body>\n</html>\n"
    )


def tiles(numbers: Mapping[str, object]) -> list[Tile]:
    """Return the numbers that stand at the top of the page."""
    flight, timing = _part(numbers, "flight"), _part(numbers, "timing")
    scored = [] if numbers["scores"] is None else _score_tiles(_part(numbers, "scores"))
    return [
        *scored,
        Tile(
            "Time a frame",
            _number(timing["cpu_ms_mean"], 1),
            "ms",
            f"processor time; 99 % take under {_number(timing['cpu_ms_p99'], 1)} ms",
        ),
        Tile("Real-time factor", _number(timing["real_time_factor"], 1), "×", "seconds of flight a second of one core"),
        Tile("Path", _number(flight["path_m"], 1), "m", f"in {_number(flight['duration_s'], 1)} s"),
        Tile(
            "Peak speed",
            _number(flight["peak_speed_m_s"], 2),
            "m/s",
            f"turning at up to {_number(flight['peak_turn_rate_deg_s'], 0)} °/s",
        ),
    ]


def _score_tiles(scores: Mapping[str, object]) -> Iterator[Tile]:
    ate, ate_deg = _part(scores, "ate_m"), _part(scores, "ate_deg")
    how = {"yaw": "yaw and position aligned", "none": "not aligned"}.get(
        str(scores["alignment"]), f"{scores['alignment']} aligned"
    )
    yield Tile("ATE", _number(ate["rmse"], 3), "m", f"r.m.s., {how}; {_number(ate_deg['rmse'], 2)}°")
    if scores["rpe_m"] is not None:
        rpe, rpe_deg = _part(scores, "rpe_m"), _part(scores, "rpe_deg")
        over = f"r.m.s. over {_number(scores['rpe_delta_s'], 0)} s; {_number(rpe_deg['rmse'], 2)}°"
        yield Tile("RPE", _number(rpe["rmse"], 3), "m", over)
    yield Tile("Scale error", _number(scores["scale_error_percent"], 2, sign=True), "%", "of the estimated path")
    yield Tile("Coverage", _number(scores["coverage_percent"], 1), "%", "of the frames later than 3 s have a pose")


def _summary(numbers: Mapping[str, object]) -> str:
    flight = _part(numbers, "flight")
    seed = "" if numbers["seed"] is None else f", seed {numbers['seed']}"
    duration_s, path_m = _number(flight["duration_s"], 1), _number(flight["path_m"], 1)
    return f"{flight['frames']} frames in {duration_s} s, {path_m} m flown{seed}"


def _figures(subject: Subject) -> Iterator[str]:
    """Yield the drawings, each in a figure of its own, so that a narrow page can stack them."""
    estimate, truth, scored = subject.estimate, subject.recording.ground_truth, subject.scored
    origin_ns = subject.origin_ns
    interval_ms = 1e3 / subject.recording.rig.cameras[0].rate_hz
    for side in (plots.ABOVE, plots.FRONT):
        draw = partial(plots.draw_path, side=side, estimate=estimate, truth=truth, outline=subject.outline)
        yield _drawing(3.7, draw)
    if scored is not None:
        yield _drawing(2.7, lambda ax: plots.draw_position_error(ax, scored, origin_ns))
        yield _drawing(2.7, lambda ax: plots.draw_orientation_error(ax, scored, origin_ns))
    yield _drawing(2.7, lambda ax: plots.draw_speed(ax, estimate, truth, origin_ns))
    yield _drawing(2.7, lambda ax: plots.draw_cost(ax, subject.run, origin_ns, interval_ms))


def _drawing(height_in: float, draw: Callable[[Axes], None]) -> str:
    with plots.figure(4.8, height_in) as (fig, axes):
        draw(axes[0])
    svg, title = plots.as_svg(fig), axes[0].get_title(loc="left")
    svg = svg.replace(plots.INK, "var(--ink)").replace(plots.GRID, "var(--grid)")
    return f'<figure aria-label="{escape(title)}">{svg}</figure>'


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
    return "".join(_table(title, content) for title, content in tables if content)


def _table(title: str, content: object) -> str:
    rows = "".join(f"<tr><th>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in _flat(content))
    opened = " open" if title in ("Run", "Versions", "Machine") else ""
    return f'<details{opened}><summary>{escape(title)}</summary><div class="wide"><table>{rows}</table></div></details>'


def _flat(content: object, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the leaves of nested settings, with dotted names."""
    if isinstance(content, Mapping):
        for name, value in content.items():
            yield from _flat(value, f"{prefix}.{name}" if prefix else str(name))
    elif isinstance(content, float):
        yield prefix, f"{content:.6g}"
    elif isinstance(content, Sequence) and not isinstance(content, str):
        yield prefix, ", ".join(str(item) for item in content)
    else:
        yield prefix, "–" if content is None else str(content)


def _section(title: str, content: str) -> str:
    heading = f"<h2>{escape(title)}</h2>" if title else ""
    return f"<section>{heading}{content}</section>"


def _tile(tile: Tile) -> str:
    return (
        f'<div class="tile"><div class="label">{escape(tile.label)}</div>'
        f'<div class="value">{escape(tile.value)} <span>{escape(tile.unit)}</span></div>'
        f'<div class="note">{escape(tile.note)}</div></div>'
    )


def _number(value: object, decimals: int, sign: bool = False) -> str:
    """Return a number for people; a dash where there is none."""
    if not isinstance(value, int | float):
        return "–"
    return f"{value:{'+' if sign else ''}.{decimals}f}".replace("-", "−")


def _part(numbers: Mapping[str, object], name: str) -> Mapping[str, object]:
    part = numbers[name]
    assert isinstance(part, Mapping)
    return part
