"""Completion in shells: scripts that offer commands, options and values."""

import shutil
import subprocess
from pathlib import Path

import pytest

from dronevio.cli import COMMANDS, main
from dronevio.cli.commands.completion import Completions, bash_script, completions, fish_script
from dronevio.sim.scenarios import SCENARIOS


@pytest.fixture(scope="module")
def found() -> list[Completions]:
    return list(completions(COMMANDS, ()))


@pytest.fixture(scope="module")
def script(found: list[Completions], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("completion") / "dronevio.bash"
    path.write_text(bash_script(found), encoding="utf-8")
    return path


def completed(script: Path, *words: str) -> list[str]:
    """Return what bash offers for the last word."""
    code = f'. {script}; COMP_WORDS=(dronevio "$@"); COMP_CWORD=$#; _dronevio; printf "%s\\n" "${{COMPREPLY[@]}}"'
    done = subprocess.run(["bash", "-c", code, "bash", *words], capture_output=True, text=True, check=True)
    return done.stdout.split()


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["e"], ["estimate", "evaluate", "explore"]),
        (["run", "--fly-on", ""], ["truth", "estimate"]),
        (["run", "--fly-on", "e"], ["estimate"]),
        (["run", "--slam", "--fl"], ["--fly-on"]),
        (["run", "hover-m"], ["hover-minute-v0"]),
        (["fly", "--world", "war"], ["warehouse"]),
        (["speed", "s"], ["sim"]),
        (["book", "imu", "--s"], ["--seed"]),
        (["estimate", "recordings/ro"], []),  # the shell completes file names
        (["estimate", "room", "--out", ""], []),
        (["no-such-command", "-"], []),
    ],
)
def test_bash_offers_what_can_follow(script: Path, words: list[str], expected: list[str]) -> None:
    assert completed(script, *words) == expected


def test_every_command_and_scenario_is_offered(script: Path) -> None:
    assert completed(script, "") == list(COMMANDS.subcommands)
    assert completed(script, "fly", "") == list(SCENARIOS)


def test_every_command_has_options(found: list[Completions]) -> None:
    groups = [each.words for each in found if not each.options]
    assert groups == [(), ("policy",), ("book",), ("speed",)]
    assert all("--help" in each.options for each in found if each.options)


def test_fish_completes_summaries_and_values(found: list[Completions]) -> None:
    lines = fish_script(found).splitlines()
    assert 'complete -c dronevio -n "__fish_use_subcommand" -a view -d "open the rerun file of a run"' in lines
    assert 'complete -c dronevio -n "__fish_seen_subcommand_from run" -l fly-on -x -a "truth estimate"' in lines
    assert fish_script([Completions(("x",), {"y": 'a "b" $c'}, {})]).endswith('-a y -d "a \\"b\\" \\$c"\n')


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_scripts_are_valid(shell: str, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert main(["completion", shell]) == 0
    script = tmp_path / "script"
    script.write_text(capsys.readouterr().out, encoding="utf-8")
    if (program := shutil.which(shell)) is None:
        pytest.skip(f"no {shell}")
    subprocess.run([program, "-n", str(script)], check=True)
