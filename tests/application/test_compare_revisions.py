"""Comparing revisions: what counts as a difference, in any bit or in accuracy, and which code a revision runs."""

import math
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.rotation import exp_so3
from dronevio.recording.recorder import rig_of


@pytest.fixture(scope="module")
def apart(script: Callable[[str], Any]) -> Any:
    return script("revision_differences")


@pytest.fixture(scope="module")
def cases(script: Callable[[str], Any]) -> Any:
    return script("revision_cases")


@pytest.fixture(scope="module")
def compare(script: Callable[[str], Any]) -> Any:
    return script("compare_revisions")


@pytest.fixture(scope="module")
def probe(script: Callable[[str], Any]) -> Any:
    return script("revision_probe")


def test_same_arrays_are_identical(apart: Any) -> None:
    arrays = {"time [ns]": np.arange(3), "velocity [m/s]": np.array([[1.0, 2.0], [np.nan, np.nan]])}
    found = apart.differences("mono", arrays, {name: values.copy() for name, values in arrays.items()})
    assert [d.identical for d in found] == [True, True]
    assert all(d.within(0.0) for d in found)


def test_largest_absolute_difference(apart: Any) -> None:
    a = np.zeros((4, 3))
    b = a.copy()
    b[2, 1], b[3, 0] = -3e-9, 1e-9
    d = apart.difference("mono", "position [m]", a, b)
    assert d.largest == 3e-9
    assert d.within(3e-9)
    assert not d.within(2.9e-9)


def test_rotations_differ_by_their_angle(apart: Any) -> None:
    angles = np.array([1e-12, 1e-6, 0.3, 3.0])
    axis = np.array([0.6, 0.0, 0.8])
    a = exp_so3(np.tile([0.4, -1.0, 0.2], (4, 1)))
    found = apart.rotation_angles(a, a @ exp_so3(angles[:, None] * axis))
    np.testing.assert_allclose(found, angles, rtol=1e-9, atol=1e-15)


def test_covariances_differ_relatively(apart: Any) -> None:
    a = np.diag([4.0, 1e-6, 0.0])[None]
    b = a.copy()
    b[0, 0, 1] = 1e-3  # standard deviations 2 and 1e-3
    assert apart.difference("mono", "covariance [relative]", a, b).largest == pytest.approx(0.5)


def test_a_missing_value_is_a_difference(apart: Any) -> None:
    a, b = np.tile(np.eye(2), (3, 1, 1)), np.tile(np.eye(2), (3, 1, 1))
    b[1] = np.nan
    d = apart.difference("mono", "covariance [relative]", a, b)
    assert (d.largest, d.unmatched) == (0.0, 1)
    assert not d.within(1e3)


def test_a_row_may_lack_some_values(apart: Any) -> None:
    a = np.array([[1.0, np.nan], [2.0, np.nan], [np.nan, 3.0]])
    b = np.array([[1.5, np.nan], [np.nan, 2.0], [np.nan, 3.0]])
    d = apart.difference("mono", "health report", a, b)
    assert (d.largest, d.unmatched) == (0.5, 1)


def test_no_tolerance_means_the_same_bits(apart: Any) -> None:
    a = np.array([0.0, 1.0])
    for b in (np.array([-0.0, 1.0]), a.astype(np.float32)):
        d = apart.difference("mono", "position [m]", a, b)
        assert d.largest == 0.0
        assert not d.within(0.0)
        assert d.within(1e-12)


def test_single_numbers_differ(apart: Any) -> None:
    assert apart.difference("scores", "ATE", np.array(0.25), np.array(0.5)).largest == 0.25
    assert apart.difference("scores", "ATE", np.array(np.nan), np.array(0.5)).unmatched == 1
    assert apart.difference("sfm", "points", np.zeros((0, 3)), np.zeros((0, 3))).identical


def test_mean_ratio_by_hand(apart: Any) -> None:
    mean, bound = apart.mean_ratio(np.array([0.5, 2.0, 1.0, 1.0]))
    assert mean == pytest.approx(1.0)
    # logarithms ±ln 2, 0, 0: s = ln 2 √(2/3), and Student's t of 3 degrees of freedom at 95 % is 2.3534
    assert bound == pytest.approx(math.exp(2.3534 * math.log(2.0) * math.sqrt(2.0 / 3.0) / 2.0), rel=1e-4)
    assert apart.mean_ratio(np.full(30, 1.01)) == pytest.approx((1.01, 1.01))


