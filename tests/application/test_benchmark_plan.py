"""What ``dronevio benchmark`` is going to run: names of estimators, flights, variants, and what is refused."""

import re
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.benchmark import jobs
from dronevio.benchmark.jobs import recorded_flights, scenario_flights
from dronevio.benchmark.variants import variant_of
from dronevio.cli import main
from dronevio.estimators.registry import ESTIMATORS, estimator_named
from dronevio.models.errors import ConfigError, EvaluationError, InputError
from dronevio.models.extras import install_command
from dronevio.models.rig_presets import rig_named
from dronevio.recording.excerpts import MAX_DISCONTINUITY_M
from dronevio.sim.flight import reference_of
from dronevio.sim.physics.plant import QuadrotorPlant
from dronevio.sim.scenarios import scenario_named

Result = Any  # the class of conftest, which cannot be imported


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no flights; expected --suite, --scenarios or --recordings"),
        (["--suite", "moon"], "unknown suite 'moon'; expected one of room"),
        (["--scenarios", "moon"], "unknown scenario 'moon'"),
        (["--scenarios", "short", "--estimators", "oracle"], "unknown estimator 'oracle'; expected one of vio"),
        (["--scenarios", "short", "--estimators", "vio,vio"], "each name once"),
        (["--scenarios", "short", "--seeds", "0"], "--seeds 0; expected"),
        (["--scenarios", "short", "--workers", "0"], "--workers 0; expected"),
        (["--scenarios", "short", "--timeout-s", "nan"], "--timeout-s nan; expected"),
        (["--scenarios", "short", "--address", "auto"], "expected --engine ray"),
        (["--recordings", "nowhere"], "nowhere: no such file"),
        (
            ["--scenarios", "short", "--variants", "imu-1hz"],
            "unknown variant 'imu-1hz'; expected one of as-is, rig=…, imu-100",
        ),
        (["--scenarios", "short", "--variants", "reverse=1"], "unknown variant 'reverse=1'; expected one of as-is"),
        (["--scenarios", "short", "--variants", "as-is+reverse"], "unknown variant 'as-is'; expected one of as-is"),
        (["--scenarios", "short", "--variants", "world=-1"], "seed '-1' in a variant; expected a whole number from 0"),
        (["--scenarios", "short", "--variants", "light="], "seed '' in a variant; expected a whole number from 0"),
        (["--scenarios", "short", "--variants", "world=4294967296"], "from 0 to 4294967295"),
        (["--scenarios", "short", "--variants", "light=1+light=2"], "with light=1 and light=2; expected one of them"),
        (["--scenarios", "short", "--variants", "noise-2x+noise-half"], "with noise-2x and noise-half; expected one"),
        (["--scenarios", "short", "--variants", "reverse", "reverse"], "variant reverse twice; expected each once"),
        (["--scenarios", "short", "--variants", "light=1+world=2", "world=2+light=1"], "variant world=2+light=1 twice"),
        (["--scenarios", "short", "--variants", "rig=moon"], "moon"),
        (["--recordings", "nowhere", "--variants", "noise-2x"], "a recording has no variants"),
    ],
)
def test_nonsense_is_refused(
    arguments: Sequence[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert main(["benchmark", *arguments, "--out", str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_estimators_are_named_or_commands() -> None:
    assert all(estimator_named(name).label == name for name in ESTIMATORS)
    mine = estimator_named("mine=external:run --in={recording} --out '{output} x'")
    assert mine.label == "mine"
    assert mine.settings() == {"command": ["run", "--in={recording}", "--out", "{output} x"]}
    with pytest.raises(ConfigError, match=r"without .output.; expected a command"):
        estimator_named("external:run {recording}")
    with pytest.raises(ConfigError, match="No closing quotation"):
        estimator_named("external:run '{recording} {output}")


def test_programs_are_checked_before_anything_is_simulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine = tmp_path / "mine.sh"
    mine.write_text("#!/bin/sh\n", encoding="utf-8")
    for program, found in (("no-such-program", "no such program"), (f"{mine}", "not executable; expected")):
        words = [
            "benchmark",
            "--scenarios",
            "short",
            "--out",
            str(tmp_path / "out"),
            "--cache",
            str(tmp_path / "cache"),
        ]
        assert main([*words, "--estimators", f"mine=external:{program} {{recording}} {{output}}"]) == 2
        assert f"{program}: " in (message := capsys.readouterr().err) and found in message
    assert [path.name for path in tmp_path.iterdir()] == ["mine.sh"]
    mine.chmod(0o755)
    estimator_named(f"mine=external:{mine} {{recording}} {{output}}").require_program()


def test_missing_programs_are_reported(flown: Result) -> None:
    with pytest.raises(ConfigError, match="no-such-program: No such file"):
        estimator_named("external:no-such-program {recording} {output}").run(flown.folder)
    with pytest.raises((EvaluationError, InputError), match=r"estimate\.tum: no such file"):
        estimator_named("external:true {recording} {output}").run(flown.folder)


def test_the_hash_depends_on_what_is_recorded_not_on_its_name(flown: Result, tmp_path: Path) -> None:
    flights = scenario_flights(["short", "short-v0", "hover"], range(2))
    assert [(flight.scenario, flight.seed) for flight in flights] == [
        ("short-v0", 0),
        ("hover-v0", 0),
        ("short-v0", 1),
        ("hover-v0", 1),
    ]
    assert len({flight.recording_hash for flight in flights}) == 4
    (one,) = recorded_flights([flown.folder])
    assert recorded_flights([flown.folder / "mav0"]) == (one,)
    link = tmp_path / "elsewhere" / flown.folder.name
    link.parent.mkdir()
    link.symlink_to(flown.folder)
    with pytest.raises(ConfigError, match="both named"):
        recorded_flights([flown.folder, link])


def test_variants_are_other_recordings_with_names_of_their_own() -> None:
    names = ("as-is", "imu-100hz", "imu-400hz", "noise-2x", "noise-half", "rig=fisheye")
    flights = scenario_flights(["short"], range(1), variants=names)
    assert [flight.scenario for flight in flights] == ["short-v0", *(f"short-v0+{name}" for name in names[1:])]
    assert flights[0] == scenario_flights(["short"], range(1))[0]
    assert len({flight.recording_hash for flight in flights}) == len(names)
    shared = [None if flight.images_of is None else flight.images_of.scenario for flight in flights]
    assert shared == [None, *["short-v0"] * 4, None]  # the fisheye has other images
    sources = [flight.source for flight in flights]
    assert [each.rig.imu.rate_hz for each in sources[:3]] == [200.0, 100.0, 400.0]  # type: ignore[attr-defined]
    assert [each.faults.imu_noise_factor for each in sources[3:5]] == [2.0, 0.5]  # type: ignore[attr-defined]
    for name in ("rig=fisheye", "reverse+rig=fisheye"):
        with pytest.raises(ConfigError, match=rf"--rig euroc-stereo with the variant {re.escape(name)}"):
            scenario_flights(["short"], range(1), "euroc-stereo", [name])


def test_an_imu_rate_that_the_path_cannot_have_is_another_flight() -> None:
    """Of 500 Hz, 100 Hz is a divisor; 400 Hz is neither a divisor nor the double."""
    short = scenario_named("short")
    fast = replace(short, rig=replace(short.rig, imu=replace(short.rig.imu, rate_hz=500.0)))
    rates_hz = [variant_of(fast, name).control_rate_hz for name in ("imu-100hz", "imu-400hz")]
    assert rates_hz == [500.0, None]


def test_a_world_is_flown_again_under_other_light_and_in_reverse() -> None:
    """The names of rows state world, light and direction, whatever the order on the command line, and so does the key
    of the cached recording."""
    names = ("world=3", "world=4", "world=3+light=3", "light=3", "world=3+light=4+reverse", "reverse")
    flights = scenario_flights(["short"], (0, 1), variants=[*names[:4], "reverse+light=4+world=3", "reverse"])
    assert [flight.scenario for flight in flights] == [f"short-v0+{name}" for name in names] * 2
    assert len({flight.recording_hash for flight in flights}) == len(flights)
    sources: list[Any] = [flight.source for flight in flights]
    found = [(each.seed_of_world, each.light_seed, each.reverse) for each in sources[6:]]
    assert found == [(3, None, False), (4, None, False), (3, 3, False), (1, 3, False), (3, 4, True), (1, None, True)]
    assert [each.seed for each in sources] == [0] * 6 + [1] * 6


def test_the_rate_of_the_imu_is_that_of_the_other_rig() -> None:
    (flight,) = scenario_flights(["short"], range(1), variants=["imu-400hz+rig=fisheye"])
    source: Any = flight.source
    assert flight.scenario == "short-v0+rig=fisheye+imu-400hz"
    assert source.rig.imu == replace(rig_named("fisheye").imu, rate_hz=400.0)
    assert source.rig.cameras[0].model == rig_named("fisheye").cameras[0].model


def test_a_missing_recording_is_named_as_it_was_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InputError, match=r"^nowhere: no such file or folder"):
        recorded_flights([Path("nowhere")])
    (tmp_path / "empty" / "mav0").mkdir(parents=True)
    with pytest.raises(InputError, match=r"^empty\b"):
        recorded_flights([Path("empty/mav0")])


def test_without_ray_its_engine_says_what_to_install(
    flown: Result, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    for flights in (["--recordings", str(flown.folder)], ["--suite", "room", "--seeds", "100000"]):
        assert main(["benchmark", *flights, "--engine", "ray", "--out", str(tmp_path)]) == 2
        assert install_command("ray") in capsys.readouterr().err


def test_sources_are_read_once_for_all_flights(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario_flights(["short"], range(1))
    reads: list[Path] = []
    monkeypatch.setattr(jobs, "code_hash", lambda *paths: reads.extend(paths))
    assert len({flight.recording_hash for flight in scenario_flights(["room"], range(100))}) == 300
    assert reads == []


@pytest.mark.parametrize("name", ["room-aggressive", "hover"])
@pytest.mark.parametrize("seed", [0, 1])
def test_flights_of_the_documentation_can_be_repeated(name: str, seed: int) -> None:
    """They are planned to end at their first pose."""
    flight = scenario_named(name, seed)
    planned = reference_of(flight, QuadrotorPlant(flight.rig, flight.quadrotor))
    assert np.linalg.norm(planned.position_m[-1] - planned.position_m[0]) < 0.5 * MAX_DISCONTINUITY_M
    assert abs(np.sin(0.5 * (planned.yaw_rad[-1] - planned.yaw_rad[0]))) < 1e-6


def test_an_interrupted_benchmark_says_how_it_continues(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dronevio.eval.benchmark.runner.run_benchmark", interrupted)
    words = ("--scenarios", "short", "--seeds", "1", "--cache", str(tmp_path / "cache"))
    assert main(["benchmark", *words, "--out", str(tmp_path / "out")]) == 130
    assert f"finished runs are kept in {tmp_path / 'out'}; the same command" in capsys.readouterr().err
