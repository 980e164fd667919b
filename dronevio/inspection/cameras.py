"""Findings about the images of a recording and their time stamps."""

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt

from dronevio.inspection.appearance import Appearance
from dronevio.inspection.measured import Measured
from dronevio.inspection.model import Finding, Topic, Verdict, graded, more_severe
from dronevio.inspection.relation import Rotations
from dronevio.models.imu import Times

MIN_RATE_HZ = 5.0
"""At a lower rate, a drone that turns by 60 °/s shows other things in each image: no feature is seen three times."""
GAP_INTERVALS = 1.5
"""An interval is a gap if it is longer than this many median intervals: an image is missing."""
SUSPECT_GAP_S, WRONG_GAP_S = 0.5, 3.0
"""After half a second most features have left the image of a moving drone; the IMU alone errs by metres after three."""
MAX_MISSING = 0.1
"""Share of missing images at which the rate of the camera is no longer what it seems to be."""
MAX_JITTER_PX = 1.0
"""Movement of the image within the jitter of the stamps that is as large as the error of a feature [px]."""
SUSPECT_SPREAD, WRONG_SPREAD = 40.0, 16.0
"""Contrast at which rounding to whole grey levels is 1 % and 2 % of it, so that weak corners drown [grey levels]."""
MAX_CLIPPED = 1.0 / 3.0
"""Share of clipped pixels at which a third of the field of view holds no features."""
SUSPECT_BLUR_PX, WRONG_BLUR_PX = 2.0, 4.0
"""Width of edges beyond the 5 px in which a corner is found, and beyond the 15 px patch that is followed (±2σ)."""
SUSPECT_REPEATED = 0.1
"""Share of repeated images up to which leaving them out costs little."""
SUSPECT_TRACKED, WRONG_TRACKED = 50.0, 20.0
"""Features that are followed to the next image: three unknowns of each and six of a frame leave half of them to check
the rest; with a few, chance decides."""
MAX_FLOW_SHARE = 0.1
"""Median movement between images, as a share of the width: beyond, each feature is in ten images at most."""


def camera_findings(measured: Measured) -> Iterator[Finding]:
    """Yield the findings about the cameras."""
    recording, sample = measured.recording, measured.sample
    if not recording.rig.cameras or not len(recording.frame_times_ns):
        yield Finding(Topic.CAMERAS, "images", 0.0, Verdict.WRONG, "no images", "images of a camera", "record a camera")
        return
    sizes = {f"{camera.model.width} × {camera.model.height} px" for camera in recording.rig.cameras}
    count = len(recording.rig.cameras)
    yield Finding(
        Topic.CAMERAS,
        "images",
        float(len(recording.frame_times_ns)),
        Verdict.GOOD,
        f"{len(recording.frame_times_ns)} frames of {count} camera{'s' if count > 1 else ''},"
        f" {', '.join(sorted(sizes))}; {sample.frames} were looked at",
        "one camera or more",
    )
    bits = max(getattr(recording, "image_bits", ()), default=8)
    if bits > 8:
        yield Finding(
            Topic.CAMERAS,
            "bit depth",
            float(bits),
            Verdict.GOOD,
            f"{bits} bits in files of 16, of which the upper 8 are used",
            "8 to 16 bits, with one scale for all images of a camera",
        )
    yield from _stamps(measured)
    yield from _appearance(measured)
    yield _repeated(measured)
    yield from _features(measured)


