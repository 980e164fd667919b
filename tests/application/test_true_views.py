"""True views of simulated flights and of their recordings."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.benchmark.true_views import flight_views, planned_views, recording_revisits, recording_views
from dronevio.cli.commands.fly import FlyCommand
from dronevio.cli.commands.run import repeating_command
from dronevio.cli.flight_options import FlightOptions, parse_flight
from dronevio.eval.metrics.revisits import RevisitRule, find_revisits
from dronevio.models.errors import InputError
from dronevio.models.recordings.euroc import EurocRecording
from dronevio.models.recordings.scenario_file import has_world
from dronevio.sim.flight import fly
from dronevio.sim.scenarios import SUITES, scenario_named

OPTIONS = ["--scenario", "room-easy", "--world-seed", "3", "--seed", "7", "--light-seed", "2", "--reverse"]


def test_planned_views_are_close_to_flown_ones() -> None:
    scenario = replace(scenario_named("short"), world="repetitive", seed=2)
    planned, flown = planned_views(scenario), flight_views(fly(scenario))
    shared, rows, others = np.intersect1d(planned.t_ns, flown.t_ns, return_indices=True)
    assert len(shared) > 20
    error = planned.Ts_world_cam[rows, :3, 3] - flown.Ts_world_cam[others, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.1
    axes = [views.Ts_world_cam[chosen, :3, 2] for views, chosen in ((planned, rows), (flown, others))]
    assert np.einsum("ki,ki->k", *axes).min() > np.cos(0.1)
    depth = [views.median_depth_m[chosen] for views, chosen in ((planned, rows), (flown, others))]
    assert np.median(np.abs(depth[0] / depth[1] - 1.0)) < 0.01


def test_views_of_a_recording_are_those_of_its_flight(flown: Any) -> None:
    flight = flight_views(fly(scenario_named("short")))
    recorded = recording_views(flown.folder, EurocRecording.open(flown.folder).frame_times_ns[::5])
    np.testing.assert_array_equal(recorded.t_ns, flight.t_ns)
    np.testing.assert_allclose(recorded.Ts_world_cam, flight.Ts_world_cam, atol=1e-5)
    np.testing.assert_allclose(recorded.path_m, flight.path_m, atol=1e-4)
    assert np.mean(np.abs(recorded.ranges_m - flight.ranges_m) < 1e-3) > 0.99


def test_views_of_other_folders_are_refused(flown: Any, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no frame at 17 ns"):
        recording_views(flown.folder, np.array([17]))
    shutil.copytree(flown.folder, tmp_path / "copy", symlinks=True)
    settings = tmp_path / "copy" / "scenario.json"
    document = json.loads(settings.read_text())
    for text in ("{}", "no JSON", json.dumps({"scenario": {**document["scenario"], "world_seed": None}})):
        settings.write_text(text)
        with pytest.raises(InputError, match=r"scenario\.json: no world with its seed"):
            recording_views(tmp_path / "copy", np.array([17]))
        assert has_world(flown.folder) and not has_world(tmp_path / "copy")
    settings.unlink()
    assert not has_world(tmp_path / "copy")


def test_the_first_revisit_is_that_of_the_true_motion(flown: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    frames_ns = EurocRecording.open(flown.folder).frame_times_ns
    keyframes_ns = frames_ns[3:9:2] + 1_000_000  # by the clock of the IMU
    none = recording_revisits(flown.folder, frames_ns[:0])
    assert none.first_ns is None and len(none.keyframes) == 0
    known = recording_revisits(flown.folder, keyframes_ns)
    assert known.first_ns is None and known.revisiting.tolist() == [False, False, False]
    np.testing.assert_array_equal(known.keyframes.t_ns, recording_views(flown.folder, frames_ns[3:9:2]).t_ns)
    rule = RevisitRule(age_s=1.9, path_m=0.0)  # what is two seconds old is still in view
    monkeypatch.setattr("dronevio.benchmark.true_views.find_revisits", lambda views: find_revisits(views, rule))
    assert (
        recording_revisits(flown.folder, keyframes_ns).first_ns == recording_views(flown.folder, frames_ns[::5]).t_ns[8]
    )


@pytest.mark.parametrize("name", ["room-square-laps-v0", "mirror-laps-v0"])
def test_flights_of_the_suites_come_back(name: str) -> None:
    assert name in (*SUITES["loops"], *SUITES["loops-deceptive"])
    assert 40.0 <= find_revisits(planned_views(scenario_named(name))).percent <= 80.0


def test_a_hover_and_a_single_lap_have_no_revisits() -> None:
    assert find_revisits(planned_views(scenario_named("hover"))).percent == 0.0
    assert find_revisits(planned_views(scenario_named("hall-medium"))).percent == 0.0


def test_options_of_world_light_and_direction() -> None:
    chosen = parse_flight(FlyCommand, OPTIONS, "fly").flight.chosen()
    assert (chosen.seed, chosen.world_seed, chosen.light_seed, chosen.reverse) == (7, 3, 2, True)
    assert replace(chosen, seed=0, world_seed=None, light_seed=None, reverse=False) == scenario_named("room-easy")
    assert repeating_command(chosen.name, chosen, OPTIONS) == (
        "dronevio run --scenario=room-easy-v0 --seed=7 --world-seed 3 --light-seed 2 --reverse"
    )
    assert FlightOptions.of(chosen).chosen() == chosen


def test_recordings_state_world_seed_and_light(flown: Any) -> None:
    stated = json.loads((flown.folder / "scenario.json").read_text())["scenario"]
    assert (stated["seed"], stated["world_seed"], stated["light_seed"], stated["reverse"]) == (0, 0, None, False)
