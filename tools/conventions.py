"""The conventions of names, docstrings and tests that no linter checks; they are checked on the syntax tree.

Usage::

    tools/conventions.py estimator/backend eval/metrics

prints every violation in these folders and ends with status 1 if there is one. A folder ``tests``, or one within it, is
checked against the rules of tests, any other folder against the rules of packages. ``tests/test_conventions.py`` runs
the same rules over all tests and over the folders that are listed there.
"""

import ast
import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

LONGEST_TEST_NAME = 60
"""Largest number of characters of a test's name."""
FEWEST_WORDS = 3
"""Smallest number of words in the docstring of a field; a unit in brackets counts as a word."""

_UNCERTAINTY = "uncertainty, or by meaning: sigma_scale, covariance_inflation, not_ready_reason, miscalibrated"
_PUBLISHED = "redundancy (of a residual), or published, reported, known (of a value)"
_WARP = "affine warp (of a patch), distort (of a lens), curve (of a path)"
_OBSERVATION = "FramePacket (a frame with its IMU samples) or observations (of landmarks)"
REPLACED = {
    "absorb": "marginalize",
    "absorbed": "marginalized",
    "absorbs": "marginalizes",
    "believed": "gauge, prior or estimated",
    "believes": "gauge, prior or estimates",
    "bend": _WARP,
    "bends": _WARP,
    "bent": _WARP,
    "blamed": "reported as an error of",
    "crew": "worker pool",
    "doubt": _UNCERTAINTY,
    "doubted": _UNCERTAINTY,
    "doubtful": _UNCERTAINTY,
    "doubts": _UNCERTAINTY,
    "forget": "remove",
    "forgets": "removes",
    "forgotten": "removed",
    "gaze": "heading",
    "gazes": "headings",
    "intake": "measurement pipeline",
    "late_s": "time_offset_s (also td, timeshift_cam_imu)",
    "likeness": "ZNCC (zero-mean normalized cross-correlation)",
    "likenesses": "ZNCC (zero-mean normalized cross-correlation)",
    "onlooker": "chase camera",
    "sighting": _OBSERVATION,
    "sightings": _OBSERVATION,
    "stillness": "stationary, zero-velocity detection or zero-velocity update (ZUPT)",
    "surely": "with high confidence, or a number",
    "told": _PUBLISHED,
    "unbent": "undistorted",
    "unheard": "ignored",
    "whoever": "the user, the caller",
    "zoom": "scale",
    "zooms": "scales",
}
"""Words that this project does not use, each with the standard term. Only words without any correct technical use in
this project are listed, because they are refused in every name and docstring."""

_RANDOM = {"default_rng", "RandomState", "SeedSequence", "Generator", "PCG64", "Philox", "SFC64", "MT19937", "Random"}
_SIZE = r"(?:[A-Za-z0-9_]+(?: [A-Z])?|…)"  # also a product such as 4 N
_SHAPE = rf"\({_SIZE}(?:\s*[,×+−-]\s*{_SIZE})*,?\)"
_SHAPES = re.compile(rf"{_SHAPE}(?:(?:,| and| or)? {_SHAPE})*\s+")
_CODE = re.compile(r"``[^`]+``|`[^`]+`")
_WORD_PARTS = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True, order=True)
class Violation:
    """A place where the source differs from a convention."""

    line: int
    """Line of the file, from 1 on."""
    text: str
    """The violation and what is expected instead."""


def check_test(tree: ast.Module) -> list[Violation]:
    """Return the violations of the conventions of tests in a module."""
    return sorted([*long_test_names(tree), *shared_randomness(tree)])


def check_package(tree: ast.Module) -> list[Violation]:
    """Return the violations of the conventions of docstrings and words in a module."""
    return sorted([*incomplete_field_docstrings(tree), *replaced_words(tree)])


# --- tests