def test_a_lost_flight_is_the_worst_and_a_won_one_is_no_gain(apart: Any) -> None:
    base = {"ATE [m]": np.array([0.1, 0.1, 0.1, np.nan, np.nan]), "poses": np.array([100.0, 100.0, 100.0, 0.0, 0.0])}
    head = {"ATE [m]": np.array([0.2, np.nan, 0.01, 0.01, np.nan]), "poses": np.array([96.0, 0.0, 94.0, 100.0, 0.0])}
    ratios = apart.paired_ratios(base, head)
    np.testing.assert_allclose(ratios, [2.0, math.inf, math.inf, 1.0, 1.0])
    assert apart.mean_ratio(ratios) == (math.inf, math.inf)


def test_words_and_counts_differ_by_number(apart: Any) -> None:
    a, b = np.array(["tracking", "lost", "lost"]), np.array(["tracking", "lost", "tracking"])
    assert apart.difference("mono", "health", a, b).largest == 1.0
    assert not apart.difference("mono", "health", a, b).within(1e-9)


def test_absent_or_longer_arrays_never_pass(apart: Any) -> None:
    found = apart.differences("flight", {"cam1 images": np.array(["ab"])}, {"cam0 images": np.array(["ab"])})
    assert [d.largest for d in found] == [math.inf, math.inf]
    assert not apart.difference("mono", "time [ns]", np.arange(3), np.arange(4)).within(1e9)


