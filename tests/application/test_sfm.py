"""``dronevio sfm`` and ``dv.sfm``: from five photographs to a reconstruction, its report and its files."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import gtsam
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

import dronevio as dv
from dronevio.cli import main
from dronevio.cli.commands.sfm import _components, _print_doubts
from dronevio.estimator.sfm.workspace import Workspace
from dronevio.eval.metrics.alignment import umeyama
from dronevio.exports import write_surface_files
from dronevio.models.camera import CameraModel
from dronevio.models.errors import InputError
from dronevio.models.geodesy import GeodeticPoint
from dronevio.models.image_sets import image_recording
from dronevio.models.image_sets.source import ImageSource, read_image_source, write_image_source
from dronevio.models.reconstruction import Reconstruction, SelfCalibration
from dronevio.models.reconstructions import read_reconstruction, write_reconstruction
from dronevio.models.recordings.calibration.kalibr import camchain_yaml, imu_yaml
from dronevio.models.rig_presets import rig_named
from dronevio.models.rotation import exp_so3
from dronevio.sfm_inputs import read_earlier
from tests.browser import Browser

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


@pytest.fixture(scope="module")
def photographs() -> Path:
    """Folder with five photographs of Villa Balbianello."""
    return Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent


@pytest.fixture(scope="module")
def reconstructed(photographs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the result of the command on the photographs."""
    folder = tmp_path_factory.mktemp("sfm") / "villa"
    formats = ("colmap-binary", "colmap-text", "ply", "nerfstudio")
    assert main(["sfm", str(photographs), "--out", str(folder), "--format", *formats, "--json"]) == 0
    return folder


def test_the_villa_agrees_with_bundler(reconstructed: Path) -> None:
    result = read_reconstruction(reconstructed / "colmap-binary" / "0")
    assert len(result.image_names) == 5
    assert np.median(result.reprojection_errors_px()) < 0.6
    bundler = gtsam.SfmData.FromBundlerFile(gtsam.findExampleDataFile("Balbianello.out"))
    others = np.stack([bundler.camera(i).pose().translation() for i in range(5)])
    found = umeyama(others, result.positions, with_scale=True)
    residuals = others - (found.scale * result.positions @ found.R_truth_estimate.T + found.t_m)
    extent = others - others.mean(axis=0)
    assert np.sqrt((residuals**2).sum() / (extent**2).sum()) < 0.015


def test_files_of_a_result(reconstructed: Path) -> None:
    names = {"colmap-binary", "colmap-text", "images.json", "nerfstudio", "points-0.ply", "run.rrd"}
    names |= {"reconstruction.png", "report.html", "report.json"}
    assert {path.name for path in reconstructed.iterdir()} == names
    assert list(reconstructed.parent.iterdir()) == [reconstructed]  # intermediate results are removed
    report = json.loads((reconstructed / "report.json").read_text(encoding="utf-8"))
    assert report["statistics"]["registered_images"] == 5
    assert "--format colmap-binary colmap-text ply nerfstudio" in report["command"]
    binary, text = (read_reconstruction(reconstructed / name / "0") for name in ("colmap-binary", "colmap-text"))
    np.testing.assert_allclose(text.Ts_world_cam, binary.Ts_world_cam, atol=1e-9)
    assert len(read_reconstruction(reconstructed / "points-0.ply").points) == len(binary.points)


def test_paths_of_nerfstudio_lead_to_the_photographs(reconstructed: Path, photographs: Path) -> None:
    folder = reconstructed / "nerfstudio" / "0"
    document = json.loads((folder / "transforms.json").read_text(encoding="utf-8"))
    files = {(folder / frame["file_path"]).resolve() for frame in document["frames"]}
    assert files == {path.resolve() for path in photographs.glob("*.jpg")}
    assert {path.name for path in folder.iterdir()} == {"transforms.json", "sparse_pc.ply"}


