"""What the benchmarks share: changes of recordings, counts of runs, tables and kept results."""

import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dronevio.models.state import Health


@dataclass(frozen=True)
class Kept:
    name: str
    value: float


def result_of(name: str, value: float) -> Kept:
    return Kept(name, 2.0 * value)


@pytest.fixture(scope="module")
def measuring(script: Callable[[str], Any]) -> Any:
    return script("measuring")


def test_frames_are_chosen_and_replaced(measuring: Any, noise_recording: Callable[..., Any]) -> None:
    source = noise_recording(frames=6)
    whole = measuring.ChangedRecording.of(source)
    np.testing.assert_array_equal(whole.frame(3).images[0], source.frame(3).images[0])
    part = whole.chosen(np.array([1, 4, 5]))
    np.testing.assert_array_equal(part.frame_times_ns, source.frame_times_ns[[1, 4, 5]])
    assert part.imu is source.imu
    reversed_part = part.shown(np.array([2, 1, 0])).with_images(lambda image: 255 - image)
    frame = reversed_part.frame(0)
    assert frame.t_ns == source.frame_times_ns[1]
    np.testing.assert_array_equal(frame.images[0], 255 - source.frame(5).images[0])


def test_a_section_has_the_samples_of_its_frames(measuring: Any, noise_recording: Callable[..., Any]) -> None:
    source = noise_recording(frames=40)
    section = measuring.section_of(source, 10)
    t_ns = section.frame_times_ns
    assert len(t_ns) == 10 and section.ground_truth is None
    inside = (source.imu.t_ns >= t_ns[0] - 20_000_000) & (source.imu.t_ns < t_ns[-1] + 50_000_000)
    np.testing.assert_array_equal(section.imu.t_ns, source.imu.t_ns[inside])
    with pytest.raises(SystemExit, match="no ground truth"):
        measuring.with_truth(section)


def test_frames_of_a_run_are_counted(measuring: Any) -> None:
    kinds = (Health.INITIALIZING, Health.TRACKING, Health.LOST, Health.TRACKING)
    estimates = [SimpleNamespace(t_ns=int(k * 5e7), health=kind, state=k > 0 or None) for k, kind in enumerate(kinds)]
    run = SimpleNamespace(estimates=estimates, t_ns=[0])
    assert (measuring.frames_of(run, Health.TRACKING), measuring.frames_of(run, *measuring.NO_POSE)) == (2, 2)
    assert measuring.first_pose_s(run) == pytest.approx(0.05)
    assert math.isnan(measuring.first_pose_s(SimpleNamespace(estimates=estimates[:1], t_ns=[0])))


def test_rows_are_printed_with_their_headings(measuring: Any, capsys: pytest.CaptureFixture[str]) -> None:
    rows = [{"case": "a", "error [mm]": "1.5"}, {"case": "b", "error [mm]": measuring.text(math.inf)}]
    measuring.print_as_made(rows)
    printed = capsys.readouterr().out.splitlines()
    assert printed == ["| case | error [mm] |", "| :--- | ---: |", "| a | 1.5 |", "| b | ∞ |"]
    measuring.print_rows("Errors", rows)
    assert capsys.readouterr().out.splitlines()[1:5:3] == ["case  error [mm]", "b              ∞"]
    measuring.print_rows("Nothing", [])
    assert capsys.readouterr().out == ""
    assert [measuring.text(value) for value in (None, math.nan, 1.0)] == ["–", "–", "1.000"]


def test_results_are_kept_and_continued(measuring: Any, tmp_path: Path) -> None:
    file = tmp_path / "results.jsonl"
    assert measuring.kept_results(file, Kept) == []
    assert list(measuring.computed(file, [], result_of, [("a", 1.0), ("ü", 2.0)], 1)) == [
        Kept("a", 2.0),
        Kept("ü", 4.0),
    ]
    kept = measuring.kept_results(file, Kept)
    assert list(measuring.computed(file, kept, result_of, [("c", 0.5)], 1)) == [*kept, Kept("c", 1.0)]
    assert [json.loads(line)["name"] for line in file.read_text(encoding="utf-8").splitlines()] == ["a", "ü", "c"]