def long_test_names(tree: ast.Module) -> Iterator[Violation]:
    """Yield the test functions, those in classes included, whose names are too long."""
    for node in ast.walk(tree):
        if isinstance(node, Function) and node.name.startswith("test_") and len(node.name) > LONGEST_TEST_NAME:
            text = f"{node.name} has {len(node.name)} characters; rename it to {LONGEST_TEST_NAME} or fewer"
            yield Violation(node.lineno, text)


def shared_randomness(tree: ast.Module) -> Iterator[Violation]:
    """Yield calls of random generators whose outcome depends on the order of tests, or on chance.

    These are calls that run when the module is imported (in its body, in a class, a decorator or a default value), and
    generators without a seed anywhere.
    """
    for call in _random_calls_on_import(tree):
        text = (
            f"{ast.unparse(call.func)}(…) at module level; make the generator in a fixture or in the test, with a seed"
        )
        yield Violation(call.lineno, text)
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and _dotted(node.func)[-1:] == ["default_rng"]:
            seeds = [*node.args, *(keyword.value for keyword in node.keywords)]
            if not seeds or (isinstance(seeds[0], ast.Constant) and seeds[0].value is None):
                yield Violation(node.lineno, "default_rng() without a seed; give it one, so that a failure repeats")


def _random_calls_on_import(node: ast.AST) -> Iterator[ast.Call]:
    """Yield the outermost random calls below a node that run on import: all but those in bodies of functions."""
    if isinstance(node, ast.Call) and _is_random(node):
        yield node
        return
    children: list[ast.AST] = list(ast.iter_child_nodes(node))
    if isinstance(node, Function):
        children = [*node.decorator_list, node.args]
    elif isinstance(node, ast.Lambda):
        children = [node.args]
    for child in children:
        yield from _random_calls_on_import(child)


def _is_random(call: ast.Call) -> bool:
    """Return whether a call makes a random generator, or draws from a global one."""
    names = _dotted(call.func)
    return "random" in names or not _RANDOM.isdisjoint(names)


def _dotted(node: ast.expr) -> list[str]:
    """Return the names of ``a.b.c``, also of ``a.b(…).c``; of anything else as far as they are known."""
    if isinstance(node, ast.Attribute):
        return [*_dotted(node.value), node.attr]
    if isinstance(node, ast.Call):
        return _dotted(node.func)
    return [node.id] if isinstance(node, ast.Name) else []


# --- docstrings of fields