def test_the_function_gives_the_same(photographs: Path, reconstructed: Path) -> None:
    [result] = dv.sfm(photographs).reconstructions
    stored = read_reconstruction(reconstructed / "colmap-binary" / "0")
    np.testing.assert_allclose(result.positions, stored.positions, atol=1e-9)
    assert result.image_names == stored.image_names


@pytest.fixture(scope="module")
def tagged(photographs: Path, reconstructed: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Any]:
    """Folder with the five photographs and GPS tags, and their positions in east, north, up of an origin."""
    folder = tmp_path_factory.mktemp("tagged")
    found = read_reconstruction(reconstructed / "colmap-binary" / "0")
    extent = np.linalg.norm(found.positions - found.positions.mean(axis=0), axis=1).max()
    positions = 100.0 / extent * found.positions @ exp_so3(np.array([0.4, -0.9, 1.7])).T
    rng = np.random.default_rng(0)
    origin = GeodeticPoint(45.965, 9.203, 210.0)
    for name, place in zip(
        found.image_names, origin.from_enu(positions + rng.normal(scale=0.05, size=(5, 3))), strict=True
    ):
        exif = Image.Exif()
        gps = exif.get_ifd(0x8825)
        gps[1], gps[3] = "N", "E"
        gps[2] = (IFDRational(round(place[0] * 1e9), 10**9), IFDRational(0, 1), IFDRational(0, 1))
        gps[4] = (IFDRational(round(place[1] * 1e9), 10**9), IFDRational(0, 1), IFDRational(0, 1))
        gps[5], gps[6], gps[31] = b"\x02", IFDRational(round(place[2] * 1e4), 10**4), IFDRational(5, 100)
        with Image.open(photographs / name) as image:
            image.save(folder / name, quality=95, exif=exif)
    return folder, (origin, positions)


