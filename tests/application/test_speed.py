"""``dronevio speed``: measurements and their bounds."""

import json
from dataclasses import replace

import pytest

from dronevio.cli import main
from dronevio.cli.commands.speed.recording_cost import (
    Timing,
    measured_rig,
    measured_scenario,
    minute_figure,
    scaling_figure,
)
from dronevio.models.performance import PerformanceFigure
from dronevio.models.rig_presets import rig_named
from dronevio.sim.flight import fly
from dronevio.sim.speed.batch_throughput import BatchTiming, figures_of


@pytest.mark.slow
def test_simulator_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "sim", "--quick", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["world"], document["rig"], document["seed"]) == ("room", "euroc", 0)
    assert document["machine"]["cores"] >= 1 and document["packages"]["mujoco"]
    figures = document["figures"]
    assert [figure["bound"] for figure in figures] == [1.3, 20.0, 1.7, 45.0, 1.1]
    for figure in figures:
        assert figure["value"] > 0.0 and figure["method"]
        assert figure["ratio"] == pytest.approx(figure["value"] / figure["bound"])
        assert figure["met"] == ((figure["ratio"] <= 1.0) == (figure["sense"] == "at most"))
    camera, flight, _, _, memory = (figure["value"] for figure in figures)
    assert camera > 1.0  # a lens costs something
    assert flight > 1.0
    assert 0.8 < memory < 1.2


@pytest.mark.slow
def test_evaluation_is_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "eval", "--quick", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["packages"]["evo"] and document["quick"]
    command, library, size, memory = document["figures"]
    assert [figure["bound"] for figure in document["figures"]] == [0.5, 10.0, 2.0, 1.1]
    assert 0.0 < command["value"] < 1.0  # measured beside other tests: the bound is that of an idle machine
    assert library["met"] and size["met"]
    assert 0.5 < memory["value"] < 1.1
    assert main(["speed", "eval", "--quick", "--truth", "x.txt"]) == 2
    assert "only one of --truth and --estimate; expected both or none" in capsys.readouterr().err


def test_many_vehicles_are_measured(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["speed", "gym", "--quick", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["subject"], document["envs"], document["runs"]) == ("gym", 16, 2)
    figures = document["figures"]
    assert [figure["name"] for figure in figures[:5]] == [
        "plant with IMU, by bare physics",
        "plant without IMU, by bare physics",
        "vector environment without IMU, by bare physics",
        "plant with IMU",
        "vector environment with IMU",
    ]
    assert [figure["bound"] for figure in figures] == [3.0, 3.5, 2.5, 900.0, 600.0, 600.0, 600.0]
    plant, plant_without_imu, without_imu, speed, environment, grey, depth = (figure["value"] for figure in figures)
    assert 0.0 < plant < 10.0 and 0.0 < plant_without_imu < 15.0 and 0.0 < without_imu < 10.0
    assert speed > 5.0 and environment > 1.0
    assert grey > 10.0 and depth > 10.0
    assert main(["speed", "gym", "--runs", "0"]) == 2
    assert "--runs 0; expected a whole number, 1 to 1000" in capsys.readouterr().err


def test_ratios_of_many_vehicles_are_medians_of_runs() -> None:
    timings = [
        BatchTiming(10.0, 4.0, 2.5, 5.0, 2.0),
        BatchTiming(15.0, 3.0, 3.0, 1.0, 4.0),
        BatchTiming(10.0, 10.0, 4.0, 0.2, 4.0),
    ]
    figures = figures_of(timings, count=100, actions=50)
    plant, plant_without_imu, without_imu, speed, environment = figures
    assert [figure.value for figure in figures] == [2.5, 4.0, 3.75, 25.0, 100.0]
    assert not plant.met and plant_without_imu.met and without_imu.met and not speed.met and not environment.met
    assert "bare: 10 simulated s" in plant.method and "33 simulated s" in plant_without_imu.method
    assert "25 simulated s" in without_imu.method and "15.00 of the bare physics" in environment.method


def test_bounds_are_upper_or_lower() -> None:
    least = PerformanceFigure("speed", 3.0, "m/s", 2.0, "at least", "")
    assert least.met and not replace(least, sense="at most").met
    assert least.ratio == 1.5
    assert replace(least, value=2.0).met and replace(least, value=2.0, sense="at most").met


def test_minute_is_extrapolated_without_the_startup() -> None:
    timing = Timing(duration_s=6.0, wall_s=5.0, startup_s=2.0, frames_per_s=40.0)
    figure = minute_figure(timing, world_s=3.0)
    assert figure.value == pytest.approx(3.0 + 2.0 + 10.0 * (5.0 - 2.0))
    assert "extrapolated from 6 s" in figure.method
    assert "measured completely" in minute_figure(replace(timing, duration_s=60.0), 3.0).method
    assert scaling_figure(replace(timing, frames_per_s=20.0), timing).value == 2.0


@pytest.mark.parametrize("duration_s", [5.0, 20.0])
def test_measured_scenario_has_the_given_duration(duration_s: float) -> None:
    flight = fly(measured_scenario("room", rig_named("euroc"), 0, duration_s))
    assert flight.truth.t_s[-1] == pytest.approx(duration_s, abs=0.1)
    assert flight.truth.p_world_imu[:, 2].max() > 0.5  # it flies


def test_measured_rig_has_fewer_pixels_and_another_rate() -> None:
    (camera,) = measured_rig("euroc", small_images=True, rate_hz=2.0).cameras
    (full,) = measured_rig("euroc", small_images=False).cameras
    assert camera.rate_hz == 2.0 and full.rate_hz == 20.0
    assert camera.model.width == full.model.width // 8
    assert camera.model.width / camera.model.fx == pytest.approx(full.model.width / full.model.fx)