def incomplete_field_docstrings(tree: ast.Module) -> Iterator[Violation]:
    """Yield the docstrings under fields of classes that are no complete sentences."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            for field, docstring in _attribute_docstrings(node):
                for fault in sentence_faults(_text(docstring)):
                    yield Violation(docstring.lineno, f"docstring of {node.name}.{field} {fault}")


def sentence_faults(docstring: str) -> list[str]:
    """Return in which ways the docstring of a field is no complete sentence; none if it is one.

    After the shapes with which it may begin, ``(N, 3)`` for example, a docstring begins with a capital letter, a digit,
    a symbol such as ``σ`` or a code literal, ends with a full stop (behind the unit in brackets, where there is one),
    has three words, the unit counted, and has no ellipsis, which only a shape may have.
    """
    text = " ".join(docstring.split())
    sentence = _SHAPES.sub("", text, count=1) if _SHAPES.match(text) else text
    faults = []
    if not re.match(r"[A-Z0-9`\u00c0-\u00de]|[^\x00-\u024f]", sentence) or sentence.startswith("…"):
        faults.append(f"begins with {sentence[:20]!r}; expected a capital letter, a digit or a `code literal`")
    if not re.search(r"(?<!\.)\.\)?$", sentence):
        faults.append(f"ends with {sentence[-20:]!r}; expected a full stop, behind a unit in brackets")
    if sum(bool(re.search(r"\w", word)) for word in sentence.split()) < FEWEST_WORDS:
        faults.append(f"is {sentence!r}; expected {FEWEST_WORDS} words or more")
    if re.search(r"\.\.\.|…", re.sub(_SHAPE, "", _CODE.sub("", sentence))):
        faults.append(f"has an ellipsis in {sentence!r}; expected a sentence that makes sense read alone")
    return faults


def _attribute_docstrings(node: ast.ClassDef) -> Iterator[tuple[str, ast.Expr]]:
    """Yield the fields of a class that have a docstring, with it."""
    for before, after in zip(node.body, node.body[1:], strict=False):
        targets: list[ast.expr] = []
        if isinstance(before, ast.AnnAssign):
            targets = [before.target]
        elif isinstance(before, ast.Assign):
            targets = before.targets
        if targets and isinstance(targets[0], ast.Name) and _is_text(after):
            assert isinstance(after, ast.Expr)
            yield targets[0].id, after


def _is_text(node: ast.AST) -> bool:
    """Return whether a statement is a string and nothing else."""
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def _text(node: ast.Expr) -> str:
    """Return the string of which a statement consists."""
    assert isinstance(node.value, ast.Constant)
    return str(node.value.value)


# --- words


def replaced_words(tree: ast.Module) -> Iterator[Violation]:
    """Yield the replaced words in the names that a module defines and in its docstrings, whole words only."""
    for line, name in _defined_names(tree):
        yield from (Violation(line, f"name {name}: {found}") for found in replacements(name))
    for node in ast.walk(tree):
        if isinstance(node, ast.Expr) and _is_text(node):
            yield from (Violation(node.lineno, f"docstring: {found}") for found in replacements(_text(node)))


def replacements(text: str) -> list[str]:
    """Return a message with the replacement for each replaced word of a name or a text.

    Names are split at underscores and capitals, so that a word is found in camel case and snake case, but not within a
    longer word.
    """
    parts = "_".join(part.lower() for part in _WORD_PARTS.findall(text))
    found = {word for word in REPLACED if f"_{word}_" in f"_{parts}_"}
    return [f"the word {word!r} is not used here; say {REPLACED[word]}" for word in sorted(found)]


def _defined_names(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the names that a module gives, with their lines; not those of others that it uses."""
    for node in ast.walk(tree):
        if isinstance(node, Function | ast.ClassDef):
            yield node.lineno, node.name
        elif isinstance(node, ast.arg):
            yield node.lineno, node.arg
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.id
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.lineno, node.attr
        elif isinstance(node, ast.ExceptHandler | ast.MatchAs | ast.MatchStar) and node.name:
            yield node.lineno, node.name
        elif isinstance(node, ast.Import | ast.ImportFrom):
            yield from ((node.lineno, alias.asname) for alias in node.names if alias.asname)


# --- files


def violations_in_tests(folder: Path) -> list[str]:
    """Return the violations of the conventions of tests in the Python files below a folder, as ``path:line: text``.

    Raises:
        FileNotFoundError: There is no Python file below the folder.
    """
    return [f"{file}:{found.line}: {found.text}" for file in _files(folder) for found in check_test(_parsed(file))]


def violations_in_package(folder: Path) -> list[str]:
    """Return the violations of the conventions of packages in the Python files below a folder, as ``path:line: text``.

    Raises:
        FileNotFoundError: There is no Python file below the folder.
    """
    found = []
    for file in _files(folder):
        named = [Violation(1, f"file name {file.name}: {one}") for one in replacements(file.stem)]
        found += [f"{file}:{one.line}: {one.text}" for one in [*named, *check_package(_parsed(file))]]
    return found


def _files(folder: Path) -> list[Path]:
    """Return the Python files below a folder, or the file itself."""
    files = [folder] if folder.is_file() else sorted(folder.rglob("*.py"))
    if not files:
        raise FileNotFoundError(f"no Python file in {folder}; expected a folder of the repository")
    return files


def _parsed(file: Path) -> ast.Module:
    return ast.parse(file.read_text(encoding="utf-8"), str(file))


def main(folders: list[str]) -> int:
    """Print the violations in some folders, and return 1 if there are any."""
    found: list[str] = []
    for folder in map(Path, folders):
        found += violations_in_tests(folder) if "tests" in folder.parts else violations_in_package(folder)
    print("\n".join([*found, f"{len(found)} violations"]))
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
