"""The documentation site: its navigation is complete, its examples name what exists, its tables are well formed."""

import functools
import importlib
import re
import shlex
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gtsam
import pytest
import yaml

import dronevio
from dronevio.cli import main
from dronevio.cli.commands.dense import DenseCommand
from dronevio.cli.commands.estimate import EstimateCommand
from dronevio.cli.commands.run import RunCommand
from dronevio.cli.commands.sfm import SfmCommand
from dronevio.cli.settings.named_fields import named_fields, settings_of
from dronevio.cli.terminal import HELP_ALL
from dronevio.estimators.registry import ESTIMATORS
from dronevio.eval.benchmark.rows import read_rows, write_rows
from dronevio.sim.scenarios import SCENARIOS

CHECKOUT = Path(__file__).resolve().parents[2]
DOCS = CHECKOUT / "docs"
GENERATED = ("environments/", "lessons/", "reference/cli/", "reference/api/")
FOREIGN_OPTIONS = {"--correct_scale", "--dataset-type"}
"""Options of other programs that pages name."""
NAMED_FILE = re.compile(r"`((?:models|sim|estimator|eval|dronevio|tools|tests)/[\w./]*|benchmarks/\w+\.\w+)`")
"""Files of the repository in a text; the results of ``dronevio benchmark`` are in folders of ``benchmarks/``."""

pytestmark = pytest.mark.skipif(not DOCS.is_dir(), reason="not a checkout")


def pages() -> list[str]:
    """Return all pages that are written by hand, as the navigation names them."""
    return sorted(
        name
        for name in (path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))
        if not name.startswith(GENERATED)
    )


def navigation() -> list[str]:
    """Return every target that the navigation of the site names."""
    settings = yaml.safe_load((CHECKOUT / "mkdocs.yml").read_text(encoding="utf-8"))

    def targets(entry: Any) -> Iterator[str]:
        if isinstance(entry, str):
            yield entry
        else:
            for inner in entry if isinstance(entry, list) else entry.values():
                yield from targets(inner)

    return list(targets(settings["nav"]))


def test_navigation_names_every_page_once() -> None:
    assert sorted(navigation()) == sorted([*pages(), *GENERATED])


PAGES = pages() if DOCS.is_dir() else []


def test_links_to_generated_pages_are_those_of_the_home_page() -> None:
    """They exist on the site alone; the other pages are read in the repository, too."""
    generated = re.compile(rf"\]\((?:\.\./)?(?:{'|'.join(GENERATED)})")
    assert [page for page in PAGES if generated.search(text_of(page))] == ["index.md"]


