"""Everything that can go wrong for a reason that the user can mend."""

from pathlib import Path


class DronevioError(Exception):
    """Root of the errors that the user can mend; the command line prints them in one line and exits with 2."""


class InputError(DronevioError):
    """A file or folder that is missing, unreadable or not what its format promises."""

    def __init__(self, path: Path | str, found: str, expected: str, line: int | None = None) -> None:
        """Say where, what was found and what was expected.

        Args:
            path: File or folder at fault.
            found: What is there.
            expected: What should be there.
            line: Line number, counted from 1, where it is a line's fault.
        """
        self.path = Path(path)
        self.line = line
        where = f"{path}:{line}" if line is not None else f"{path}"
        super().__init__(f"{where}: {found}; expected {expected}")


class ConfigError(DronevioError):
    """A setting, a name or a combination of them that makes no sense."""


class GraphicsError(DronevioError):
    """No off-screen OpenGL that renders a frame."""


class EvaluationError(DronevioError):
    """Two trajectories that cannot be compared, such as ones that share no time."""


class IncompleteError(DronevioError):
    """Long work that had to stop half-way, such as on a full disk; what was finished can be read."""
