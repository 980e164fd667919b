"""Conventions of the repository that no linter knows: those of tests, and of names and docstrings in the packages."""

import ast
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]

CLEAN: tuple[str, ...] = ("dronevio", "estimator", "eval", "examples", "models", "sim", "benchmarks", "tools", "tests")
"""Folders and files, relative to the checkout, whose names and docstrings keep the conventions. A folder is added once
``tools/conventions.py FOLDER`` reports no violation in it."""


@pytest.fixture(scope="module")
def conventions(script: Callable[[str], Any]) -> Any:
    """The checker."""
    return script("conventions")


def parsed(*lines: str) -> ast.Module:
    return ast.parse("\n".join(lines))


# --- the repository


def test_tests_keep_the_conventions(conventions: Any) -> None:
    found = conventions.violations_in_tests(CHECKOUT / "tests")
    assert not found, "\n".join(found)


def test_clean_folders_keep_the_conventions(conventions: Any) -> None:
    found = [text for folder in CLEAN for text in conventions.violations_in_package(CHECKOUT / folder)]
    assert not found, "\n".join(found)


# --- the checker: names of tests


def test_long_test_names_are_found(conventions: Any) -> None:
    at_the_limit, beyond = f"test_{55 * 'a'}", f"test_{56 * 'a'}"
    assert not conventions.check_test(parsed(f"def {at_the_limit}(): pass", f"def helper_{beyond}(): pass"))
    (found,) = conventions.check_test(parsed("class TestAll:", "    pass", f"    async def {beyond}(self): pass"))
    assert (found.line, found.text) == (3, f"{beyond} has 61 characters; rename it to 60 or fewer")


# --- the checker: random generators


@pytest.mark.parametrize(
    "statement",
    [
        "RNG = np.random.default_rng(3)",
        "RNG: np.random.Generator = default_rng(3)",
        "IMAGE = np.random.default_rng(3).integers(0, 256, 10)",
        "VALUES = [np.random.normal() for _ in range(3)]",
        "np.random.seed(3)",
        "value = random.random()",
        "RNG = random.Random(3)",
        "RNG = numpy.random.RandomState(3)",
        "class A:\n    rng = np.random.default_rng(3)",
        "def f(rng=np.random.default_rng(3)): pass",
        "f = lambda rng=np.random.default_rng(3): rng",
        "@parametrize('x', np.random.default_rng(3).normal(size=3))\ndef f(x): pass",
        "class A:\n    def f(self, rng=np.random.default_rng(3)): pass",
        "if True:\n    with x as y:\n        y = np.random.default_rng(3)",
        "def f():\n    return np.random.default_rng()",
        "def f():\n    return np.random.default_rng(None)",
        "def f():\n    return default_rng(seed=None)",
    ],
)
def test_shared_or_unseeded_randomness_is_found(conventions: Any, statement: str) -> None:
    assert len(conventions.check_test(ast.parse(statement))) == 1


@pytest.mark.parametrize(
    "statement",
    [
        "def f():\n    return np.random.default_rng(3)",
        "@pytest.fixture\ndef rng():\n    return np.random.default_rng([3, 4])",
        "class A:\n    async def f(self, n: int = 3):\n        return np.random.default_rng(n)",
        "f = lambda: np.random.default_rng(3)",
        "from numpy.random import default_rng",
        "seeds = st.integers(0, 2**32 - 1)",
        "Maker = Callable[[int], np.random.Generator]",
    ],
)
def test_seeded_local_generators_are_allowed(conventions: Any, statement: str) -> None:
    assert not conventions.check_test(ast.parse(statement))


# --- the checker: docstrings of fields


@pytest.mark.parametrize(
    "docstring",
    [
        "Mean of the errors.",
        "(3,) Angular rate [rad/s].",
        "Angular rate [rad/s].",
        "(N, 3) Positions of the IMU [m].",
        "(…, 3, 3) Rotations that map b into a.",
        "(M,), (M,) First and second rows.",
        "(N + 1,) Time stamps of edges [ns].",
        "(4 N, 3) Corners of squares [m].",
        "`T_a_b` maps b into a.",
        "``ok`` if the run ended well.",
        "(4, 4) `T_imu_cam` of the left camera.",
        "3 expected for a consistent estimator.",
        "σ of the position [m].",
        "Standard deviation of the noise [m/s²/√Hz]; None if there is none.",
        "How far the images reach\n    on either side [px].",
        "Mean over the runs (see `anees`.)",
        "Écart of the two [m].",
        "Arrays of shape (…, 3) and (N, 3).",
        "Shown as `[0, ...]` in the log.",
    ],
)
def test_whole_sentences_are_accepted(conventions: Any, docstring: str) -> None:
    assert conventions.sentence_faults(docstring) == []


