"""Inspection of recordings: measurements against values by hand, verdicts, and the command."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.cli import main
from dronevio.inspection import Verdict, inspect
from dronevio.inspection.appearance import appearance_of, edge_blur_px
from dronevio.inspection.calibration import calibration_findings
from dronevio.inspection.cameras import camera_findings
from dronevio.inspection.clocks import clock_findings
from dronevio.inspection.flow import Flow
from dronevio.inspection.imu import imu_findings
from dronevio.inspection.inertial import (
    AXES,
    allan_deviation,
    mean_force_m_s2,
    resting,
    spectrum_of,
    spread_of_axes,
)
from dronevio.inspection.lens import check_lens
from dronevio.inspection.measured import Measured, measure
from dronevio.inspection.model import Finding, Inspection, Topic, graded, more_severe, summary_of, worst
from dronevio.inspection.offsets import offset_course
from dronevio.inspection.relation import Gyroscope, Rotations, played_backwards, relate
from dronevio.inspection.sampling import FRAMES, sampled_runs
from dronevio.inspection.stereo import check_stereo
from dronevio.models.camera import CameraModel
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import exp_so3, integrated_rotations, log_so3, pose_matrix
from tests.browser import Browser

RATE_HZ, DURATION_S = 200.0, 24.0
MODEL = CameraModel(640, 480, 400.0, 400.0, 319.5, 239.5)


def imu_of(gyro: Callable[[Any], Any], accel: Any = (0.0, 0.0, 9.81), noise: float = 0.0) -> ImuSamples:
    """Samples of a rate of rotation that is a function of time, with a constant force unless given."""
    t_s = np.arange(0.0, DURATION_S, 1.0 / RATE_HZ)
    rng = np.random.default_rng(1)
    rate = np.stack(gyro(t_s), axis=1)
    force = np.broadcast_to(np.asarray(accel, np.float64), rate.shape)
    return ImuSamples(
        (t_s * 1e9).round().astype(np.int64) + 10**18,
        rate + noise * rng.normal(size=rate.shape),
        force + noise * rng.normal(size=rate.shape),
    )


def tumbling(t: Any) -> tuple[Any, Any, Any]:
    """Rates about all axes that never repeat [rad/s]."""
    return (
        0.5 * np.sin(1.3 * t) + 0.2 * np.sin(4.1 * t),
        0.4 * np.cos(1.9 * t) + 0.3 * np.sin(0.7 * t + 1.0),
        0.6 * np.sin(0.9 * t + 2.0) - 0.2 * np.cos(3.3 * t),
    )


def rotations_of(imu: ImuSamples, Q: Any, offset_s: Any = 0.0, scale: float = 1.0, noise: float = 1e-3) -> Rotations:
    """What a camera measures at 20 Hz: scaled and turned, with stamps that are earlier by an offset."""
    t_ns = imu.t_ns[0] + 1_200_000_000 + 50_000_000 * np.arange(420)
    exact = Rotations(t_ns[:-1], t_ns[1:], np.zeros((len(t_ns) - 1, 3)))
    rates = scale * Gyroscope(imu).rates(exact, 0.0) @ np.asarray(Q).T
    rates += noise * np.random.default_rng(2).normal(size=rates.shape)
    early_ns = np.round(np.broadcast_to(offset_s, t_ns.shape) * 1e9).astype(np.int64)
    stamps = t_ns - early_ns
    return Rotations(stamps[:-1], stamps[1:], rates)


R_CAM_IMU = exp_so3(np.array([0.4, -1.1, 0.7]))


@pytest.mark.parametrize("offset_s", [-0.35, 0.0, 0.0371])
@pytest.mark.parametrize(("scale", "mirror"), [(1.0, False), (np.radians(1.0), False), (1.0, True)])
def test_relation_recovers_offset_rotation_scale_and_mirror(offset_s: float, scale: float, mirror: bool) -> None:
    Q = R_CAM_IMU @ np.eye(3)[[1, 0, 2]] if mirror else R_CAM_IMU
    bias = np.array([0.02, -0.03, 0.08])
    imu = imu_of(tumbling)
    found = relate(
        rotations_of(imu, Q, offset_s, scale, noise=1e-3 * scale),
        Gyroscope(replace(imu, gyro_rad_s=imu.gyro_rad_s + bias)),
    )
    assert found is not None
    assert found.offset_s == pytest.approx(offset_s, abs=3e-4)
    assert found.offset_sigma_s < 2e-4
    assert found.scale == pytest.approx(scale, rel=3e-3)
    assert found.agreement > 0.999
    assert found.is_reflected is mirror
    assert (found.proper_ratio < 0.1) if mirror else (found.proper_ratio > 10.0)
    np.testing.assert_allclose(found.Q, Q, atol=3e-3)
    np.testing.assert_allclose(found.bias_rad_s, bias, atol=1e-3)


def test_relation_resists_wrong_rotations_of_some_images() -> None:
    imu = imu_of(tumbling)
    rotations = rotations_of(imu, R_CAM_IMU, 0.02)
    wrong = rotations.rate_rad_s.copy()
    wrong[::4] += np.random.default_rng(5).normal(scale=1.0, size=wrong[::4].shape)
    found = relate(replace(rotations, rate_rad_s=wrong), Gyroscope(imu))
    assert found is not None
    assert found.offset_s == pytest.approx(0.02, abs=1e-3)
    assert np.degrees(np.linalg.norm(log_so3(found.Q @ R_CAM_IMU.T))) < 0.3
    assert found.weights[::4].mean() < 0.2 < 0.6 < found.weights[1::4].mean()


def test_other_flights_and_reversed_images_do_not_agree() -> None:
    imu, other = imu_of(tumbling), imu_of(lambda t: tumbling(1.7 * t + 40.0))
    rotations = rotations_of(imu, R_CAM_IMU)
    crossed = relate(rotations, Gyroscope(other))
    assert crossed is not None and crossed.agreement < 0.5
    backwards = relate(played_backwards(rotations), Gyroscope(imu))
    assert backwards is not None and backwards.agreement < 0.7
    again = relate(played_backwards(played_backwards(rotations)), Gyroscope(imu))
    assert again is not None and again.agreement > 0.999


def test_rotation_about_one_axis_is_known_to_be_uncertain() -> None:
    imu = imu_of(lambda t: (0.0 * t, 0.0 * t, 0.8 * np.sin(1.1 * t)))
    found = relate(rotations_of(imu, R_CAM_IMU), Gyroscope(imu))
    assert found is not None and found.agreement > 0.99
    assert np.degrees(found.rotation_sigma_rad) > 10.0
    assert 0.5 < found.proper_ratio < 2.0


@pytest.mark.parametrize("change", ["none", "drift", "step"])
def test_offset_over_the_recording(change: str) -> None:
    imu, index = imu_of(tumbling), np.arange(420)
    offset_s = {"none": 0.01, "drift": 500e-6 * 0.05 * index, "step": np.where(index > 200, 0.04, 0.0)}[change]
    rotations = rotations_of(imu, R_CAM_IMU, offset_s, noise=3e-3)
    relation = relate(rotations, Gyroscope(imu))
    assert relation is not None
    course = offset_course(rotations, Gyroscope(imu), relation)
    assert course is not None
    assert course.drift_is_significant is (change == "drift") or change == "step"
    assert course.step_is_significant is (change == "step")
    if change == "drift":
        assert course.drift == pytest.approx(500e-6, abs=60e-6)
    if change == "step":
        assert course.step_s == pytest.approx(0.04, abs=4e-3)  # one section is before and after it
        assert course.step_at_s == pytest.approx(10.0, abs=1.5)


def flows_of(first: CameraModel, taken: CameraModel, count: int = 16) -> tuple[list[Flow], Any]:
    """Matches of points in front of a camera that turns and moves, taken with one lens and undone with another."""
    rng = np.random.default_rng(4)
    flows, rotations = [], []
    for k in range(count):
        phi, t = rng.normal(scale=0.05, size=3), rng.normal(scale=0.05, size=3)
        points = np.column_stack([rng.uniform(-3, 3, (150, 2)), rng.uniform(2, 6, 150)])
        moved = (points - t) @ exp_so3(phi)  # exp(φ)ᵀ (p − t): the camera turns by φ
        pixels = taken.project(points), taken.project(moved)
        pixels = tuple(each + rng.normal(scale=0.1, size=each.shape) for each in pixels)  # type: ignore[assignment]
        seen = np.all([np.abs(each - [320, 240]).max(axis=1) < 315 for each in pixels], axis=0)
        pixels = pixels[0][seen], pixels[1][seen]
        flows.append(Flow((k, k + 1), 150, pixels, (first.unproject(pixels[0]), first.unproject(pixels[1]))))
        rotations.append(phi)
    return flows, np.array(rotations)


def test_lens_that_is_right_needs_no_change() -> None:
    flows, rotations = flows_of(MODEL, MODEL)
    found = check_lens(flows, rotations, 1.0 / MODEL.fx)
    assert found is not None
    assert found.scale == pytest.approx(1.0, abs=0.01)
    assert found.cubic == pytest.approx(0.0, abs=0.02)
    assert found.cost_ratio < 1.05


def test_focal_length_and_distortion_are_found_from_the_motion() -> None:
    flows, rotations = flows_of(replace(MODEL, fx=480.0, fy=480.0), MODEL)
    found = check_lens(flows, rotations, 1.0 / 480.0)
    assert found is not None and found.cost_ratio > 1.5
    assert found.scale == pytest.approx(480.0 / 400.0, abs=0.06)
    distorted = replace(MODEL, distortion=(-0.28, 0.07, 0.0, 0.0))
    flows, rotations = flows_of(MODEL, distorted)
    found = check_lens(flows, rotations, 1.0 / MODEL.fx)
    assert found is not None and found.cost_ratio > 1.5
    assert found.scale == pytest.approx(1.0, abs=0.05)
    assert found.cubic > 0.15 and found.change_px > 6.0


def test_stereo_pair() -> None:
    first = RigCamera(MODEL, np.eye(4))
    second = RigCamera(MODEL, pose_matrix(np.eye(3), np.array([0.11, 0.0, 0.0])))
    rng = np.random.default_rng(6)
    points = np.column_stack([rng.uniform(-2, 2, (400, 2)), rng.uniform(2, 6, 400)])
    bearings = tuple(p / np.linalg.norm(p, axis=1, keepdims=True) for p in (points, points - [0.11, 0.0, 0.0]))
    pixels = MODEL.project(points), MODEL.project(points - [0.11, 0.0, 0.0])
    flow = Flow((0, 0), 400, pixels, (bearings[0], bearings[1]))
    good = check_stereo([flow], first, second)
    assert good is not None and good.error_px < 0.01 and good.behind == 0.0
    swapped = check_stereo([Flow((0, 0), 400, pixels[::-1], bearings[::-1])], first, second)
    assert swapped is not None and swapped.behind > 0.95
    # Turned by 1° about the optical axis: points move by 0.0175 times their height in the image, 1.3 m / 4 m × 400 px.
    turned = replace(
        second, T_imu_cam=second.T_imu_cam @ pose_matrix(exp_so3(np.array([0, 0, np.radians(1.0)])), np.zeros(3))
    )
    found = check_stereo([flow], first, turned)
    assert found is not None
    assert found.rotation_deg == pytest.approx(1.0, abs=0.1)
    assert 1.0 < found.error_px < 3.5 and found.best_px < 0.05
    unrelated = (bearings[0], bearings[1][rng.permutation(400)])
    assert check_stereo([Flow((0, 0), 400, pixels, unrelated)], first, second) is None


def test_frames_are_sampled_in_runs() -> None:
    assert sampled_runs(np.zeros(0, np.int64)) == []
    (all_of_them,) = sampled_runs(50_000_000 * np.arange(200))
    assert len(all_of_them) == 200
    for rate_hz in (5.0, 20.0, 60.0, 120.0):
        t_ns = (np.arange(9000) * 1e9 / rate_hz).astype(np.int64)
        runs = sampled_runs(t_ns)
        assert len(runs) >= 6 and runs[0][0] == 0 and runs[-1][-1] == 8999
        assert all((np.diff(run) == 1).all() and t_ns[run[-1]] - t_ns[run[0]] > 0.9e9 for run in runs)
        assert sum(map(len, runs)) <= max(FRAMES, 6 * (rate_hz + 1))


@pytest.mark.parametrize("sigma_px", [1.5, 3.0, 5.0])
def test_blur_of_an_edge_is_the_width_of_its_filter(sigma_px: float) -> None:
    step = np.full((120, 160), 40, np.uint8)
    step[:, 80:] = 200
    blurred = np.asarray(cv2.GaussianBlur(step, (0, 0), sigma_px), np.uint8)
    assert edge_blur_px(blurred) == pytest.approx(sigma_px, rel=0.12)
    assert np.isnan(edge_blur_px(np.full((120, 160), 77, np.uint8)))


def test_brightness_counts_clipped_pixels() -> None:
    image = np.full((100, 100), 100, np.uint8)
    image[:, :25], image[:, 25:35] = 255, 0
    found = appearance_of(image)
    assert found.white == pytest.approx(0.25, abs=0.02)
    assert found.black == pytest.approx(0.1, abs=0.02)
    assert found.spread == 255.0
    assert found.mean == pytest.approx(0.25 * 255 + 0.65 * 100, abs=4.0)


def levelled(imu: ImuSamples, axes: Any) -> ImuSamples:
    """Samples of a vehicle that turns in place, whose accelerometer has other axes."""
    R = integrated_rotations(imu.gyro_rad_s[:-1] / RATE_HZ)
    return replace(imu, accel_m_s2=(np.swapaxes(R, 1, 2) @ [0.0, 0.0, 9.81]) @ np.asarray(axes, np.float64).T)


def test_axes_of_the_accelerometer_keep_gravity() -> None:
    right = levelled(imu_of(tumbling), np.eye(3))
    spread = spread_of_axes(right, np.zeros(3))
    assert spread[0] == pytest.approx(0.0, abs=0.02) and np.sort(spread)[2] > 1.0  # all reversed is as good
    assert mean_force_m_s2(right, np.zeros(3)) == pytest.approx(9.81, abs=0.01)
    swap = np.eye(3)[[1, 0, 2]]
    spread = spread_of_axes(levelled(imu_of(tumbling), swap), np.zeros(3))
    assert spread[0] > 1.0
    near = [axes for axes, value in zip(AXES, spread, strict=True) if value < 0.02]
    assert any(np.array_equal(axes, swap) for axes in near) and len(near) == 2


def test_rest_is_found_where_the_rate_is_that_of_the_bias() -> None:
    def rate(t: Any) -> tuple[Any, Any, Any]:
        moves = (t > 5.0) & (t < 15.0)
        return tuple(0.03 + np.where(moves, each, 0.0) for each in tumbling(t))  # type: ignore[return-value]

    imu = imu_of(rate, noise=0.005)
    (first, second) = resting(imu, None)
    assert (first[1] - imu.t_ns[0]) * 1e-9 == pytest.approx(5.0, abs=0.3)
    assert (second[0] - imu.t_ns[0]) * 1e-9 == pytest.approx(15.0, abs=0.3)
    assert resting(imu_of(tumbling), np.zeros(3)) == []


def test_spectrum_and_allan_deviation_have_the_right_power() -> None:
    still = imu_of(lambda t: (0.0 * t, 0.0 * t, 0.0 * t), noise=0.02)
    wave = 15.0 * np.sin(2.0 * np.pi * 87.0 * np.arange(len(still)) / RATE_HZ)
    shaken = replace(still, accel_m_s2=still.accel_m_s2 + wave[:, None] * [0.0, 0.6, 0.8])
    spectrum = spectrum_of(shaken)
    assert spectrum is not None
    gyro, accel, peak_hz = spectrum.vibration()
    assert accel == pytest.approx(15.0 / np.sqrt(2.0), rel=0.02)
    assert gyro == pytest.approx(0.02 * np.sqrt(3.0 * 0.8), rel=0.1)  # four fifths of the band are above 20 Hz
    assert peak_hz == pytest.approx(87.0, abs=0.8)
    allan = allan_deviation(still)
    assert allan is not None
    for density in allan.density():
        assert density == pytest.approx(0.02 / np.sqrt(RATE_HZ), rel=0.1)


def finding(verdict: Verdict, name: str = "rate") -> Finding:
    return Finding(Topic.IMU, name, 1.0, verdict, "as found", "as expected", "do it")


def test_the_summary_names_the_worst_rows() -> None:
    good, suspect, wrong = finding(Verdict.GOOD), finding(Verdict.SUSPECT, "gaps"), finding(Verdict.WRONG, "units")
    assert summary_of([good, finding(Verdict.UNKNOWN)]) == "will work: nothing speaks against it"
    assert summary_of([good, suspect]) == "doubtful: IMU, gaps: as found"
    assert summary_of([suspect, wrong]) == "will not work as it is: IMU, units: as found"
    assert worst([]) is Verdict.GOOD
    assert [graded(value, 1.0, 2.0) for value in (1.0, 1.5, 2.5, float("nan"))] == [
        Verdict.GOOD, Verdict.SUSPECT, Verdict.WRONG, Verdict.GOOD
    ]  # fmt: skip
    assert more_severe(Verdict.UNKNOWN, Verdict.SUSPECT, Verdict.GOOD) is Verdict.SUSPECT


@pytest.fixture(scope="module")
def document(flown: Any, tmp_path_factory: pytest.TempPathFactory, run_command: Callable[..., Any]) -> dict[str, Any]:
    """The JSON document of the command for a simulated flight."""
    page = tmp_path_factory.mktemp("inspect") / "page.html"
    result = run_command(page, "inspect", flown.folder, "--out", page, "--json", "--strict")
    loaded: dict[str, Any] = json.loads(result.out)
    return loaded


def test_a_simulated_flight_is_sound(document: dict[str, Any]) -> None:
    assert document["verdict"] == "good" and document["summary"].startswith("will work")
    assert {row["verdict"] for row in document["findings"]} <= {"good", "not checked"}
    assert {row["topic"] for row in document["findings"]} >= {
        "cameras", "IMU", "clocks", "calibration", "motion", "ground truth"
    }  # fmt: skip
    assert document["frames"] == 120 and document["cameras"] == [[752, 480]]
    (offset,) = [row for row in document["findings"] if (row["topic"], row["name"]) == ("clocks", "time offset")]
    assert abs(offset["value"]) < 1e-3


@pytest.mark.slow
def test_the_page_in_a_browser(document: dict[str, Any], browser: Browser) -> None:
    assert browser.faults(Path(document["page"]).as_uri()) == []
    browser.show(420)
    assert browser.evaluate("(x => x.scrollWidth - x.clientWidth)(document.querySelector('.wide'))") == 0


def test_the_page_is_one_file(document: dict[str, Any]) -> None:
    page = Path(document["page"]).read_text(encoding="utf-8")
    assert "Will work" in page and page.count("<svg") >= 8 and "data:image/jpeg;base64," in page
    for word in ('src="http', 'href="http', "<script", "<link"):
        assert word not in page
    for row in document["findings"]:
        assert f">{row['name']}<" in page


@pytest.fixture(scope="module")
def measured(flown: Any) -> Measured:
    """The measurements in the images of the flight."""
    return measure(open_recording(flown.folder, repair=True))


class Altered:
    """A recording of which some parts are replaced."""

    def __init__(self, recording: Any, **parts: Any) -> None:
        self._recording, self._parts = recording, parts

    def __getattr__(self, name: str) -> Any:
        return self._parts[name] if name in self._parts else getattr(self._recording, name)


def raised(findings: Any) -> dict[str, Finding]:
    return {each.name: each for each in findings if each.verdict in (Verdict.SUSPECT, Verdict.WRONG)}


def imu_rows(measured: Measured, imu: ImuSamples) -> dict[str, Finding]:
    altered: Any = Altered(measured.recording, imu=imu)
    return raised(imu_findings(replace(measured, recording=altered), [], spectrum_of(imu), None))


def test_faults_of_the_imu_are_named(measured: Measured) -> None:
    imu = measured.recording.imu
    assert imu_rows(measured, imu) == {}
    in_g = imu_rows(measured, replace(imu, accel_m_s2=imu.accel_m_s2 / 9.80665))
    assert list(in_g) == ["gravity"] and "in g" in in_g["gravity"].advice
    swapped = imu_rows(measured, replace(imu, gyro_rad_s=imu.accel_m_s2, accel_m_s2=imu.gyro_rad_s))
    assert "swapped" in swapped["units"].advice
    assert "rate" in imu_rows(measured, imu[::2])
    dead = imu.accel_m_s2.copy()
    dead[:, 1] = 0.0
    assert "accelerometer y" in imu_rows(measured, replace(imu, accel_m_s2=dead))["axes"].found
    spiked = imu.gyro_rad_s.copy()
    spiked[100:1000:200, 2] += 30.0
    assert imu_rows(measured, replace(imu, gyro_rad_s=spiked))["outliers"].found.startswith("5 ")
    clipped = np.clip(imu.accel_m_s2 * 4.0, -35.0, 35.0)
    assert "clipping" in imu_rows(measured, replace(imu, accel_m_s2=clipped))
    rows = np.flatnonzero((imu.t_ns < imu.t_ns[0] + 3e9) | (imu.t_ns > imu.t_ns[0] + 3.5e9))
    gap = ImuSamples(imu.t_ns[rows], imu.gyro_rad_s[rows], imu.accel_m_s2[rows])
    assert imu_rows(measured, gap)["gaps"].value == pytest.approx(0.5, abs=0.02)


def test_faults_of_the_images_are_named(measured: Measured) -> None:
    def rows(**parts: Any) -> dict[str, Finding]:
        return raised(camera_findings(replace(measured, sample=replace(measured.sample, **parts))))

    assert rows() == {}
    dull = tuple(
        tuple(replace(a, mean=6.0, spread=12.0, blur_px=5.0, black=0.9) for a in of)
        for of in measured.sample.appearance
    )
    assert {name: row.verdict for name, row in rows(appearance=dull).items()} == {
        "brightness": Verdict.WRONG, "blur": Verdict.WRONG, "clipped pixels": Verdict.WRONG
    }  # fmt: skip
    t_ns = tuple(measured.recording.frame_times_ns[1::2].tolist())
    assert rows(repeated=(t_ns,))["repeated images"].verdict is Verdict.WRONG
    few = tuple(replace(f, pixels=(f.pixels[0][:10], f.pixels[1][:10])) for f in measured.sample.flows)
    assert rows(flows=few)["features"].verdict is Verdict.WRONG
    times = np.delete(measured.recording.frame_times_ns, np.arange(40, 60))
    altered: Any = Altered(measured.recording, frame_times_ns=times)
    gaps = raised(camera_findings(replace(measured, recording=altered)))["gaps"]
    assert gaps.value == pytest.approx(1.05, abs=0.01) and gaps.found.startswith("images missing: 20; gaps: 1")


def test_clocks_and_calibration_are_judged_by_the_relation(measured: Measured) -> None:
    imu = imu_of(tumbling)
    camera = measured.recording.rig.cameras[0]
    R_cam_imu = camera.T_imu_cam[:3, :3].T

    def rows(Q: Any, offset_s: float = 0.0) -> dict[str, Finding]:
        rotations = rotations_of(imu, Q, offset_s)
        relation = relate(rotations, Gyroscope(imu))
        changed = replace(measured, rotations=rotations, relation=relation, course=None, lens=None, backwards=0.0)
        return raised([*clock_findings(changed), *calibration_findings(changed)])

    assert rows(R_cam_imu) == {}
    late = rows(R_cam_imu, -0.05)["time offset"]
    assert late.verdict is Verdict.SUSPECT and "50.0 ms late" in late.found and "-0.0500 s" in late.advice
    assert rows(R_cam_imu, 0.5)["time offset"].verdict is Verdict.WRONG
    turned = rows(exp_so3(np.radians([0.0, 20.0, 0.0])) @ R_cam_imu)["rotation of camera and IMU"]
    assert turned.verdict is Verdict.WRONG and turned.found.startswith("20.0 ")
    mirrored = rows(np.diag([1.0, -1.0, -1.0]) @ R_cam_imu)["rotation of camera and IMU"]
    assert "mirrored left to right" in mirrored.advice
    assert "handedness of the gyroscope" in rows(R_cam_imu @ np.eye(3)[[1, 0, 2]])
    other = relate(rotations_of(imu, R_cam_imu), Gyroscope(imu_of(lambda t: tumbling(1.7 * t + 40.0))))
    crossed = raised(clock_findings(replace(measured, relation=other, course=None, backwards=0.0)))
    assert crossed["images and gyroscope"].verdict is Verdict.WRONG
    reversed_rows = raised(clock_findings(replace(measured, relation=other, course=None, backwards=0.97)))
    assert "reverse" in reversed_rows["images and gyroscope"].advice


def test_defects_of_the_files_are_rows(flown: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mav0 = tmp_path / "altered" / "mav0"
    for source in (flown.folder / "mav0").glob("*/*"):
        target = mav0 / source.relative_to(flown.folder / "mav0")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.symlink_to(source.resolve())
    table = mav0 / "imu0" / "data.csv"
    head, *rows = table.read_text().splitlines()
    in_g = [row.split(",")[:4] + [f"{float(value) / 9.81:.9f}" for value in row.split(",")[4:]] for row in rows]
    table.unlink()
    table.write_text(
        "\n".join([head, *map(",".join, in_g[:500]), "1,2,nan,4,5,6,7", *map(",".join, in_g[500:])]) + "\n"
    )
    out = tmp_path / "page.html"
    assert main(["inspect", str(tmp_path / "altered"), "--out", str(out), "--cameras", "0"]) == 0
    printed = capsys.readouterr().out
    assert "Will not work as it is: IMU, gravity" in printed and "non-finite IMU sample" in printed
    assert "Will not work" in out.read_text(encoding="utf-8")


@pytest.mark.parametrize("verdict", [Verdict.GOOD, Verdict.SUSPECT, Verdict.WRONG])
def test_strict_fails_where_a_row_is_wrong(
    flown: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verdict: Verdict
) -> None:
    nothing: Any = None
    found = Inspection("flight", {}, (finding(Verdict.GOOD), finding(verdict)), nothing)
    monkeypatch.setattr("dronevio.inspection.page.inspection_page", lambda *_: "<html>")
    monkeypatch.setattr("dronevio.inspection.inspection.inspect", lambda *_, **__: found)
    arguments = ["inspect", str(flown.folder), "--out", str(tmp_path / "page.html")]
    assert main(arguments) == 0
    assert main([*arguments, "--strict"]) == (verdict is Verdict.WRONG)
    assert (tmp_path / "page.html").read_text() == "<html>"


def test_wrong_arguments_are_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(ConfigError, match="expected a recording or its path"):
        inspect(3)  # type: ignore[arg-type]
    assert main(["inspect", str(tmp_path / "none")]) == 2
    assert "no such file or folder" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_of_the_odometry_is_judged(flown: Any) -> None:
    found = inspect(flown.folder, run=True)
    assert found.verdict is Verdict.GOOD
    names = [each.name for each in found.findings if each.topic is Topic.ODOMETRY]
    assert names == ["start", "tracking", "innovations", "accuracy"]
