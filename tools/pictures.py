"""Make the pictures of the pages in docs/images: ``make pictures``.

Screenshots are taken of a run's report in a browser and of its rerun file in the viewer. ``docs/images/figures.json``
records the scores of that run and the hashes of the pictures, so that the tests notice pictures of another run than
that of the table of ten seeds; ``make pictures`` makes both from the same runs. This needs Chromium, and a Vulkan
driver for the viewer. ``apt-get install chromium mesa-vulkan-drivers`` installs both on a machine without a graphics
card.
"""

import hashlib
import json
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import tyro
from environment_pictures import record_hashes
from matplotlib.figure import Figure
from rerun.experimental import ViewerClient
from seeds import accuracy

from dronevio.cli import main
from dronevio.cli.commands.view import HOST, free_port, viewer_program
from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.estimators.driver import estimate_recording
from dronevio.eval import colours
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.tum import read_tum
from dronevio.models.rotation import inverse_pose
from dronevio.sim.pictures.chase_camera import ChaseCamera
from dronevio.sim.pictures.contact_sheet import LENS, VIEWS, VIEWS_EACH, contact_sheet, sheet_of_worlds, views
from dronevio.sim.pictures.world_pictures import pictures_of_worlds
from dronevio.sim.scenarios import scenario_named
from dronevio.sim.world import WORLDS, build_world

Picture = npt.NDArray[np.uint8]

IMAGES = Path(__file__).resolve().parents[1] / "docs" / "images"
BROWSERS = ("chromium", "chromium-browser", "google-chrome")
REPORT_PX = (1200, 1284)  # to the end of the error plots
INSPECTION_PX = (1240, 3400)  # to the end of the plots of images and gyroscope
INSPECTION_WIDTH_PX = 900
INSPECTION_PARTS = (slice(0, 900), slice(2200, 3320))  # the verdict with the first rows, and the plots
RECORDING_PX = (1440, 900)
RECORDING_TOP_PX = 38  # height of the viewer's title bar
RECORDING_S = 17.0  # time of the flight that is shown
TAKE_OFF_S = 3.1
TAKE_OFF_PX = (960, 600)
ROOM_PX, ROOM_SHARE = 1504, 2 / 3  # the two upper rows of the contact sheet
WORLDS_PX, WORLDS_QUALITY = 1240, 84
OWN_WORLD_VIEWS = 8
WORLDS_SHOWN = tuple(name for name in WORLDS if not name.startswith("office-"))  # whose variants look alike
ESTIMATOR_S = 12.0  # time of the flight that is shown
VIEWER_TIMEOUT_S = 60.0


def save(name: str, picture: Picture, quality: int = 88) -> None:
    """Write a picture (H, W, 3) RGB as JPEG without chroma subsampling, which would blur text."""
    sharp = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    path = IMAGES / name
    cv2.imwrite(str(path), picture[..., ::-1], sharp)
    print(f"{name}: {picture.shape[1]} × {picture.shape[0]} px, {path.stat().st_size * 1e-3:.0f} kB")


