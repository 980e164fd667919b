"""The examples of the README run, and its commands, links and pictures exist."""

import hashlib
import json
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio.cli import COMMANDS, main
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import measurements
from dronevio.models.recordings.euroc import EurocRecording

CHECKOUT = Path(__file__).resolve().parents[2]
README = (CHECKOUT / "README.md").read_text(encoding="utf-8")
GENERATED = ("environments/", "reference/", "lessons/index")
"""Beginnings of links to pages that are generated when the site is built."""
PAGES = {"README.md": README}
if (CHECKOUT / "docs").is_dir():
    PAGES |= {f"docs/{page.name}": page.read_text(encoding="utf-8") for page in (CHECKOUT / "docs").glob("*.md")}


def blocks(language: str) -> list[str]:
    """Return the code blocks of a language in the README."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.MULTILINE | re.DOTALL)


def example(imported: str) -> str:
    """Return the Python example whose first line imports a module."""
    [found] = [code for code in blocks("python") if imported in code.splitlines()[0]]
    return found


def test_camera_example_estimates_the_motion(
    flown: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The example runs on a recorded flight in place of the reader's drone."""
    recording = EurocRecording.open(flown.folder)

    def sensors() -> Iterator[tuple[object, ...]]:
        imu = ImuSamples.empty()
        for measurement in measurements(recording):
            if isinstance(measurement, ImuSamples):
                imu = measurement
            else:
                yield imu.t_ns, imu.gyro_rad_s, imu.accel_m_s2, measurement.t_ns, measurement.images[0]

    my_drone = ModuleType("my_drone")
    my_drone.__dict__.update(T_imu_cam=recording.rig.cameras[0].T_imu_cam, sensors=sensors)
    monkeypatch.setitem(sys.modules, "my_drone", my_drone)
    code = example("my_drone")
    namespace: dict[str, Any] = {}
    exec(compile(code, "README.md", "exec"), namespace)

    printed = capsys.readouterr().out.splitlines()
    assert len(printed) > 90
    assert all("tracking" in line for line in printed)
    estimate, truth = namespace["estimate"], recording.ground_truth
    assert truth is not None
    assert printed[-1].startswith(str(recording.frame_times_ns[-1]))
    # The displacement from the first pose to the last is true but for its heading, which is not observable.
    first_ns, first_m = int(printed[0].split()[0]), np.array(re.findall(r"\[(.*?)\]", printed[0])[0].split(), float)
    start, end = (truth[np.searchsorted(truth.t_ns, [t])].Ts_world_imu[0] for t in (first_ns, estimate.t_ns))
    moved_m = estimate.state.T_world_imu[:3, 3] - first_m
    assert np.linalg.norm(moved_m) == pytest.approx(np.linalg.norm(end[:3, 3] - start[:3, 3]), abs=0.03)
    assert np.linalg.norm(estimate.state.velocity_m_s) < 0.05  # the drone is at rest again


def test_camera_example_has_ten_lines() -> None:
    lines = [line for line in example("my_drone").splitlines() if line and not line.startswith(("from", "import"))]
    assert len(lines) <= 10


@pytest.mark.slow
def test_functions_do_the_single_steps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], single_renderer: None
) -> None:
    """The example simulates, estimates and evaluates; the same files give the same error."""
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, Any] = {}
    exec(compile(example("import dronevio as dv"), "README.md", "exec"), namespace)
    recording, run = namespace["recording"], namespace["run"]
    score = dv.evaluate(recording, run).scores.ate_m
    assert score is not None and score.rmse < 0.05
    assert f"{score.rmse}" in capsys.readouterr().out
    dv.write_tum(tmp_path / "estimate.tum", run.trajectory)
    again = dv.evaluate(tmp_path / "recordings" / "short", tmp_path / "estimate.tum").scores.ate_m
    assert again is not None and again.rmse == pytest.approx(score.rmse, abs=1e-6)