def _stamps(measured: Measured) -> Iterator[Finding]:
    """Yield rate, gaps and jitter of the frames."""
    t_ns: Times = measured.recording.frame_times_ns
    if len(t_ns) < 3:
        yield Finding(
            Topic.CAMERAS,
            "rate",
            None,
            Verdict.WRONG,
            f"{len(t_ns)} frames",
            "a second of video or more",
            "record more",
        )
        return
    intervals_s = np.diff(t_ns) * 1e-9
    median_s = float(np.median(intervals_s))
    rate = 1.0 / median_s
    yield Finding(
        Topic.CAMERAS,
        "rate",
        rate,
        Verdict.GOOD if rate >= MIN_RATE_HZ else Verdict.SUSPECT,
        f"{rate:.2f} Hz over {(t_ns[-1] - t_ns[0]) * 1e-9:.1f} s",
        f"{MIN_RATE_HZ:g} Hz or more, so that a feature is seen several times",
        "" if rate >= MIN_RATE_HZ else "record at 15 Hz or more",
    )
    gaps = intervals_s > GAP_INTERVALS * median_s
    missing = int(np.sum(np.rint(intervals_s[gaps] / median_s) - 1.0))
    longest = float(intervals_s.max())
    share = missing / (missing + len(t_ns))
    verdict = more_severe(graded(longest, SUSPECT_GAP_S, WRONG_GAP_S), graded(share, MAX_MISSING, 0.5))
    at_s = (t_ns[int(np.argmax(intervals_s))] - t_ns[0]) * 1e-9
    yield Finding(
        Topic.CAMERAS,
        "gaps",
        longest,
        verdict,
        f"images missing: {missing}; gaps: {int(gaps.sum())}, the longest of {longest:.2f} s at {at_s:.1f} s"
        if missing
        else "none",
        f"no gap beyond {SUSPECT_GAP_S:g} s, after which a moving camera sees other features, and at most"
        f" {100 * MAX_MISSING:.0f} % missing",
        ""
        if verdict is Verdict.GOOD
        else "look for dropped frames: a slow disk, a full link, or a recorder that stalls",
    )
    even = intervals_s[~gaps]
    jitter_s = 1.4826 * float(np.median(np.abs(even - np.median(even))))
    focal_px = measured.recording.rig.cameras[0].model.fx
    turning = measured.relation.excitation_rad_s if measured.relation is not None and measured.belongs else 0.5
    moved_px = jitter_s * turning * focal_px
    yield Finding(
        Topic.CAMERAS,
        "jitter",
        jitter_s,
        graded(moved_px, MAX_JITTER_PX, 5.0),
        f"{1e3 * jitter_s:.2f} ms, in which the image turns by {moved_px:.2f} px",
        f"less than {MAX_JITTER_PX:g} px, the error of a feature",
        "" if moved_px < MAX_JITTER_PX else "use the stamps of the exposure rather than those of the arrival",
    )


def _appearance(measured: Measured) -> Iterator[Finding]:
    """Yield brightness, clipped pixels and blur, each over all cameras."""
    if not any(measured.sample.appearance):
        yield Finding(
            Topic.CAMERAS, "brightness", None, Verdict.WRONG, "no image can be read", "images", "see the other rows"
        )
        return
    names = [f"cam{k}" for k in range(len(measured.sample.appearance))]
    means, spreads, clipped, blurs = np.array([_medians(each) for each in measured.sample.appearance]).T.tolist()
    worst = int(np.nanargmin(spreads))
    verdict = graded(-spreads[worst], -SUSPECT_SPREAD, -WRONG_SPREAD)
    dark = "dark" if means[worst] < 64 else "pale"
    yield Finding(
        Topic.CAMERAS,
        "brightness",
        means[worst],
        verdict,
        f"mean grey level {means[worst]:.0f}, contrast {spreads[worst]:.0f} of 255"
        + ("" if verdict is Verdict.GOOD else f" in {names[worst]}: {dark} images"),
        f"a contrast of {SUSPECT_SPREAD:.0f} or more, of which rounding to grey levels is below 1 %",
        ""
        if verdict is Verdict.GOOD
        else "expose longer or with more gain; images of 10 to 14 bits stored as 16 bits need scaling",
    )
    worst = int(np.nanargmax(clipped))
    verdict = graded(clipped[worst], MAX_CLIPPED, 0.8)
    yield Finding(
        Topic.CAMERAS,
        "clipped pixels",
        clipped[worst],
        verdict,
        f"{100 * clipped[worst]:.1f} % of the pixels are black or white"
        + (f" in {names[worst]}" if len(names) > 1 else ""),
        f"less than {100 * MAX_CLIPPED:.0f} %, since clipped pixels hold no features",
        "" if verdict is Verdict.GOOD else "let the camera expose automatically",
    )
    if np.isfinite(blurs).any():
        worst = int(np.nanargmax(blurs))
        verdict = graded(blurs[worst], SUSPECT_BLUR_PX, WRONG_BLUR_PX)
        yield Finding(
            Topic.CAMERAS,
            "blur",
            blurs[worst],
            verdict,
            f"edges are {blurs[worst]:.1f} px wide (σ)" + (f" in {names[worst]}" if len(names) > 1 else ""),
            f"less than {SUSPECT_BLUR_PX:g} px, so that a corner fits into the 5 px in which it is found",
            ""
            if verdict is Verdict.GOOD
            else "focus the lens, clean it, or expose for a shorter time; a smaller image may do as well",
        )


