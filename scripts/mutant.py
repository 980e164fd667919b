"""A mutant: a known fault that is put into a copy of the code, so that tests can be seen to notice it."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Mutant:
    """A fault: a replacement of text in one file, and the tests that must notice it."""

    name: str
    """Short name, in lower case with hyphens."""
    description: str
    """What is wrong with the code once the fault is in, in one line."""
    file: str
    """File that is changed, relative to the checkout."""
    original: str
    """Text that is replaced. It occurs exactly once in the file."""
    mutated: str
    """Text that replaces it."""
    tests: tuple[str, ...]
    """Tests of which at least one must fail, as pytest takes them."""

    def apply(self, checkout: Path) -> None:
        """Change the file in a copy of the checkout.

        Raises:
            ValueError: The original text does not occur exactly once in the file, or the replacement changes nothing.
        """
        path = checkout / self.file
        text = path.read_text(encoding="utf-8")
        found = text.count(self.original)
        if found != 1 or self.original == self.mutated:
            raise ValueError(f"{self.name}: {found} occurrences in {self.file}; expected one, and a different text")
        path.write_text(text.replace(self.original, self.mutated), encoding="utf-8")