def test_environment_example_runs(capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(example("gymnasium"), "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "(4, 6) (64, 64, 1)" in printed


def test_every_python_example_is_tested() -> None:
    assert len(blocks("python")) == 3


def shell_lines() -> list[list[str]]:
    return [
        words for block in blocks("sh") for line in block.splitlines() if (words := shlex.split(line, comments=True))
    ]


@pytest.mark.parametrize("line", [line for line in shell_lines() if line[0] == "dronevio"], ids=" ".join)
def test_commands_and_their_options_exist(line: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    _, *command = line
    assert command[0] in COMMANDS.subcommands
    depth = 2 if command[0] in ("speed", "book") else 1
    with pytest.raises(SystemExit):
        main([*command[:depth], "--help-all"])
    help_text = capsys.readouterr().out
    for word in command[depth:]:
        if word.startswith("--"):
            assert word in help_text


def test_targets_of_make_exist() -> None:
    makefile = CHECKOUT / "Makefile"
    if not makefile.exists():
        pytest.skip("not a checkout")
    targets = set(re.findall(r"^([a-z]+):", makefile.read_text(encoding="utf-8"), re.MULTILINE))
    named = {name for page in PAGES.values() for name in re.findall(r"make ([a-z]+)(?=[`\s]*[`#\n])", page)}
    assert {"run", "test", "setup"} <= named <= targets


@pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="not a checkout")
@pytest.mark.parametrize("page", PAGES)
def test_linked_files_exist_and_pictures_are_small(page: str) -> None:
    linked = re.findall(r"\]\(([^)#]+)\)|src=\"([^\"]+)\"", PAGES[page])
    for target in (one or other for one, other in linked):
        if "://" in target or target.startswith(GENERATED):
            continue
        path = (CHECKOUT / page).parent / target
        if target.startswith("lessons/"):  # generated from the lesson
            path = CHECKOUT / "dronevio" / "book" / Path(target).with_suffix(".py")
        assert path.is_file(), target
        if path.suffix in (".jpg", ".png"):
            assert path.stat().st_size < 400_000, target


@pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="not a checkout")
def test_files_that_the_architecture_page_names_exist() -> None:
    for name in re.findall(r"`([a-z_]+/[a-z_/.]*)`", PAGES["docs/architecture.md"]):
        assert (CHECKOUT / name).exists(), name


@pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="not a checkout")
def test_pictures_are_those_of_the_table() -> None:
    """The scores of the run in the pictures are those of its seed's row, and the pictures are those that were made."""
    recorded = json.loads((CHECKOUT / "docs" / "images" / "figures.json").read_text(encoding="utf-8"))
    text = PAGES["docs/getting-started.md"]
    lines = [
        line
        for line in text.partition("<!-- seeds -->")[2].partition("<!-- /seeds -->")[0].splitlines()
        if line.startswith("|")
    ]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    [row] = [dict(zip(rows[0], cells, strict=True)) for cells in rows[2:] if cells[0] == str(recorded["seed"])]
    assert recorded["figures"] and {title: row[title] for title in recorded["figures"]} == recorded["figures"]
    images = {path.name: path for path in (CHECKOUT / "docs" / "images").glob("*.jpg")}
    hashes = {name: hashlib.sha256(path.read_bytes()).hexdigest() for name, path in images.items()}
    assert hashes == recorded["pictures"]


@pytest.mark.skipif(not (CHECKOUT / "docs").is_dir(), reason="not a checkout")
@pytest.mark.parametrize("page", ["README.md", "docs/explore.md"])
def test_captions_of_the_exploration_are_those_of_its_flight(page: str) -> None:
    """The paragraph below the moving picture has the figures of the flight that it shows."""
    picture = CHECKOUT / "docs" / "images" / "explore.gif"
    recorded = json.loads(picture.with_suffix(".json").read_text(encoding="utf-8"))
    assert hashlib.sha256(picture.read_bytes()).hexdigest() == recorded["sha256"]
    assert picture.stat().st_size < 4_000_000
    figures = recorded["figures"]
    assert figures["outcome"] == "reached" and not figures["collided"]
    caption = " ".join(PAGES[page].partition("images/explore.gif)\n\n")[2].partition("\n\n")[0].split())
    assert f"flew {figures['path_m']:.1f} m, where the shortest path is {figures['shortest_m']:.1f} m" in caption
    assert f"in {figures['time_s']:.1f} s" in caption and f"the ATE is {1e3 * figures['ate_m']:.1f} mm" in caption
