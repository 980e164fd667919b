"""Comparing revisions: what counts as a difference, and which code a revision runs."""

import math
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from dronevio.models.rotation import exp_so3


@pytest.fixture(scope="module")
def apart(script: Callable[[str], Any]) -> Any:
    return script("revision_differences")


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
        assert callable(probe.found(name))


def test_the_probe_refuses_other_code(probe: Any, tmp_path: Path) -> None:
    source = Path(probe.__file__)
    command = [sys.executable, str(source), "check", "--code"]
    assert subprocess.run([*command, str(source.parents[1])], check=False).returncode == 0
    done = subprocess.run([*command, str(tmp_path)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "expected it below" in done.stderr


def test_options_are_spelled_as_the_revision_does(
    script: Callable[[str], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    compare = script("compare_revisions")
    monkeypatch.setitem(compare.OPTIONS, "--old", ("--new", "--old"))
    assert compare.spelled("--old", "  --old INT") == "--old"
    assert compare.spelled("--old", "  --new INT") == "--new"
    assert compare.spelled("value", "") == "value"
    with pytest.raises(SystemExit, match="no option"):
        compare.spelled("--out", "--out-of-reach")


@pytest.mark.parametrize("subject", ["mono", "stereo", "rolling", "flight"])
def test_options_of_the_flights_exist(script: Callable[[str], Any], subject: str, help_of_fly: str) -> None:
    compare = script("compare_revisions")
    options = [word for word in compare.FLIGHTS[subject].split() if word.startswith("--")]
    assert len(options) >= 4
    assert [compare.spelled(word, help_of_fly)[:2] for word in options] == ["--"] * len(options)


@pytest.fixture(scope="module")
def help_of_fly() -> str:
    command = [sys.executable, "-m", "dronevio.cli", "fly", "--help-all"]
    environment = {**os.environ, "COLUMNS": "200"}
    return subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
