"""Object instances: the objects to which surfaces belong, for instance segmentation."""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import wraps
from typing import ParamSpec, Protocol, Self, TypeVar


@dataclass(frozen=True, eq=False)
class Instance:
    """One object, such as a sofa, a tree or a wall; two objects of one kind are two instances."""

    kind: str
    """Kind of the object, such as ``sofa``."""


UNNAMED = Instance("something")
"""Instance of all surfaces without a name."""


class _Made(Protocol):
    """Interface of objects that consist of surfaces."""

    def as_instance(self, kind: str) -> Self:
        """Return the object with all its surfaces as one instance of a kind."""


_Arguments = ParamSpec("_Arguments")
_Piece = TypeVar("_Piece", bound=_Made)


def single_instance(make: Callable[_Arguments, _Piece]) -> Callable[_Arguments, _Piece]:
    """Decorate a function so that each object it returns is one instance, whose kind is the name of the function."""

    @wraps(make)
    def named(*args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Piece:
        return make(*args, **kwargs).as_instance(make.__name__.strip("_"))

    return named


def unique_names(instances: Iterable[Instance]) -> list[str]:
    """Return unique names in the same order: the kind if there is one of it, otherwise ``tree_1``, ``tree_2``."""
    listed = list(instances)
    total, seen = Counter(instance.kind for instance in listed), Counter[str]()
    names = []
    for instance in listed:
        kind = instance.kind
        seen[kind] += 1
        names.append(kind if total[kind] == 1 else f"{kind}_{seen[kind]}")
    return names


def kind_of(name: str) -> str:
    """Return the kind in a name of `unique_names`, or in that of a moving object: ``tree`` of ``tree_2``."""
    kind, _, number = name.rpartition("_")
    return kind if kind and number.isdecimal() else name
