"""Conventions that no linter knows: random generators of tests have seeds, docstrings of fields are sentences."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).resolve().parents[1]
FOLDERS = ("benchmarks", "dronevio", "estimator", "eval", "examples", "models", "sim", "tests", "tools")
RANDOM = {"random", "default_rng", "RandomState", "SeedSequence", "Generator", "PCG64", "Philox", "SFC64", "Random"}
SIZE = r"(?:[A-Za-z0-9_]+(?: [A-Z])?|…)"  # also a product such as 4 N
SHAPE = rf"\({SIZE}(?:\s*[,×+−-]\s*{SIZE})*,?\)"
SHAPES = re.compile(rf"{SHAPE}(?:(?:,| and| or)? {SHAPE})*\s+")


def random_calls(node: ast.AST, inside: bool = False) -> Iterator[int]:
    """Yield the lines of random generators without a seed, and of those that are made on import and thus shared.

    On import, all runs but the bodies of functions: `inside` is true within them.
    """
    if isinstance(node, ast.Call):
        function, seeds = ast.unparse(node.func), [*node.args, *(keyword.value for keyword in node.keywords)]
        unseeded = function.endswith("default_rng") and (not seeds or ast.unparse(seeds[0]) == "None")
        if unseeded if inside else not RANDOM.isdisjoint(re.findall(r"\w+", function)):
            yield node.lineno
            return
    is_function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
    for name, children in ast.iter_fields(node):
        for child in children if isinstance(children, list) else [children]:
            if isinstance(child, ast.AST):
                yield from random_calls(child, inside or (is_function and name == "body"))


def faulty_docstrings(tree: ast.Module) -> Iterator[tuple[int, str]]:
    """Yield the docstrings below fields of classes that are no sentences, with their lines."""
    for node in ast.walk(tree):
        for field, text in zip(node.body, node.body[1:], strict=False) if isinstance(node, ast.ClassDef) else ():
            if not (isinstance(field, ast.Assign | ast.AnnAssign) and isinstance(text, ast.Expr)):
                continue
            if isinstance(text.value, ast.Constant) and not is_sentence(docstring := str(text.value.value)):
                yield text.lineno, docstring


def is_sentence(docstring: str) -> bool:
    """Return whether a text begins with a capital, digit, symbol or code behind its shapes, and ends with a full stop.

    The full stop is behind the unit in brackets; an ellipsis is allowed in shapes and code only.
    """
    text = " ".join(docstring.split())
    sentence = text[match.end() :] if (match := SHAPES.match(text)) else text
    begins = re.match(r"[A-Z0-9`\u00c0-\u00de]|[^\x00-\u024f…]", sentence)
    ends = re.search(r"(?<!\.)\.\)?$", sentence)
    return bool(begins and ends) and not re.search(r"\.\.\.|…", re.sub(rf"`+[^`]+`+|{SHAPE}", "", sentence))


@pytest.mark.parametrize("folder", FOLDERS)
def test_the_repository_keeps_the_conventions(folder: str) -> None:
    if not (CHECKOUT / folder).exists():
        pytest.skip("the tests run outside of a checkout")
    faults = []
    for file in sorted((CHECKOUT / folder).rglob("*.py")):
        tree = ast.parse(file.read_text(encoding="utf-8"), str(file))
        faults += [f"{file}:{line}: {text!r} is no sentence" for line, text in faulty_docstrings(tree)]
        if folder == "tests":
            faults += [f"{file}:{line}: a generator without a seed, or made on import" for line in random_calls(tree)]
    assert not faults, "\n".join(faults)


def test_only_seeded_generators_within_functions_are_allowed() -> None:
    good = "def f(x=3): return default_rng(3)\ng = lambda n: [np.random.default_rng(seed=n) for _ in x]\nst.integers(3)"
    assert not list(random_calls(ast.parse(good)))
    shared = ("default_rng(3)", "np.random.default_rng(3).normal()", "np.random.seed(3)", "random.Random(3)")
    unseeded = ("default_rng()", "np.random.default_rng(None).normal()", "default_rng(seed=None)")
    on_import = ("class A:\n    x: int = f({})", "@given({})\ndef f(): 3", "def f(x={}): 3", "g = lambda x={}: x")
    within = ("def f():\n    with a: return {}", "g = lambda: {}")
    wrong = [text.format(call) for call in shared for text in on_import]
    wrong += [text.format(call) for call in unseeded for text in within]
    assert [len(list(random_calls(ast.parse(source)))) for source in wrong] == [1] * len(wrong)


def test_only_sentences_are_allowed_below_fields() -> None:
    good = ("Mean.", "(N, 3) Means [m].", "(M,), (M,) Rows.", "(N, …) `T_a_b` of it.", "σ [m].", "``x...`` (of it.)")
    bad = ("mean.", "(3,) rate.", "… and it.", "(or none) of it.", "Mean", "Mean [m]", "Mean. [m]", "All...", "1, … 9.")
    fields = [f"    a: int\n    {text!r}\n" for text in good + bad]
    found = faulty_docstrings(ast.parse("class A:\n    'mean'\n    def f(self): 'mean'\n" + "".join(fields)))
    assert [text for _, text in found] == list(bad)