def _medians(appearance: Sequence[Appearance]) -> list[float]:
    """Return the medians of brightness, contrast, clipped pixels and blur of some images; NaN where there is none."""
    columns = zip(*((a.mean, a.spread, max(a.black, a.white), a.blur_px) for a in appearance), strict=True)
    finite = [[value for value in column if np.isfinite(value)] for column in columns] or [[]] * 4
    return [float(np.median(values)) if values else float("nan") for values in finite]


def _repeated(measured: Measured) -> Finding:
    """Return whether images are repeated while the vehicle turns."""
    sample = measured.sample
    repeats: list[tuple[int, int]] = []
    for camera, times in enumerate(sample.repeated):
        t_ns = np.array(times, dtype=np.int64)
        if not len(t_ns):
            continue
        repeats += [(camera, t) for t in t_ns[_turns(measured, t_ns)].tolist()]
    most = max((sum(camera == k for camera, _ in repeats) for k in range(len(sample.repeated))), default=0)
    share = most / max(sample.compared, 1)
    at_rest = sum(map(len, sample.repeated)) - len(repeats)
    verdict = Verdict.GOOD if not repeats else graded(share, 0.0, SUSPECT_REPEATED)
    start_s = (min(t for _, t in repeats) - int(measured.recording.frame_times_ns[0])) * 1e-9 if repeats else 0.0
    text = f"{100 * share:.0f} % of the images equal the one before while the drone turns, from {start_s:.1f} s on"
    return Finding(
        Topic.CAMERAS,
        "repeated images",
        share,
        verdict,
        text if repeats else "none" + (f" while the drone turns; {at_rest} at rest" if at_rest else ""),
        "none: the noise of a camera makes each image differ from the one before",
        "" if not repeats else "look for a driver that hands out the last image again, or a video at twice its rate",
    )


def _turns(measured: Measured, t_ns: Times) -> npt.NDArray[np.bool_]:
    """Return at which times (N,) the gyroscope turns by half a pixel or more within a frame interval."""
    if measured.gyroscope is None:
        return np.ones(len(t_ns), np.bool_)
    interval_ns = int(np.median(np.diff(measured.recording.frame_times_ns)))
    rates = measured.gyroscope.rates(Rotations(t_ns - interval_ns, t_ns, np.zeros((len(t_ns), 3))), 0.0)
    bias = measured.gyroscope.resting_rate_rad_s if measured.relation is None else measured.relation.bias_rad_s
    angle = np.linalg.norm(rates - bias, axis=1) * interval_ns * 1e-9
    return np.asarray(angle * measured.recording.rig.cameras[0].model.fx > 0.5)


def _features(measured: Measured) -> Iterator[Finding]:
    """Yield how many features are followed, and how far they move."""
    flows = measured.sample.flows
    if not flows:
        return
    tracked = float(np.median([len(flow.pixels[0]) for flow in flows]))
    corners = float(np.median([flow.corners for flow in flows]))
    verdict = graded(-tracked, -SUSPECT_TRACKED, -WRONG_TRACKED)
    yield Finding(
        Topic.CAMERAS,
        "features",
        tracked,
        verdict,
        f"{tracked:.0f} of {corners:.0f} corners are found again in the next image (medians)",
        f"{SUSPECT_TRACKED:.0f} or more, so that each can be checked by the others",
        "" if verdict is Verdict.GOOD else "the scene has little texture, or the images are dark or blurred",
    )
    moved = np.array([flow.median_px for flow in flows])
    moved = moved[np.isfinite(moved)]
    if not len(moved):
        return
    typical, largest = float(np.median(moved)), float(np.percentile(moved, 95))
    limit = MAX_FLOW_SHARE * measured.recording.rig.cameras[0].model.width
    yield Finding(
        Topic.CAMERAS,
        "motion of the image",
        typical,
        graded(typical, limit, 3.0 * limit),
        f"{typical:.1f} px between images (median), {largest:.1f} px at times (95 %)",
        f"less than {limit:.0f} px, a tenth of the width, so that features stay for some images",
        "" if typical < limit else "use a higher frame rate",
    )