def resized(picture: Picture, width_px: int) -> Picture:
    """Return a picture (H, W, 3) at a smaller width."""
    size = (width_px, round(picture.shape[0] * width_px / picture.shape[1]))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def read(path: Path) -> Picture:
    """Return a picture (H, W, 3) RGB."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if image is None:
        sys.exit(f"pictures: {path} does not exist")
    return np.asarray(image[..., ::-1], dtype=np.uint8)


def report_screenshot(page: Path, scratch: Path, size_px: tuple[int, int] = REPORT_PX) -> Picture:
    """Return a screenshot of the beginning of a page in a browser."""
    browser = next(filter(None, map(shutil.which, BROWSERS)), None)
    if browser is None:
        sys.exit(f"pictures: no browser; expected one of {', '.join(BROWSERS)}")
    size = ",".join(map(str, size_px))
    flags = ["--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", f"--window-size={size}"]
    shot = scratch / "report.png"
    subprocess.run([browser, *flags, f"--screenshot={shot}", page.resolve().as_uri()], check=True, capture_output=True)
    return read(shot)


def inspection_picture(page: Path, scratch: Path) -> Picture:
    """Return a screenshot of the beginning of the page of an inspection and of its first plots."""
    shot = report_screenshot(page, scratch, INSPECTION_PX)
    return resized(np.concatenate([shot[part] for part in INSPECTION_PARTS]), INSPECTION_WIDTH_PX)


@contextmanager
def viewer(recording: Path) -> Iterator[ViewerClient]:
    """Show a rerun file in a viewer without a window until the context ends."""
    port = free_port(0)
    size = "x".join(map(str, RECORDING_PX))
    options = ["--headless", "--bind", HOST, "--port", str(port), "--window-size", size]
    process = subprocess.Popen([*viewer_program(), *options, str(recording)], stderr=subprocess.DEVNULL)
    try:
        yield _connected(f"rerun+http://{HOST}:{port}/proxy")
    finally:
        process.terminate()
        process.wait()


def _connected(address: str) -> ViewerClient:
    """Return a connection to a viewer after it has loaded its file."""
    deadline = time.monotonic() + VIEWER_TIMEOUT_S
    while time.monotonic() < deadline:
        try:
            client = ViewerClient.connect(address)
            state = client.get_state()
            if state.views and not state.loading:
                return client
        except (RuntimeError, ConnectionError):  # the viewer is starting
            pass
        time.sleep(0.5)
    sys.exit("pictures: the viewer did not load the file; expected a Vulkan driver")


def recording_screenshot(recording: Path, scratch: Path) -> Picture:
    """Return a screenshot of the rerun viewer in the middle of the flight, once two screenshots are equal."""
    shot, before = scratch / "recording.png", b""
    with viewer(recording) as client:
        client.set_time("time", duration=RECORDING_S, play_state="paused")
        while (now := client.take_screenshot()) != before:
            before = now
            time.sleep(2.0)
    shot.write_bytes(now)
    return read(shot)[RECORDING_TOP_PX:]


def take_off_picture(run: Path) -> Picture:
    """Return an image of the chase camera during take-off."""
    flown = scenario_named("room", 0)
    truth = read_tum(run / "groundtruth.tum")
    T_world_imu = truth.Ts_world_imu[np.searchsorted(truth.t_s, TAKE_OFF_S)]
    chase_camera = ChaseCamera(build_world(flown.world, flown.seed), flown.quadrotor, flown.rig, *TAKE_OFF_PX)
    try:
        return chase_camera.render(T_world_imu @ inverse_pose(flown.rig.T_vehicle_imu))
    finally:
        chase_camera.close()


def draw_estimator(flight: Path, picture: Path) -> None:
    """Estimate a flight, and plot tracks in an image, path and landmarks from above, and health over time."""
    recording = open_recording(flight)
    run = estimate_recording(recording, VisualInertialOdometry(recording.rig))
    truth = recording.ground_truth
    assert truth is not None
    path = run.trajectory
    scored = score_trajectory(truth, path, recording.frame_times_ns)
    shown = int(np.searchsorted(run.t_ns, run.t_ns[0] + round(ESTIMATOR_S * 1e9)))
    estimate, t0_ns = run.estimates[shown], run.t_ns[0]
    figure = Figure(figsize=(15.0, 4.6), layout="constrained")
    image, above, health = figure.subplots(1, 3, width_ratios=(1.25, 1.0, 1.15))
    image.imshow(recording.frame(shown).images[0], cmap="gray", vmin=0, vmax=255)
    assert estimate.tracks is not None
    dots = image.scatter(*estimate.tracks.pixels.T, c=estimate.tracks.ages, s=14, cmap="viridis", vmin=0, vmax=60)
    figure.colorbar(dots, ax=image, shrink=0.75, label="age of the track [frames]")
    image.set(title="tracked features", xticks=(), yticks=())

    points = np.concatenate([e.landmarks_odom for e in run.estimates[:shown] if e.landmarks_odom is not None])
    above.scatter(*scored.alignment.positions(points)[:, :2].T, s=1, color=colours.SURROUNDINGS, alpha=0.3)
    above.plot(*truth.p_world_imu[:, :2].T, color=colours.TRUTH, label="truth")
    above.plot(*scored.alignment.positions(path.p_world_imu)[:, :2].T, color=colours.ESTIMATE, label="estimate")
    low, high = truth.p_world_imu.min(axis=0) - 3.0, truth.p_world_imu.max(axis=0) + 3.0
    above.set(title="path and landmarks, from above", xlabel="x [m]", ylabel="y [m]", aspect="equal")
    above.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    above.legend(loc="upper right")

    reports = [(e.t_ns, e.health_report) for e in run.estimates if e.health_report is not None]
    t_s = np.array([t_ns - t0_ns for t_ns, _ in reports]) * 1e-9
    health.plot(t_s, [report.tracks for _, report in reports], color=colours.SURROUNDINGS, label="tracks")
    health.plot(t_s, [report.landmarks for _, report in reports], color=colours.ESTIMATE, label="landmarks")
    most = max(report.tracks for _, report in reports)
    health.set(title="health", xlabel="time [s]", ylabel="features", ylim=(0, 1.35 * most))
    innovation = health.twinx()
    innovation.plot(
        t_s, [report.innovation_px for _, report in reports], color=colours.TRUTH, lw=0.8, label="innovation"
    )
    innovation.set(ylabel="median innovation [px]", ylim=(0, 2))
    lines = [*health.get_lines(), *innovation.get_lines()]
    health.legend(lines, [str(line.get_label()) for line in lines], loc="upper right")
    figure.savefig(picture, dpi=90)


def save_worlds() -> None:
    """Save the picture of the worlds, each from three viewpoints."""
    sheet = sheet_of_worlds(WORLDS_SHOWN, pictures_of_worlds(WORLDS_SHOWN, 0, VIEWS_EACH, LENS))
    save("worlds.jpg", resized(sheet, WORLDS_PX), WORLDS_QUALITY)


def save_own_world() -> None:
    """Save the picture of the world that a page describes, from several viewpoints.

    Raises:
        ValueError: The page does not describe it any more.
    """
    page = (IMAGES.parent / "how-to" / "own-world.md").read_text(encoding="utf-8")
    [text] = re.findall(r"The file `yard.yaml`:\n\n```yaml\n(.*?)^```$", page, re.M | re.S)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "yard.yaml"
        path.write_text(text, encoding="utf-8")
        sheet = contact_sheet(views(build_world(str(path), 3), OWN_WORLD_VIEWS))
    save("own-world.jpg", resized(sheet, WORLDS_PX), WORLDS_QUALITY)


def make_pictures(scratch: Path, shown: Path | None) -> None:
    """Run the commands, save all pictures, and record what they show.

    Args:
        scratch: Folder for intermediate files.
        shown: Folder of the run to show; by default the default scenario is run.
    """
    run = shown or scratch / "room-0"
    commands = [
        ["book", "imu", "--out", str(scratch / "imu")],
        ["book", "eqvio", "--out", str(scratch / "eqvio")],
    ]
    if shown is None:
        commands.insert(0, ["run", "--out", str(run)])
    for arguments in commands:
        if main(arguments) != 0:
            sys.exit(f"pictures: dronevio {' '.join(arguments)} failed")
    IMAGES.mkdir(parents=True, exist_ok=True)
    save("recording.jpg", recording_screenshot(run / "run.rrd", scratch))
    save("report.jpg", report_screenshot(run / "report.html", scratch))
    save("take-off.jpg", take_off_picture(run))
    sheet = contact_sheet(views(build_world("room", 0), VIEWS))
    rows = sheet[: int(ROOM_SHARE * len(sheet))]
    save("room.jpg", resized(rows, ROOM_PX))
    save_worlds()
    save_own_world()
    flight = scratch / "medium"
    main(["fly", "--scenario", "room-medium", "--rig", "euroc-stereo", "--out", str(flight)])
    draw_estimator(flight, scratch / "estimator.png")
    save("estimator.jpg", read(scratch / "estimator.png"))
    inspected = scratch / "inspected"
    main(["fly", "--scenario", "room", "--rig", "fisheye-stereo", "--out", str(inspected)])
    main(["inspect", str(inspected), "--out", str(scratch / "inspection.html")])
    save("inspection.jpg", inspection_picture(scratch / "inspection.html", scratch))
    save("book-imu.jpg", read(scratch / "imu" / "path.png"))
    save("book-camera.jpg", read(scratch / "imu" / "camera.png"))
    save("book-eqvio.jpg", read(scratch / "eqvio" / "paths.png"))
    record_figures(run)


def record_figures(run: Path) -> None:
    """Write the scores of the run that the pictures show, and the hashes of the pictures."""
    report = json.loads((run / "report.json").read_text(encoding="utf-8"))
    document = {
        "command": report["command"],
        "seed": report["seed"],
        "figures": accuracy(report),
        "pictures": {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(IMAGES.glob("*.jpg"))},
    }
    text = json.dumps(document, indent=2, ensure_ascii=False)
    (IMAGES / "figures.json").write_text(text + "\n", encoding="utf-8")


@dataclass(frozen=True)
class PicturesCommand:
    """Make the pictures of the pages."""

    run: Path | None = None
    """Folder of the run to show; by default the default scenario is run."""
    worlds: bool = False
    """Make only the picture of the worlds, which needs neither browser nor viewer."""


if __name__ == "__main__":
    given = tyro.cli(PicturesCommand, description=__doc__)
    if given.worlds:
        save_worlds()
        save_own_world()
        record_hashes()
        sys.exit()
    with tempfile.TemporaryDirectory(prefix="dronevio-") as folder:
        make_pictures(Path(folder), given.run)
