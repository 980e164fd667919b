"""Reports of reconstructions: self-contained pages, escaped text, numbers equal to the metrics, and pictures."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import gtsam
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.eval.metrics import compare_positions
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report import ReconstructionResults, write_reconstruction_report
from dronevio.eval.report.reconstruction.model import image_summaries
from dronevio.models import read_reconstruction
from dronevio.models.errors import EvaluationError
from dronevio.models.reconstruction import Reconstruction
from tests.browser import Browser

if TYPE_CHECKING:
    from tests.eval.conftest import Page, ReadPage, SyntheticReconstruction

INFO = RunInfo(
    title="A <script>alert(1)</script> & wall",
    command="dronevio sfm photos",
    open_command="rerun reconstruction.rrd",
    configuration={"matching": {"kind": "exhaustive"}},
)
HOSTILE = """</style></title></td><script>alert('1')</script>{{ 7 * 7 }}{% raw %}& <b> "quoted\""""
LOST = ("photos/lost.jpg", "photos/other.jpg")
REASON = "Only 9 of 15 inliers in the resection"
TIMES_S = {"features": 1.5, "matching": 3.25, "mapping": 0.25}


def renamed(reconstruction: Reconstruction, prefix: str) -> Reconstruction:
    """Return a reconstruction of other images."""
    return replace(reconstruction, image_names=tuple(f"{prefix}{name}" for name in reconstruction.image_names))


@pytest.fixture(scope="module")
def results(synthetic: "SyntheticReconstruction") -> ReconstructionResults:
    """Return the results of twelve registered and two other images, in an order of their own."""
    r = synthetic.reconstruction
    seen = np.zeros((14, len(r.points)), np.int64)
    seen[1 + r.observation_image, r.observation_point] = 1
    return ReconstructionResults(
        [r],
        all_image_names=(LOST[0], *r.image_names, LOST[1]),
        unregistered={LOST[0]: REASON},
        times_s=TIMES_S,
        match_counts=seen @ seen.T,
        read_image=synthetic.images.get,
        true_positions_m=synthetic.true_positions_m,
        unit="m",
    )