@pytest.mark.parametrize(
    ("docstring", "fault"),
    [
        ("mean of the errors.", "begins with 'mean of the errors.'"),
        ("(3,) angular rate of it [rad/s].", "begins with 'angular rate of it ['"),
        ("écart of the two [m].", "begins with"),
        ("... and how many of them.", "begins with '... and how many of '"),
        ("… and how many of them.", "begins with"),
        (", if there is one.", "begins with ', if there is one.'"),
        ("(or none) of these poses.", "begins with '(or none)"),
        ("Mean of the errors", "ends with 'Mean of the errors'"),
        ("Mean of the errors [m]", "ends with 'an of the errors [m]'"),
        ("Mean of the errors. [m]", "ends with"),
        ("Mean of all errors...", "ends with"),
        ("Is it well?", "ends with"),
        ("Mean [m].", "is 'Mean [m].'; expected 3 words"),
        ("(N, 3) The mean.", "is 'The mean.'; expected 3 words"),
        ("Mean – error.", "is 'Mean – error.'; expected 3 words"),
        ("", "expected 3 words"),
        ("Rows 1, 2, … of the table.", "has an ellipsis"),
        ("Rows ... of the table.", "has an ellipsis"),
    ],
)
def test_incomplete_sentences_are_found(conventions: Any, docstring: str, fault: str) -> None:
    assert any(text.startswith(fault) or fault in text for text in conventions.sentence_faults(docstring))


def test_docstrings_of_all_fields_are_looked_at(conventions: Any) -> None:
    tree = parsed(
        "class A:",
        "    'mean'",
        "    a: int = 3",
        "    'not a sentence'",
        "    b = 4",
        "    '''This is a whole sentence.'''",
        "    def f(self):",
        "        'not looked at'",
        "        class B:",
        "            c: int",
        "            'Nested, and too short'",
        "    d: int",
    )
    found = [(one.line, one.text.split(" begins")[0].split(" ends")[0]) for one in conventions.check_package(tree)]
    assert found == [(4, "docstring of A.a")] * 2 + [(11, "docstring of B.c")]


# --- the checker: words


@pytest.mark.parametrize(
    "name",
    ["doubt", "_doubt", "the_doubt_of_it", "pixelDoubt", "DoubtOf", "DOUBT_PX", "late_s", "camera_late_s", "HTTPZoom"],
)
def test_replaced_words_in_names_are_found(conventions: Any, name: str) -> None:
    assert len(conventions.replacements(name)) == 1


@pytest.mark.parametrize("name", ["undoubted", "redoubt", "zoological", "untold", "late", "late_start", "stipend", "s"])
def test_words_within_words_are_allowed(conventions: Any, name: str) -> None:
    assert conventions.replacements(name) == []


def test_the_message_says_what_to_use_instead(conventions: Any) -> None:
    (found,) = conventions.check_package(parsed("", "def likeness(): pass"))
    assert found.line == 2
    assert found.text.startswith("name likeness: the word 'likeness' is not used here; say ZNCC")


@pytest.mark.parametrize(
    "source",
    [
        '"""A gaze."""',
        'def f():\n    """A gaze."""',
        'class A:\n    """A gaze."""',
        'class A:\n    a: int\n    """The gaze of the camera."""',
        'A = 3\n"""The gaze of the camera."""',
        "gaze = 3",
        "for gaze in a: pass",
        "a = [gaze for gaze in a]",
        "with a as gaze: pass",
        "if (gaze := 3): pass",
        "a.gaze = 3",
        "def gaze(): pass",
        "async def gaze(): pass",
        "class Gaze: pass",
        "def f(gaze): pass",
        "def f(*, gaze): pass",
        "f = lambda gaze: 3",
        "class A:\n    gaze: int",
        "import a as gaze",
        "from a import b as gaze",
        "try:\n    pass\nexcept A as gaze:\n    pass",
        "match a:\n    case gaze:\n        pass",
    ],
)
def test_replaced_words_are_found_everywhere(conventions: Any, source: str) -> None:
    assert len(conventions.check_package(ast.parse(source))) == 1


@pytest.mark.parametrize("source", ["axes.zoom(3)", "f(zoom=3)", "a = b.zoom", "from a import zoom", "f('zoom')"])
def test_names_of_other_libraries_are_allowed(conventions: Any, source: str) -> None:
    assert conventions.check_package(ast.parse(source)) == []


def test_replaced_words_do_not_stand_in_their_own_advice(conventions: Any) -> None:
    assert [word for word, advice in conventions.REPLACED.items() if conventions.replacements(advice)] == []


# --- the checker: files


def test_violations_name_their_place(conventions: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "package").mkdir()
    file = tmp_path / "package" / "gaze.py"
    file.write_text("\nzoom = 3\n", encoding="utf-8")
    first, second = conventions.violations_in_package(tmp_path / "package")
    assert first.startswith(f"{file}:1: file name gaze.py: ")
    assert second.startswith(f"{file}:2: name zoom: ")
    assert conventions.violations_in_tests(tmp_path / "package") == []
    assert conventions.main([str(tmp_path / "package")]) == 1
    assert capsys.readouterr().out.endswith("\n2 violations\n")
    file.rename(tmp_path / "package" / "heading.py").write_text("scale = 3\n", encoding="utf-8")
    assert conventions.main([str(tmp_path / "package")]) == 0
    with pytest.raises(FileNotFoundError, match="no Python file"):
        conventions.violations_in_package(tmp_path / "nowhere")
