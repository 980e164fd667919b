"""The table of mutants matches the code, and the command distinguishes killed, surviving and invalid mutants."""

import re
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]


@pytest.fixture(scope="module")
def mutants(script: Callable[[str], ModuleType]) -> ModuleType:
    return script("mutants")


def test_each_mutant_fits_its_file_exactly_once(mutants: ModuleType) -> None:
    faults = []
    for mutant in mutants.MUTANTS:
        path = CHECKOUT / mutant.file
        found = path.read_text(encoding="utf-8").count(mutant.original) if path.exists() else 0
        if found != 1 or mutant.mutated == mutant.original:
            faults.append(f"{mutant.name}: {found} occurrences in {mutant.file}; expected one, and a different text")
    assert not faults, "\n".join(faults)


def test_each_test_of_a_mutant_exists(mutants: ModuleType) -> None:
    missing = []
    for mutant in mutants.MUTANTS:
        assert mutant.tests, mutant.name
        for test in mutant.tests:
            file, _, function = test.partition("::")
            path, name = CHECKOUT / file, function.partition("[")[0]
            if not path.exists() or (name and f"\ndef {name}(" not in path.read_text(encoding="utf-8")):
                missing.append(f"{mutant.name}: {test} does not exist")
    assert not missing, "\n".join(missing)


def test_names_of_mutants_are_unique_and_plain(mutants: ModuleType) -> None:
    names = [mutant.name for mutant in mutants.MUTANTS]
    assert len(set(names)) == len(names)
    assert all(re.fullmatch(r"[a-z0-9]+(-[a-z0-9]+)*", name) for name in names)


def test_a_mutant_that_does_not_fit_is_refused(mutants: ModuleType, tmp_path: Path) -> None:
    (tmp_path / "code.py").write_text("a = 1\nb = 1\n")
    for original, mutated in (("1", "2"), ("c", "d"), ("a = 1", "a = 1")):
        with pytest.raises(ValueError, match="expected one"):
            mutants.Mutant("name", "", "code.py", original, mutated, ()).apply(tmp_path)
    mutants.Mutant("name", "", "code.py", "a = 1", "a = 2", ()).apply(tmp_path)
    assert (tmp_path / "code.py").read_text() == "a = 2\nb = 1\n"


@pytest.mark.parametrize(
    ("body", "verdict"), [("assert True", "survived"), ("assert False", "killed"), ("return (", "invalid")]
)
def test_verdicts_are_those_of_the_tests(mutants: ModuleType, tmp_path: Path, body: str, verdict: str) -> None:
    (tmp_path / "test_it.py").write_text(f"def test_it():\n    {body}\n")
    assert mutants.run_tests(tmp_path, ["test_it.py"]) == verdict


def test_the_working_tree_is_only_copied(mutants: ModuleType, tmp_path: Path) -> None:
    if not (CHECKOUT / ".git").exists():
        pytest.skip("the tests run outside of a checkout")
    mutants.copy_checkout(tmp_path)
    mutant = mutants.MUTANTS[0]
    before = (CHECKOUT / mutant.file).read_bytes()
    mutant.apply(tmp_path)
    assert (CHECKOUT / mutant.file).read_bytes() == before != (tmp_path / mutant.file).read_bytes()
    links = [path.relative_to(tmp_path) for path in tmp_path.rglob("*") if path.is_symlink()]
    assert all((CHECKOUT / link).is_symlink() for link in links)