def test_images_are_hashed_by_their_pixels(probe: Any, tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (24, 32), dtype=np.uint8)
    fast, small, other = (tmp_path / name for name in ("fast.png", "small.png", "other.png"))
    cv2.imwrite(str(fast), image, [cv2.IMWRITE_PNG_COMPRESSION, 0])
    cv2.imwrite(str(small), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    image[3, 4] ^= 1
    cv2.imwrite(str(other), image)
    assert fast.read_bytes() != small.read_bytes()
    assert probe.image_hash(fast) == probe.image_hash(small) != probe.image_hash(other)


def test_names_of_the_package_are_found(probe: Any) -> None:
    for name in probe.NAMES:
        assert probe.found(name) is not None


def test_renamed_attributes_are_found(probe: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(probe.RENAMED, "new", "old")
    assert probe.attribute(SimpleNamespace(new=1), "old") == probe.attribute(SimpleNamespace(old=1), "old") == 1
    assert probe.attribute(SimpleNamespace(other=2), "other") == 2


@dataclass(frozen=True)
class _Part:
    landmarks_odom: tuple[float, ...]
    times_s: float
    name: str | None


def test_results_are_flattened(probe: Any) -> None:
    part = _Part((1.0, 2.0), 3.0, None)
    found = probe.flattened("sfm", {"parts": (part, part), "kinds": ("a", "b")})
    assert set(found) == {
        "sfm kinds",
        *(f"sfm parts {i} {name}" for i in (0, 1) for name in ("landmarks_world", "name")),
    }
    np.testing.assert_array_equal(found["sfm parts 1 landmarks_world"], [1.0, 2.0])
    assert found["sfm parts 0 name"].tolist() == ["None"]
    assert found["sfm kinds"].tolist() == ["a", "b"]


def test_values_of_steps_are_stacked(probe: Any) -> None:
    steps = [{"reward": np.array(1.0)}, {"reward": np.array(2.0), "end": np.array("crash")}, {"end": np.array("goal")}]
    found = probe.stacked(steps)
    assert found["reward"].tolist() == [1.0, 2.0]
    assert found["end"].tolist() == ["crash", "goal"]
    assert found["steps"].tolist() == ["reward [0, 1]", "end [1, 2]"]
    assert probe.stacked([{"goals": np.zeros(2)}, {"goals": np.ones(1)}])["goals"].tolist() == [0.0, 0.0, 1.0]


def test_a_lost_flight_has_no_error(probe: Any, tmp_path: Path) -> None:
    found = probe.ates([tmp_path / "missing"])
    assert np.isnan(found["ATE [m]"]).all()
    assert np.isnan(found["poses"]).all()


def test_the_probe_refuses_other_code(probe: Any, tmp_path: Path) -> None:
    source = Path(probe.__file__)
    command = [sys.executable, str(source), "check", "--code"]
    assert subprocess.run([*command, str(source.parents[1])], check=False).returncode == 0
    done = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "expected it below" in done.stderr


def test_options_are_spelled_as_the_revision_does(compare: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(compare.OPTIONS, "--old", ("--new", "--old"))
    assert compare.spelled("--old", "  --old INT") == "--old"
    assert compare.spelled("--old", "  --new INT") == "--new"
    assert compare.spelled("value", "") == "value"
    with pytest.raises(SystemExit, match="no option"):
        compare.spelled("--out", "--out-of-reach")


def test_options_of_the_flights_exist(compare: Any, cases: Any, help_of_fly: str) -> None:
    flights = [case.flight for case in cases.CASES.values() if case.flight] + [f for _, f in cases.paired_flights()]
    for flight in flights:
        options = [word for word in flight.options.split() if word.startswith("--")]
        assert len(options) >= 2
        assert [compare.spelled(word, help_of_fly)[:2] for word in options] == ["--"] * len(options)


def test_rigs_of_the_cases_are_read(cases: Any, tmp_path: Path) -> None:
    used = {case.flight.rig for case in cases.CASES.values() if case.flight and case.flight.rig}
    assert used == set(cases.RIGS)
    for name, text in cases.RIGS.items():
        (tmp_path / "camchain.yaml").write_text(text, encoding="utf-8")
        rig = rig_of(str(tmp_path / "camchain.yaml"))
        assert len(rig.cameras) == text.count("camera_model"), name


def test_cases_are_computed_by_the_probe(compare: Any, cases: Any, probe: Any) -> None:
    assert len(cases.CASES) >= 12
    assert {case.probe for case in cases.CASES.values()} | {"check", "ate"} == set(probe.COMPUTATIONS)
    with pytest.raises(SystemExit, match="expected some of mono"):
        compare.main(compare.CompareRevisions("HEAD", work=Path(), only=("mona",)))


def test_paired_flights_are_many_and_differ(cases: Any) -> None:
    names, flights = zip(*cases.paired_flights(), strict=True)
    assert len(set(names)) == len(set(flights)) >= 30
    assert sum("stereo" in name for name in names) == len(names) / 2


def test_identical_quantities_are_one_row(compare: Any, apart: Any) -> None:
    a = {"time [ns]": np.arange(3), "position [m]": np.zeros((3, 3)), "health": np.array(["lost"])}
    rows = compare.summary("mono", apart.differences("mono", a, {**a, "position [m]": np.full((3, 3), 0.5)}), 0.0)
    assert [row[:2] for row in rows] == [["mono", "2 quantities"], ["mono", "position [m]"]]
    assert rows[0][2] == rows[0][3]
    assert [row[-1] for row in rows] == ["identical", "DIFFERS: 0.5"]


@pytest.mark.parametrize(("ratio", "code"), [(1.0, 0), (1.019, 0), (1.021, 1), (math.nan, 1)])
def test_a_larger_error_fails(
    compare: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, ratio: float, code: int
) -> None:
    def probe(revision: Any, what: str, paths: list[Path], out: Path) -> None:
        errors = np.full(len(paths), 0.02 if revision.name == "base" else 0.02 * ratio)
        out.parent.mkdir(parents=True, exist_ok=True)
        arrays: dict[str, Any] = {"ATE [m]": errors, "poses": np.full(len(paths), 90.0)}
        np.savez(out, **arrays)

    monkeypatch.setattr(compare, "probe", probe)
    monkeypatch.setattr(compare, "recording_of", lambda base, flight, work: tmp_path)
    base, head = (compare.Revision(name, tmp_path) for name in ("base", "head"))
    command = compare.CompareRevisions("base", "head", work=tmp_path, markdown=tmp_path / "table.md")
    assert compare.compare_errors(command, base, head, tmp_path) == code
    assert "32 flights" in (tmp_path / "table.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def help_of_fly() -> str:
    command = [sys.executable, "-m", "dronevio.cli", "fly", "--help-all"]
    environment = {**os.environ, "COLUMNS": "200"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