def text_of(page: str) -> str:
    """Return the source of a page."""
    return (DOCS / page).read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    """Return the code blocks of a language in a page."""
    return re.findall(rf"^```{language}\n(.*?)^```$", text_of(page), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize("page", PAGES)
def test_python_names_in_pages_exist(page: str, exists: Callable[[str], bool]) -> None:
    assert [name for name in re.findall(r"`(dronevio(?:\.\w+)+)", text_of(page)) if not exists(name)] == []


@pytest.mark.parametrize("page", PAGES)
def test_files_that_pages_name_exist(page: str) -> None:
    named = NAMED_FILE.findall(text_of(page))
    assert [name for name in named if not (CHECKOUT / name).exists()] == []


@pytest.mark.parametrize("page", [page for page in PAGES if blocks(page, "python")])
def test_python_examples_run(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "benchmarks" / "room").mkdir(parents=True)
    write_rows(tmp_path / "benchmarks" / "room" / "results.parquet", [])
    villa = Path(gtsam.findExampleDataFile("Balbianello/BalbianelloMedium-1.jpg")).parent
    shutil.copytree(villa, tmp_path / "photographs")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    files = r"The file\s`([\w-]+\.\w+)`:\n\n```\w+\n(.*?)^```$"
    for name, code in re.findall(files, text_of(page), re.M | re.S):
        (tmp_path / name).write_text(code, encoding="utf-8")
    for code in blocks(page, "python"):
        compiled = compile(code, page, "exec")
        if "stable_baselines3" not in code:  # no dependency; tests/sim/test_rl_examples.py runs the training
            exec(compiled, {})


def test_the_example_on_an_estimate_runs(capsys: pytest.CaptureFixture[str]) -> None:
    """Without waiting for the estimator, the first step ends the episode, which takes no images."""
    [code] = blocks("rl.md", "py")
    assert "latency_s=0.05" in code
    exec(compile(code.replace("latency_s=0.05", "longest_wait_s=0.0"), "rl.md", "exec"), {})
    assert capsys.readouterr().out.startswith("False ")


def test_estimators_as_documented_take_part_in_a_benchmark(
    flown: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    [class_] = blocks("how-to/own-estimator.md", "python")
    script = next(code for code in blocks("how-to/own-estimator.md", "sh") if "awk" in code)
    assert len(class_.splitlines()) <= 20
    (tmp_path / "own_estimator.py").write_text(class_, encoding="utf-8")
    (tmp_path / "mine.sh").write_text(script, encoding="utf-8")
    (tmp_path / "mine.sh").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    estimators = ["class=python:own_estimator:AlwaysAtOrigin", "script=external:./mine.sh {recording} {output}"]
    assert main(["benchmark", "--recordings", str(flown.folder), "--estimators", *estimators, "--out", "rows"]) == 0
    rows = {row.estimator: row for row in read_rows(tmp_path / "rows")}
    assert [(row.status, row["coverage_percent"]) for row in rows.values()] == [("ok", 100.0)] * 2
    errors_m = [row["ate_m"] or 0.0 for row in rows.values()]
    assert errors_m[0] == pytest.approx(errors_m[1], rel=1e-3)
    assert errors_m[0] > 0.05


def test_benchmark_page_lists_all_estimators() -> None:
    named = set(re.findall(r"`([^`]+)`", "".join(re.findall(r"^\| (`.+?) \|", text_of("benchmark.md"), re.MULTILINE))))
    assert {*ESTIMATORS, "LABEL=python:package.module:Class", "LABEL=external:COMMAND"} <= named


@functools.cache
def helps() -> dict[str, str]:
    """Return the help text of every command, by its words."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(CHECKOUT / "tools")
        reference = importlib.import_module("cli_reference")
    return {" ".join(command.words): command.help for command in reference.commands()}


def command_lines() -> list[tuple[str, str]]:
    """Return every command of a shell block that is a call of dronevio, on one line, with its page."""
    return [
        (page, call[1])
        for page in PAGES
        for block in blocks(page, "sh")
        for line in block.replace("\\\n", " ").splitlines()
        if (call := re.match(r"(?:\w+=\S+ )*((?:\.venv/bin/)?dronevio .*)", line))
    ]


@pytest.mark.parametrize(("page", "line"), command_lines())
def test_command_lines_in_pages_are_valid(page: str, line: str) -> None:
    _, *words = shlex.split(line, comments=True)
    depth = 2 if f"{words[0]} {words[1] if words[1:] else ''}" in helps() else 1
    explained = helps()[" ".join(words[:depth])] + HELP_ALL
    assert [word for word in words[depth:] if word.startswith("--") and word not in explained] == [], page


def test_examples_of_help_texts_name_folders_that_commands_make() -> None:
    """A recording or run that is named by its scenario has the version and the seed in its name, as by default."""
    named = re.findall(r"(?<!--out )\b(?:recordings|runs)/([\w-]+)", "\n".join(helps().values()))
    scenarios = {name.partition("-")[0] for name in SCENARIOS}
    default = [name for name in named if name.partition("-")[0] in scenarios]
    assert len(default) > 10
    assert [name for name in default if not re.fullmatch(r"[a-z-]+-v\d+-\d+(-\d+)?", name)] == []


@pytest.mark.parametrize("page", PAGES)
def test_options_named_in_pages_exist(page: str) -> None:
    known = set(re.findall(r"(?<![\w-])--?[a-z][\w.-]*", "\n".join(helps().values()))) | FOREIGN_OPTIONS
    named = {name.rstrip(".") for name in re.findall(r"`(--[a-z][\w.-]*)", text_of(page))}
    assert {name for name in named if not any(option.startswith(name) for option in known)} == set()


def test_published_tables_are_those_of_the_published_rows(script: Callable[[str], Any]) -> None:
    """Every table that a page takes from a command is what the command prints."""
    tables = script("published_tables")
    pages = {page.name: page.read_text(encoding="utf-8") for page in tables.pages()}
    assert "estimator.md" in pages
    assert {name for name, text in pages.items() if tables.filled(text) != text} == set()


def test_published_covariances_are_consistent(script: Callable[[str], Any]) -> None:
    command = "report docs/measurements/campaign.parquet --format markdown --tables consistency"
    block = f'<!-- rows "all scenarios" of: dronevio {command} -->\n<!-- end of the table -->\n'
    table = script("published_tables").filled(block)
    rows = [line.split("|") for line in table.splitlines() if line.startswith("| all scenarios")]
    assert len(rows) == 8  # those of the variants, too
    for cells in rows:
        assert int(cells[3]) >= 30 and all(2.0 <= float(cell) <= 4.0 for cell in cells[4:7])


def test_tables_of_pages_are_filled_by_their_commands(script: Callable[[str], Any]) -> None:
    tables = script("published_tables")
    command = "report docs/measurements/campaign.parquet --format markdown --tables losses"
    text = f'Text.\n<!-- rows "{{rows}}" of: dronevio {command} -->\nold\n<!-- end of the table -->\nMore.\n'
    lines = tables.filled(text.format(rows="gates")).splitlines()
    assert (lines[0], lines[-1]) == ("Text.", "More.") and "old" not in lines
    table = [line for line in lines if line.startswith("|")]
    assert table[0].startswith("| scenario | seed |") and len(table) > 2
    assert all(line.startswith("| gates") for line in table[2:])
    with pytest.raises(ValueError, match="no row that begins with 'nowhere'"):
        tables.filled(text.format(rows="nowhere"))
    rows = "docs/measurements/campaign.parquet"
    block = tables.filled(f"<!-- table of: dronevio compare {rows} {rows} -->\n<!-- end of the table -->\n")
    assert "```text\n" in block and "the same in both: vio, vio-stereo" in block


def test_glossary_rows_have_all_columns_and_order() -> None:
    rows = [line for line in text_of("glossary.md").splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert cells[0] == ["term", "meaning", "in other programs"]
    terms = [row[0] for row in cells[2:]]
    assert len(terms) >= 50
    assert all(len(row) == 3 and row[0] and row[1].endswith(".") for row in cells[2:])
    assert terms == sorted(set(terms), key=str.lower)


def test_contributing_names_targets_of_make() -> None:
    contributing = (CHECKOUT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    targets = set(re.findall(r"^([a-z-]+):", (CHECKOUT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:^|`)make ([a-z-]+)", contributing, re.MULTILINE))
    assert {"setup", "test", "check", "docs", "docs-serve"} <= named <= targets
    named_files = NAMED_FILE.findall(contributing)
    assert named_files and all((CHECKOUT / name).exists() for name in named_files)


def test_citation_names_this_version() -> None:
    citation = yaml.safe_load((CHECKOUT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == dronevio.__version__
    assert citation["license"] == "Apache-2.0"
    assert {"message", "title", "authors"} <= set(citation)


def test_workflows_run_what_exists_on_every_python() -> None:
    workflows = {
        path.name: yaml.safe_load(path.read_text(encoding="utf-8"))
        for path in (CHECKOUT / ".github" / "workflows").glob("*.yml")
    }
    targets = set(re.findall(r"^([a-z-]+):", (CHECKOUT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    runs = [
        step["run"] for w in workflows.values() for job in w["jobs"].values() for step in job["steps"] if "run" in step
    ]
    named = {target for run in runs if run.startswith("make ") for target in run.split()[1:]}
    assert {"lint", "types", "test", "docs"} <= named <= targets
    assert all((CHECKOUT / run.split()[0]).exists() for run in runs if run.startswith("tools/"))
    matrix = workflows["checks.yml"]["jobs"]["tests"]["strategy"]["matrix"]
    assert matrix["python"] == ["3.11", "3.12", "3.13", "3.14"]
    assert {system.split("-")[0] for system in matrix["os"]} == {"ubuntu", "macos"}


def test_reference_has_a_page_for_every_command(script: Any, tmp_path: Path) -> None:
    from dronevio.cli import COMMANDS

    reference = script("cli_reference")
    reference.write(tmp_path)
    assert {f"{name}.md" for name in COMMANDS.subcommands} < {path.name for path in tmp_path.iterdir()}
    assert "`--seed INT`\n:   " in (tmp_path / "fly.md").read_text(encoding="utf-8")


def test_reference_explains_all_settings(script: Any) -> None:
    page = script("cli_reference").settings_page()
    settings = [name for command in (RunCommand, SfmCommand, DenseCommand) for name in settings_of(command)]
    assert [name for name in settings if page.count(f"`{name} = ") == 0] == []
    assert page.count("\n:   ") == len(settings)
    assert "`estimator.smoother.min-parallax-px = 5.0`\n:   Smallest median displacement" in page


@pytest.mark.parametrize("page", PAGES)
def test_settings_that_pages_change_exist(page: str) -> None:
    commands = (RunCommand, EstimateCommand, SfmCommand, DenseCommand)
    known = {name for command in commands for name in settings_of(command)}
    assert set(re.findall(r"--set ([a-z][\w.-]*)=", text_of(page))) <= known


def test_options_in_the_reference_are_those_of_the_help(script: Any) -> None:
    reference = script("cli_reference")
    command = next(c for c in reference.commands() if c.words == ("estimate",))
    listed = {word for group in reference.groups(command.help) for name, _ in group.options for word in name.split()}
    typed = set(re.findall(r"^│ (--[\w.-]+)", command.help, re.MULTILINE))
    named = {f"--{each.name}" for each in named_fields(EstimateCommand) if each.is_option and each.name != "recording"}
    assert len(typed) > 50 and {word.replace(".no-", ".") for word in typed} == named | {"--set", "--settings"}
    assert typed <= {word.rstrip(",") for word in listed}


def test_api_pages_exist_for_every_package(script: Any) -> None:
    packages = script("api_reference").packages()
    folders = {path.parent for path in (CHECKOUT / "dronevio").glob("*/**/__init__.py")}
    names = {".".join(folder.relative_to(CHECKOUT).parts) for folder in folders}
    public = {name for name in names if not name.startswith("dronevio.cli")}
    assert set(packages) == public | {"dronevio"}
