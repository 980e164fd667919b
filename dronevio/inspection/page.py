"""The page of an inspection: a verdict, what the recording holds, all findings, and plots."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from dronevio.eval.report.figures import svg_plot
from dronevio.eval.report.templating import Tile, number, render_page
from dronevio.inspection import plots
from dronevio.inspection.details import Details
from dronevio.inspection.measured import calibrated_offset_s
from dronevio.inspection.model import Finding, Topic, Verdict, summary_of, worst
from dronevio.inspection.pictures import picture, undistorted, with_matches

_HEIGHT_IN = 2.6

HEADLINES = {
    Verdict.GOOD: "Will work",
    Verdict.SUSPECT: "Doubtful",
    Verdict.WRONG: "Will not work as it is",
}
"""Headline of the page by the worst verdict."""


@dataclass(frozen=True)
class Photograph:
    """An image on the page."""

    caption: str
    """Text below the image."""
    jpeg_base64: str
    """The image as JPEG in base64."""


def inspection_page(name: str, findings: Sequence[Finding], facts: Mapping[str, object], details: Details) -> str:
    """Return the page as HTML.

    Args:
        name: Name of the recording.
        findings: All findings, in the order of their topics.
        facts: What the recording holds.
        details: Measurements for the plots.
    """
    verdict = worst(findings)
    groups = [(topic, [finding for finding in findings if finding.topic is topic]) for topic in Topic]
    return render_page(
        "inspection.html.j2",
        f"Inspection of {name}",
        _introduction(facts),
        verdict=verdict,
        headline=HEADLINES[verdict],
        summary=summary_of(findings),
        problems=[finding for finding in findings if finding.verdict is verdict and verdict is not Verdict.GOOD],
        counts=[(str(each), sum(finding.verdict is each for finding in findings)) for each in Verdict],
        tiles=list(_tiles(facts, details)),
        groups=[(str(topic), rows) for topic, rows in groups if rows],
        rotation_plots=list(_rotation_plots(details)),
        photographs=list(_photographs(details)),
        image_plots=list(_image_plots(details)),
        imu_plots=list(_imu_plots(details)),
    )


def _introduction(facts: Mapping[str, object]) -> str:
    sizes = facts["cameras"]
    assert isinstance(sizes, list)
    cameras = f"{len(sizes)} camera{'s' if len(sizes) != 1 else ''}"
    truth = "ground truth" if facts["true_poses"] else "no ground truth"
    duration_s = number(facts["duration_s"], 1)
    return f"{facts['frames']} frames of {cameras} in {duration_s} s, {facts['imu_samples']} IMU samples, {truth}"


def _tiles(facts: Mapping[str, object], details: Details) -> Iterator[Tile]:
    """Yield the numbers at the top of the page."""
    recording, relation = details.measured.recording, details.measured.relation
    t_ns, imu_ns = recording.frame_times_ns, recording.imu.t_ns
    if len(t_ns) > 1:
        sizes = sorted({f"{camera.model.width} × {camera.model.height} px" for camera in recording.rig.cameras})
        note = f"{len(recording.rig.cameras)} × {', '.join(sizes)}"
        yield Tile("Images", number(1e9 / float(np.median(np.diff(t_ns))), 2), "Hz", note)
    if len(imu_ns) > 1:
        yield Tile("IMU", number(1e9 / float(np.median(np.diff(imu_ns))), 1), "Hz", f"{recording.rig.imu.name}")
    if relation is not None:
        share = number(100.0 * max(relation.agreement, 0.0), 1)
        yield Tile("Images and gyroscope", share, "%", "of the rotation of the images is that of the gyroscope")
        if details.measured.belongs:
            offset = number(1e3 * relation.offset_s, 1, sign=True)
            sigma = number(1e3 * relation.offset_sigma_s, 1)
            yield Tile("Time offset", offset, "ms", f"± {sigma} ms; positive if the images are early")


def _rotation_plots(details: Details) -> Iterator[Markup]:
    """Yield the plots of rotation and clocks."""
    measured = details.measured
    if not len(measured.rotations):
        return
    for axis in range(3):
        yield svg_plot(_HEIGHT_IN, lambda ax, axis=axis: plots.draw_rotation(ax, measured, axis))  # type: ignore[misc]
    relation, course = measured.relation, measured.course
    if relation is not None:
        calibrated_s = calibrated_offset_s(measured.recording)
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_offset_search(ax, relation, calibrated_s))
    if course is not None:
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_offset_course(ax, course))
    t_ns, imu_ns = measured.recording.frame_times_ns, measured.recording.imu.t_ns
    if len(t_ns) > 1:
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_intervals(ax, t_ns, imu_ns))


def _image_plots(details: Details) -> Iterator[Markup]:
    """Yield the plots of brightness and blur."""
    sample = details.measured.sample
    if any(sample.appearance):
        for blur in (False, True):
            yield svg_plot(
                _HEIGHT_IN,
                lambda ax, blur=blur: plots.draw_appearance(ax, sample.t_ns, sample.appearance, blur),  # type: ignore[misc]
            )


def _imu_plots(details: Details) -> Iterator[Markup]:
    """Yield the plots of the IMU."""
    imu, rest_ns = details.measured.recording.imu, details.rest_ns
    if len(imu) > 2:
        gyro_deg_s = np.degrees(imu.gyro_rad_s)
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_imu(ax, imu, gyro_deg_s, rest_ns, "°/s"))
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_imu(ax, imu, imu.accel_m_s2, rest_ns, "m/s²"))
    spectrum, allan = details.spectrum, details.allan
    if spectrum is not None:
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_spectrum(ax, spectrum))
    if allan is not None:
        yield svg_plot(_HEIGHT_IN, lambda ax: plots.draw_allan(ax, allan))


def _photographs(details: Details) -> Iterator[Photograph]:
    """Yield an image with its flow, undistorted images, and a pair with its matches."""
    sample, cameras = details.measured.sample, details.measured.recording.rig.cameras
    if not sample.shown:
        return
    frame = sample.shown[len(sample.shown) // 2]
    seconds = (frame.t_ns - int(details.measured.recording.frame_times_ns[0])) * 1e-9
    flow = next((flow for flow in sample.flows if flow.t_ns[0] == frame.t_ns), None)
    if frame.images[0].size and flow is not None:
        text = f"cam0 at {seconds:.2f} s: lines lead to where {len(flow.pixels[0])} features are in the next image"
        yield Photograph(text, picture(with_matches(frame.images[0], flow)))
    for index, (image, camera) in enumerate(zip(frame.images, cameras, strict=True)):
        if image.size:
            straight = picture(undistorted(image, camera.model), grid=True)
            yield Photograph(f"cam{index} undistorted: edges that are straight must be straight here", straight)
    for index, flows in enumerate(sample.stereo, start=1):
        shown = {frame.t_ns: frame for frame in sample.shown}
        pair = next((flow for flow in flows if flow.t_ns[0] in shown), None)
        if pair is not None:
            text = f"cam0: lines lead to where {len(pair.pixels[0])} features are in cam{index} at the same time"
            yield Photograph(text, picture(with_matches(shown[pair.t_ns[0]].images[0], pair)))