@pytest.fixture(scope="module")
def folder(results: ReconstructionResults, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the report."""
    folder = tmp_path_factory.mktemp("report") / "new"
    write_reconstruction_report(folder, INFO, results)
    return folder


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    """Return the source of the report."""
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(html: str, read_page: "ReadPage") -> "Page":
    """Return the parsed report."""
    return read_page(html)


@pytest.fixture(scope="module")
def numbers(folder: Path) -> dict[str, Any]:
    """Return the content of the JSON report."""
    numbers: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return numbers


def text_of(page: "Page") -> str:
    """Return the text of a page with single spaces."""
    return " ".join("".join(page.text).split())


def test_the_page_is_self_contained(html: str, page: "Page") -> None:
    assert all(link.startswith(("data:image/jpeg;base64,", "data:image/png;base64,", "#")) for link in page.links)
    assert not {"link", "iframe", "object", "img"} & set(page.tags)
    assert not re.search(r"url\((?!#)|@import", html)
    assert "http" not in re.sub(r'"http://www\.w3\.org/(2000/svg|1999/xlink)"', "", html)  # XML namespaces


def test_all_text_is_escaped(synthetic: "SyntheticReconstruction", tmp_path: Path, read_page: "ReadPage") -> None:
    names = tuple(f"{HOSTILE}{i}" for i in range(12))
    r = replace(synthetic.reconstruction, image_names=names)
    info = RunInfo(HOSTILE, HOSTILE, HOSTILE, 0, {HOSTILE: HOSTILE}, {HOSTILE: HOSTILE}, {HOSTILE: HOSTILE})
    results = ReconstructionResults([r], unregistered={HOSTILE: HOSTILE}, times_s={HOSTILE: 1.0}, unit=HOSTILE)
    write_reconstruction_report(tmp_path, info, results)
    html = (tmp_path / "report.html").read_text()
    page = read_page(html)
    assert page.tags.count("script") == 1 and html.count("<title>") == 1  # the script that sorts tables
    # Title, heading, commands and three tables as in other reports; 6 captions, 12 names, name and reason, a stage,
    # and the unit on two axes of two plots.
    assert "".join(page.text).count(HOSTILE) == 10 + 6 + 12 + 2 + 1 + 4


def test_the_page_shows_the_numbers(page: "Page", results: ReconstructionResults) -> None:
    text, statistics = text_of(page), results.statistics
    assert statistics.registered_images == 12 and statistics.images == 14
    for value in (
        "12 of 14 images registered, 400 points",
        f"Reprojection error{statistics.error_median_px:.2f} px",
        f"r.m.s. {statistics.error_rms_px:.2f} px, 95 % below {statistics.error_p95_px:.2f} px",
        f"Mean track length{statistics.mean_track_length:.2f} images",
        "Processing time5.0 s",
        "features1.5030.0matching3.2565.0mapping0.255.0all stages5.00100",
        f"{LOST[0]}{REASON}",
        f"{LOST[1]}–",
        "376 × 240230.00229.00187.50119.50radtan−0.05, 0.01, 0, 0",
        "matching.kindexhaustive",
    ):
        assert value in text


def test_the_page_has_all_pictures(page: "Page") -> None:
    for start in (
        "Perspective view of 400 points and 12 cameras",
        "From above",
        "From the side",
        "Reprojection errors",
        "Track lengths",
        "Observations per image",
        "Reprojection error per image",
        "Mean residuals, camera 1",
        "photos/001.jpg: ",
        "Verified matches of 66 pairs of 14 images",
        "Camera positions from above: r.m.s.",
        "Position errors: r.m.s.",
    ):
        assert sum(alt.startswith(start) for alt in page.alts) == 1, start


def test_photographs_show_all_observations(html: str, results: ReconstructionResults) -> None:
    photographs = re.findall(r'<svg class="frame".*?</svg>', html, flags=re.DOTALL)
    assert len(photographs) == 6
    shown = {summary.name: summary.observations for summary in image_summaries(results)}
    for photograph in photographs:
        name = re.search(r'aria-label="(\S+):', photograph)
        assert name is not None
        assert photograph.count("<circle") == shown[name[1]]
    data = re.search(r"data:image/jpeg;base64,([^\"]+)", photographs[0])
    assert data is not None and results.read_image is not None
    image = cv2.imdecode(np.frombuffer(base64.b64decode(data[1]), np.uint8), cv2.IMREAD_COLOR_RGB)
    original = results.read_image("photos/001.jpg")
    assert image is not None and original is not None
    assert np.mean(np.abs(image.astype(float) - original)) < 8.0


def test_json_holds_the_numbers(numbers: dict[str, Any], results: ReconstructionResults) -> None:
    r = results.components[0]
    assert numbers["format"] == "dronevio-reconstruction-report/1"
    assert numbers["statistics"]["error_median_px"] == results.statistics.error_median_px
    assert numbers["components"] == [{"images": 12, "points": 400, "observations": len(r.observation_px)}]
    assert [camera["fx"] for camera in numbers["cameras"]] == [230.0]
    assert numbers["cameras"][0]["images"] == 12 and numbers["cameras"][0]["lens"] == "radtan"
    assert [image["name"] for image in numbers["images"]] == list(r.image_names)
    errors = r.reprojection_errors_px()[r.observation_image == 3]
    assert numbers["images"][3]["error_median_px"] == np.median(errors)
    assert numbers["images"][3]["observations"] == len(errors)
    assert numbers["unregistered"] == {LOST[0]: REASON, LOST[1]: None}
    assert numbers["times_s"] == TIMES_S
    comparison = compare_positions(r, results.true_positions_m)
    assert numbers["positions"][0]["rmse_m"] == comparison.rmse_m
    assert numbers["positions"][0]["reason"] is None


def test_the_picture_shows_points_on_a_dark_ground(folder: Path) -> None:
    picture = cv2.imread(str(folder / "reconstruction.png"), cv2.IMREAD_COLOR)
    assert picture is not None and picture.shape == (1000, 1600, 3)
    assert picture[0, 0].tolist() == [26, 21, 18]  # blue, green, red
    bright = np.mean(picture.max(axis=2) > 60)
    assert 0.005 < bright < 0.5


def test_the_same_results_give_the_same_bytes(folder: Path, results: ReconstructionResults, tmp_path: Path) -> None:
    write_reconstruction_report(tmp_path, INFO, results)
    for name in ("report.html", "report.json", "reconstruction.png"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


@pytest.mark.slow
def test_components_have_pictures_of_their_own(
    synthetic: "SyntheticReconstruction", tmp_path: Path, read_page: "ReadPage"
) -> None:
    r = synthetic.reconstruction
    components = [r, renamed(r, "b/"), renamed(r, "c/"), renamed(r, "d/")]
    few = dict(list(synthetic.true_positions_m.items())[:6])
    write_reconstruction_report(tmp_path, INFO, ReconstructionResults(components, true_positions_m=few))
    page = read_page((tmp_path / "report.html").read_text())
    text = text_of(page)
    assert "48 of 48 images registered in 4 components" in text
    assert sum(alt.startswith("Perspective view") for alt in page.alts) == 3
    assert "Components without pictures: 1." in text
    assert "Component 2 is not compared: 0 registered images have a true position" in text
    assert sum(alt.startswith("Position errors") for alt in page.alts) == 1
    assert "Verified matches" not in text and "Processing time" not in text


def test_points_alone_have_a_report(synthetic: "SyntheticReconstruction", tmp_path: Path) -> None:
    r, none = synthetic.reconstruction, np.zeros(0, np.int64)
    points = Reconstruction((), (), none, np.zeros((0, 4, 4)), r.points, r.colours, none, none, np.zeros((0, 2)))
    write_reconstruction_report(tmp_path, INFO, ReconstructionResults([points]))
    assert "There are no observations" in (tmp_path / "report.html").read_text()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"all_image_names": ("photos/000.jpg",)}, "image 'photos/001.jpg' is registered, but not in the list"),
        ({"match_counts": np.zeros((3, 3), np.int64)}, r"shape \(3, 3\); expected \(14, 14\)"),
    ],
)
def test_contradictions_are_named(results: ReconstructionResults, change: dict[str, Any], message: str) -> None:
    with pytest.raises(EvaluationError, match=message):
        replace(results, **change)


def test_nothing_to_report_is_refused(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="without components"):
        write_reconstruction_report(tmp_path, INFO, ReconstructionResults([]))
    assert not list(tmp_path.iterdir())


def test_the_numbers_of_balbianello(tmp_path: Path) -> None:
    r = read_reconstruction(gtsam.findExampleDataFile("Balbianello.out"))
    write_reconstruction_report(tmp_path, INFO, ReconstructionResults([r]))
    statistics = json.loads((tmp_path / "report.json").read_text())["statistics"]
    errors: npt.NDArray[np.float64] = r.reprojection_errors_px()
    assert (statistics["registered_images"], statistics["points"], statistics["observations"]) == (5, 544, 1417)
    assert statistics["mean_track_length"] == pytest.approx(1417 / 544)
    assert statistics["error_median_px"] == pytest.approx(np.median(errors))
    assert statistics["error_median_px"] < 0.2


def test_the_page_in_a_browser(folder: Path, browser: Browser) -> None:
    assert browser.faults((folder / "report.html").as_uri()) == []
    assert browser.evaluate("document.querySelectorAll('.tile').length") == 5