def test_photographs_with_gps_are_placed_on_earth(
    tagged: tuple[Path, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, (origin, positions) = tagged
    out = tmp_path / "villa"
    assert main(["sfm", str(folder), "--out", str(out)]) == 0
    printed, progress = capsys.readouterr()
    assert "writing: " in progress.splitlines()[-1]  # the last phase ends with the work
    assert "metric (GPS)" in printed and "north, standard deviation" in printed and "(ellipsoid)" in printed
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["unit"] == "m" and report["up"] == [0.0, 0.0, 1.0]
    stated = GeodeticPoint(**report["origin"])
    found = read_reconstruction(out)
    errors = origin.to_enu(stated.from_enu(found.positions)) - positions
    # 5 cm of noise, and 0.5 % of the extent between two reconstructions of differently compressed photographs
    assert np.sqrt(np.mean(np.sum(errors**2, axis=1))) < 0.5
    [geo] = report["georeferences"]
    assert geo["source"] == "gps" and len(geo["residuals_m"]) == 5 and geo["scale_sigma"] < 0.05
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Position on Earth" in page and f"{stated.latitude_deg:.6f}" in page
    cameras = json.loads((out / "cameras.geojson").read_text(encoding="utf-8"))["features"]
    assert [camera["properties"]["image"] for camera in cameras] == list(found.image_names)
    assert (out / "cameras.kml").read_text(encoding="utf-8").count("<Placemark>") == 5
    # The origin stays when images are added
    earlier = read_earlier(out)
    assert earlier.world.origin == stated and earlier.world.is_vertical
    assert main(["sfm", str(folder), "--out", str(tmp_path / "off"), "--set", "gps.use=off", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["worlds"][0]["scale"] == "arbitrary"
    assert not (tmp_path / "off" / "cameras.kml").exists()


@pytest.mark.parametrize(
    "origin",
    [{}, {"latitude_deg": "x"}, [1], {"latitude_deg": 1, "longitude_deg": 2, "altitude_m": 3, "reference": "moon"}],
)
def test_a_damaged_origin_of_an_earlier_result_is_ignored(reconstructed: Path, tmp_path: Path, origin: Any) -> None:
    shutil.copytree(reconstructed, tmp_path / "villa")
    report = json.loads((tmp_path / "villa" / "report.json").read_text(encoding="utf-8"))
    (tmp_path / "villa" / "report.json").write_text(json.dumps(report | {"origin": origin}), encoding="utf-8")
    assert read_earlier(tmp_path / "villa").world.origin is None


def test_bad_files_are_left_out_and_named(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder, out = tmp_path / "photographs", tmp_path / "villa"
    folder.mkdir()
    for number in (1, 2, 3):
        shutil.copy(photographs / f"BalbianelloMedium-{number}.jpg", folder / f"{number}.jpg")
    whole = (folder / "1.jpg").read_bytes()
    (folder / "half.jpg").write_bytes(whole[: len(whole) // 2])
    (folder / "text.jpg").write_text("a text")
    assert main(["sfm", str(folder), "--out", str(out), "--json", "--strict"]) == 2
    assert "text.jpg: a file that is not a supported image" in capsys.readouterr().err and not out.exists()
    (folder / "text.jpg").rename(folder / "text.gif")
    assert main(["sfm", str(folder), "--out", str(out), "--json"]) == 0
    printed = capsys.readouterr()
    document = json.loads(printed.out)
    assert set(document["left_out"]) == {"half.jpg", "text.gif"} and document["registered_images"] == 3
    assert printed.err.count("dronevio: warning:") == 2 and "half.jpg: an image that cannot be decoded" in printed.err
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    assert report["unregistered"] == document["left_out"]
    (folder / "text.gif").unlink()
    with pytest.raises(InputError, match="half"):
        dv.sfm(folder, strict=True)


@pytest.mark.slow
def test_an_interrupted_reconstruction_continues(photographs: Path, tmp_path: Path) -> None:
    first = dv.sfm(photographs, workspace=tmp_path / "work")
    stored = {path.name: path.stat().st_mtime_ns for path in (tmp_path / "work").iterdir()}
    assert sum(name.startswith("features-") for name in stored) == 5
    damaged = tmp_path / "work" / "features-000002.npz"
    damaged.write_bytes(damaged.read_bytes()[:1000])
    second = dv.sfm(photographs, workspace=tmp_path / "work")
    again = {path.name for path in (tmp_path / "work").iterdir() if path.stat().st_mtime_ns != stored[path.name]}
    assert again == {"features-000002.npz"}
    np.testing.assert_array_equal(first.reconstructions[0].points, second.reconstructions[0].points)


def test_unrelated_images_are_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rng = np.random.default_rng(0)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), rng.integers(0, 256, (120, 160), dtype=np.uint8))
    assert main(["sfm", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "no two of which determine the motion" in capsys.readouterr().err
    for k in (1, 2):
        (tmp_path / f"{k}.png").unlink()
    assert main(["sfm", str(tmp_path), "--out", str(tmp_path / "out")]) == 2
    assert "one image; expected images of one scene that overlap" in capsys.readouterr().err
    assert {path.suffix for path in tmp_path.iterdir()} == {".png"}  # neither a result nor intermediate ones


def test_formats_without_the_lens_are_refused_at_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def unexpected(*arguments: object, **settings: object) -> None:
        raise InputError(tmp_path, "the reconstruction was started", "no lens without a format")

    monkeypatch.setattr("dronevio.estimator.sfm.pipeline.reconstruct", unexpected)
    (tmp_path / "images").mkdir()
    for number in range(2):
        cv2.imwrite(str(tmp_path / "images" / f"{number}.png"), np.full((480, 640), number, np.uint8))
    rig = rig_named("euroc")
    model = CameraModel(640, 480, 200.0, 200.0, 319.5, 239.5, (-0.2, 0.6), "ds")
    chain = camchain_yaml(replace(rig, cameras=(replace(rig.cameras[0], model=model),))) + imu_yaml(rig)
    (tmp_path / "camchain.yaml").write_text(chain)
    command = ["sfm", str(tmp_path / "images"), "--calibration", str(tmp_path / "camchain.yaml")]
    assert main([*command, "--out", str(tmp_path / "out")]) == 2
    expected = "camera lens ds; expected one of radtan, equidistant, fov, eucm for COLMAP"
    assert expected in capsys.readouterr().err
    assert main([*command, "--out", str(tmp_path / "out"), "--format", "ply"]) == 2
    assert "the reconstruction was started" in capsys.readouterr().err


def test_finished_steps_are_kept_after_an_interruption_and_their_folder_is_named(
    photographs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(images: object, config: object, workspace: Workspace, *_: object, **__: object) -> None:
        assert workspace.folder is not None
        workspace.folder.mkdir()
        raise KeyboardInterrupt

    monkeypatch.setattr("dronevio.estimator.sfm.pipeline.reconstruct", interrupted)
    assert main(["sfm", str(photographs), "--out", str(tmp_path / "villa")]) == 130
    assert f"kept in {tmp_path / '.villa.work'}; the same command continues" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == [".villa.work"]


def test_an_existing_result_is_not_replaced(photographs: Path, reconstructed: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(reconstructed, copy)
    assert main(["sfm", str(photographs), "--out", str(copy)]) == 2
    assert (copy / "report.html").read_bytes() == (reconstructed / "report.html").read_bytes()


@pytest.mark.slow
def test_a_photograph_is_added(photographs: Path, reconstructed: Path, tmp_path: Path) -> None:
    whole = read_reconstruction(reconstructed)
    first = whole.observation_image < 4
    points, rows = np.unique(whole.observation_point[first], return_inverse=True)
    earlier = replace(
        whole,
        image_names=whole.image_names[:4],
        image_camera=whole.image_camera[:4],
        Ts_world_cam=whole.Ts_world_cam[:4],
        points=whole.points[points],
        colours=whole.colours[points],
        observation_image=whole.observation_image[first],
        observation_point=rows,
        observation_px=whole.observation_px[first],
    )
    write_reconstruction(earlier, tmp_path / "earlier" / "colmap-text" / "0", "colmap-text")
    assert main(["sfm", str(photographs), "--add-to", str(tmp_path / "earlier"), "--out", str(tmp_path / "more")]) == 0
    found = read_reconstruction(tmp_path / "more")
    assert found.image_names == whole.image_names
    extent = float(np.linalg.norm(np.ptp(whole.positions, axis=0)))
    np.testing.assert_allclose(found.positions, whole.positions, atol=0.005 * extent)
    values = json.loads((tmp_path / "more" / "report.json").read_text(encoding="utf-8"))
    assert (values["unit"], values["up"]) == ("", None)


def test_nothing_to_add_is_bad_input(
    photographs: Path, reconstructed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = str(tmp_path / "more")
    assert main(["sfm", str(photographs), "--add-to", str(reconstructed), "--out", out]) == 2
    assert "all 5 images are in the earlier reconstruction" in capsys.readouterr().err
    assert main(["sfm", str(photographs), "--add-to", str(reconstructed / "points-0.ply"), "--out", out]) == 2
    assert "points without images" in capsys.readouterr().err
    assert main(["sfm", str(photographs), "--earlier-images", str(photographs), "--out", out]) == 2
    assert "--earlier-images without --add-to" in capsys.readouterr().err


def test_accuracy_script_selects_moving_frames(script: Callable[[str], Any], flown: Result) -> None:
    accuracy = script("sfm_accuracy")
    recording = dv.open_recording(flown.folder)
    truth = recording.ground_truth
    assert truth is not None
    assert truth.velocity_m_s is not None
    frames = accuracy.moving_frames(recording, 10)
    assert len(frames) == 10
    assert np.all(np.diff(frames) > 0)
    rows = np.searchsorted(truth.t_ns, recording.frame_times_ns[frames])
    assert np.linalg.norm(truth.velocity_m_s[rows], axis=1).min() > 0.1
    # The camera is as far from the IMU as its mounting says, whatever the orientation.
    images = image_recording(recording, frames=frames.tolist())
    positions, is_known = accuracy.true_positions(truth, images)
    assert is_known.all()
    offsets = positions - truth.p_world_imu[rows]
    mounted = np.linalg.norm(recording.rig.cameras[0].T_imu_cam[:3, 3])
    np.testing.assert_allclose(np.linalg.norm(offsets, axis=1), mounted, atol=1e-6)


def test_accuracy_script_ignores_a_similarity(script: Callable[[str], Any]) -> None:
    accuracy = script("sfm_accuracy")
    true = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 1.0]])
    turned = 3.0 * true[:, [1, 2, 0]] + 5.0
    found = accuracy.align(true, turned)
    assert found.rmse_mm < 1e-9
    assert found.scale_percent == pytest.approx(200.0)
    assert found.tilt_deg == pytest.approx(90.0)  # z of the estimate is x of the truth
    assert accuracy.align(true, turned + np.array([[0.3, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 0]])).rmse_mm > 10.0


SMALL = ("--views.max-side-px", "240", "--depth.levels", "2", "--mesh.min-triangles", "20", "--json")
"""Words for a dense reconstruction that takes seconds."""


@pytest.mark.slow
def test_the_pages_in_a_browser(reconstructed: Path, tmp_path: Path, browser: Browser) -> None:
    assert browser.faults((reconstructed / "report.html").as_uri()) == []
    assert main(["dense", str(reconstructed), "--out", str(tmp_path / "dense"), *SMALL]) == 0
    assert browser.faults((tmp_path / "dense" / "report.html").as_uri()) == []


@pytest.mark.slow
def test_surfaces_of_the_villa(
    reconstructed: Path,
    photographs: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    # The scene has a place on Earth, which the files of surfaces receive
    place, origins = GeodeticPoint(47.0, 8.0, 500.0), set[GeodeticPoint | None]()
    report = json.loads((reconstructed / "report.json").read_text(encoding="utf-8"))
    scene = shutil.copytree(reconstructed, tmp_path / "scene")
    (scene / "report.json").write_text(json.dumps(report | {"origin": vars(place)}), encoding="utf-8")

    def write(folder: Path, form: Any, result: Any, origin: GeodeticPoint | None) -> None:
        origins.add(origin)
        write_surface_files(folder, form, result, origin)

    monkeypatch.setattr("dronevio.exports.write_surface_files", write)
    small = (*SMALL, "--format", "ply", "glb", "obj")
    assert main(["dense", str(scene), "--out", str(tmp_path / "dense"), *small]) == 0
    assert origins == {place}
    summary = json.loads(capsys.readouterr().out)
    names = {"dense.jpg", "dense.ply", "mesh.jpg", "mesh.ply", "report.html", "report.json", "run.rrd"}
    names |= {"mesh.glb", "mesh.obj", "mesh.mtl", "mesh-texture.jpg", "textured.jpg"}
    assert {path.name for path in (tmp_path / "dense").iterdir()} == names
    texture = cv2.imread(str(tmp_path / "dense" / "mesh-texture.jpg"))  # not the picture of the mesh in the report
    assert texture is not None and texture.shape[1] == 8192
    points = read_reconstruction(tmp_path / "dense" / "dense.ply").points
    assert len(points) == summary["points"] > 2000
    assert len(read_reconstruction(tmp_path / "dense" / "mesh.ply").points) == summary["vertices"] > 500
    sparse = read_reconstruction(reconstructed / "colmap-binary" / "0").points
    low, high = np.percentile(sparse, (1, 99), axis=0)
    margin = high - low
    assert np.mean(((points > low - margin) & (points < high + margin)).all(axis=1)) > 0.95
    model = str(reconstructed / "colmap-binary" / "0")
    assert not list(tmp_path.glob(".*"))  # intermediate results are removed
    assert main(["dense", model, "--out", str(tmp_path / "other")]) == 2
    assert "or --images" in capsys.readouterr().err
    assert main(["dense", model, "--images", str(photographs), "--out", str(tmp_path / "dense")]) == 2
    assert "--overwrite" in capsys.readouterr().err
    # Depth maps that are kept are used again
    assert main(["dense", str(scene), "--out", str(tmp_path / "kept"), "--keep-depths", *small]) == 0
    assert len(list((tmp_path / "kept" / "depths").iterdir())) == summary["images"]
    assert json.loads(capsys.readouterr().out)["reused"] == 0
    earlier = ["--add-to", str(tmp_path / "kept")]
    assert main(["dense", str(scene), "--out", str(tmp_path / "again"), *earlier, *small]) == 0
    again = json.loads(capsys.readouterr().out)
    assert (again["reused"], again["points"]) == (summary["images"], summary["points"])
    assert main(["dense", str(scene), "--out", str(tmp_path / "other"), "--add-to", str(tmp_path / "dense")]) == 2
    assert "no depth maps; expected the result of `dronevio dense --keep-depths`" in capsys.readouterr().err
    assert main(["dense", str(reconstructed), "--component", "3", "--out", str(tmp_path / "other")]) == 2
    assert "no reconstruction of component 3" in capsys.readouterr().err


def test_the_folder_of_the_images_is_remembered(reconstructed: Path, photographs: Path, tmp_path: Path) -> None:
    source = read_image_source(reconstructed / "images.json")
    assert source == ImageSource(photographs.resolve())
    assert len(source.open()) == 5
    changed = ImageSource(photographs, masks=tmp_path / "masks", cameras=(0, 1))
    write_image_source(tmp_path / "images.json", changed)
    again = read_image_source(tmp_path / "images.json")
    assert (again.masks, again.cameras) == ((tmp_path / "masks").resolve(), (0, 1))
    (tmp_path / "images.json").write_text("{}", encoding="utf-8")
    with pytest.raises(InputError, match="other contents"):
        read_image_source(tmp_path / "images.json")


def test_real_images_are_compared_with_their_mounting(script: Callable[[str], Any]) -> None:
    real = script("sfm_real")
    turned = np.eye(4)
    turned[:3, :3] = exp_so3(np.radians([0.0, 0.0, 1.0]))
    turned[:3, 3] = [3.0, 0.0, 0.0]
    none = np.empty(0, np.int64)
    found = Reconstruction(
        cameras=(CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5),),
        image_names=("right", "left"),
        image_camera=np.zeros(2, np.int64),
        Ts_world_cam=np.stack([turned, np.eye(4)]),
        points=np.empty((0, 3)),
        colours=np.empty((0, 3), np.uint8),
        observation_image=none,
        observation_point=none,
        observation_px=np.empty((0, 2)),
    )
    T_left_right = np.eye(4)
    T_left_right[:2, 3] = [1.0, 1.0]
    known = real.differences(found, real.RealSet("", None, (("left", "right"), ("a", "b")), T_left_right))
    assert known.rotation_deg == pytest.approx(1.0)
    assert known.direction_deg == pytest.approx(45.0)
    assert known.baseline_percent == 0.0
    assert np.isnan(known.disparity_px)


def test_pairs_and_guessed_focal_lengths_are_said(capsys: pytest.CaptureFixture[str]) -> None:
    camera = CameraModel(8, 6, 10.0, 10.0, 3.5, 2.5)

    def photographs(count: int) -> Any:
        return SimpleNamespace(names=tuple(map(str, range(count))))

    def result(*images: int, held: tuple[str, ...]) -> Any:
        found = [SimpleNamespace(image_names=photographs(n).names, cameras=(camera,)) for n in images]
        return SimpleNamespace(reconstructions=found, calibrations=[(SelfCalibration({}, held),)] * len(found))

    assert _components(result(5, held=())) == "1"
    assert _components(result(5, 2, 2, held=())) == "1, and 2 pairs of images"
    assert _components(result(2, held=())) == "none; 1 pair of images"
    _print_doubts(photographs(5), result(5, 2, held=("k1", "k2")))
    _print_doubts(photographs(2), result(2, held=()))
    assert capsys.readouterr().err == ""
    _print_doubts(photographs(3), result(2, held=("f", "k1", "k2")))
    error = capsys.readouterr().err
    assert "only pairs of the 3 images" in error and "10 px is a guess" in error
