"""The folder of a benchmark: every finished run a small file, and all of them joined."""

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from dronevio.eval.benchmark.rows import RESULTS_FILE, Identity, Row, read_rows, write_rows
from dronevio.models.errors import InputError


class ResultStore:
    """Keeps rows so that nothing finished is ever lost: a file each, put in its place whole, in ``runs/``."""

    def __init__(self, folder: Path) -> None:
        """Open a folder, or make it.

        Raises:
            InputError: It cannot be made.
        """
        self.folder = folder
        self._runs = folder / "runs"
        try:
            self._runs.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(folder, f"it cannot be made ({error.strerror})", "a place where I may write") from None
        self._rows = self._read()

    @property
    def rows(self) -> tuple[Row, ...]:
        """All rows, sorted by scenario, seed and estimator."""
        return tuple(sorted(self._rows.values(), key=_order))

    def find(self, identity: Identity) -> Row | None:
        """Return the row of a run, None while there is none."""
        return self._rows.get(identity)

    def add(self, row: Row) -> None:
        """Keep the row of a run, in place of an earlier one."""
        write_rows(self._file(row.identity), [row])
        self._rows[row.identity] = row

    def join(self) -> Path:
        """Write all rows into one file and return its path."""
        path = self.folder / RESULTS_FILE
        write_rows(path, self.rows)
        return path

    def _read(self) -> dict[Identity, Row]:
        """Return the rows that are there; a damaged file is a run that has not been done."""
        found = {}
        for path in sorted(self._runs.glob("*.parquet")):
            try:
                rows: Iterable[Row] = read_rows(path)
            except InputError:
                rows = ()
            found.update({row.identity: row for row in rows})
        return found

    def _file(self, identity: Identity) -> Path:
        words = re.sub(r"[^A-Za-z0-9._-]+", "-", "-".join(str(part) for part in identity if part is not None))[:80]
        digest = hashlib.sha256(repr(identity).encode()).hexdigest()[:8]  # two names may read alike
        return self._runs / f"{words}-{digest}.parquet"


def _order(row: Row) -> tuple[str, int, str]:
    return row.scenario, -1 if row.seed is None else row.seed, row.estimator
