"""The folder of a benchmark: a small file for every finished run, and a table of all rows."""

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from dronevio.eval.benchmark.rows import RESULTS_FILE, Identity, Row, read_rows, write_rows
from dronevio.models.errors import InputError


class ResultStore:
    """Stores every row at once in a file of its own in ``runs/``, so that no finished run is lost."""

    def __init__(self, folder: Path) -> None:
        """Open a folder, which is made if it is missing.

        Raises:
            InputError: The folder cannot be made.
        """
        self.folder = folder
        self._runs = folder / "runs"
        try:
            self._runs.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(folder, f"it cannot be made ({error.strerror})", "a writable place") from None
        self._rows = self._read()

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows, sorted by scenario, seed and estimator."""
        return tuple(sorted(self._rows.values(), key=_order))

    def find(self, identity: Identity) -> Row | None:
        """Return the row of a run, or None if the run has not been done."""
        return self._rows.get(identity)

    def add(self, row: Row) -> None:
        """Store the row of a run, which replaces an earlier one of the same identity."""
        write_rows(self._file(row.identity), [row])
        self._rows[row.identity] = row

    def write_table(self) -> Path:
        """Write all rows to one file and return its path."""
        path = self.folder / RESULTS_FILE
        write_rows(path, self.rows)
        return path

    def _read(self) -> dict[Identity, Row]:
        """Return the stored rows; a damaged file counts as a run that has not been done."""
        stored = {}
        for path in sorted(self._runs.glob("*.parquet")):
            try:
                rows: Iterable[Row] = read_rows(path)
            except InputError:
                rows = ()
            stored.update({row.identity: row for row in rows})
        return stored

    def _file(self, identity: Identity) -> Path:
        """Return the path of a run's file; the hash distinguishes names that differ in replaced characters only."""
        words = re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(str(part) for part in identity if part is not None))[:80]
        digest = hashlib.sha256(repr(identity).encode()).hexdigest()[:8]
        return self._runs / f"{words}-{digest}.parquet"


def _order(row: Row) -> tuple[str, int, str]:
    return row.scenario, -1 if row.seed is None else row.seed, row.estimator
