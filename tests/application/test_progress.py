"""Progress of commands: lines of text, bars, and nothing."""

import io
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from rich.progress import Progress as RichProgress

import dronevio
from dronevio.cli.progress import LineBars, RichBars
from dronevio.cli.terminal import progress_bars
from dronevio.models.progress import PhaseLine, notebook_line, silent


class Clock:
    """A clock that is set by hand."""

    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


def test_lines_are_printed_from_time_to_time() -> None:
    clock = Clock()
    line = PhaseLine("rendering", clock)
    printed = []
    for second in range(41):
        clock.now_s = 100.0 + second
        printed.append(line.due(10 * second, 400))
    texts = [text for text in printed if text is not None]
    assert texts == [
        "rendering: 50 of 400 after 5 s, about 35 s left",
        "rendering: 150 of 400 after 15 s, about 25 s left",
        "rendering: 250 of 400 after 25 s, about 15 s left",
        "rendering: 350 of 400 after 35 s, about 5 s left",
        "rendering: 400 of 400 after 40 s",
    ]


def test_slow_first_units_do_not_tell_how_long_the_rest_takes() -> None:
    """The first of a thousand frames takes 8 s, the others 10 ms each."""
    clock = Clock()
    line = PhaseLine("estimating", clock)
    assert line.due(0, 1000) is None
    clock.now_s += 8.0
    assert line.due(1, 1000) == "estimating: 1 of 1000 after 8 s"
    clock.now_s += 10.0
    assert line.due(501, 1000) == "estimating: 501 of 1000 after 18 s, about 10 s left"


def test_end_of_a_phase_is_printed_once() -> None:
    clock = Clock()
    line = PhaseLine("rendering", clock)
    assert line.due(0, 2) is None
    clock.now_s += 4.0
    assert line.due(1, 2) is None
    assert line.due(2, 2) == "rendering: 2 of 2 after 4 s"
    clock.now_s += 60.0
    assert line.due(2, 2) is None


def test_time_before_a_phase_does_not_count() -> None:
    clock, stream = Clock(), io.StringIO()
    advance = LineBars(stream, clock).bar("estimating")
    clock.now_s += 60.0
    advance(0, 10)
    clock.now_s += 6.0
    advance(3, 10)
    assert stream.getvalue() == "estimating: 3 of 10 after 6 s, about 14 s left\n"


def test_bar_of_a_phase_appears_when_it_begins() -> None:
    display = RichProgress(console=Console(file=io.StringIO()))
    bars = RichBars(display)
    first, second = bars.bar("simulating"), bars.bar("rendering")
    assert display.tasks == []
    first(1, 4)
    assert [(task.description, task.completed, task.total) for task in display.tasks] == [("simulating", 1, 4)]
    second(0, 7)
    first(4, 4)
    assert [(task.description, task.completed) for task in display.tasks] == [("simulating", 4), ("rendering", 0)]


def test_a_terminal_has_bars_and_a_pipe_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with progress_bars() as bars:
        assert isinstance(bars, LineBars)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True, raising=False)
    with progress_bars() as bars:
        assert isinstance(bars, RichBars)
    with progress_bars(quiet=True) as bars:
        bars.bar("simulating")(1, 1)
    assert "simulating" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")  # of the client that starts the kernel
def test_a_notebook_shows_one_line_that_vanishes_at_the_end(executed: Callable[..., Any]) -> None:
    setup = "import time; from dronevio.models.progress import notebook_line; line = notebook_line('estimating')"
    step = "line(%d, 40)\ntime.sleep(%g)"
    begun, ended, short = executed(
        "\n".join([setup, step % (0, 1.1), step % (10, 0.6), step % (20, 0.0)]),
        setup + "\n" + "\n".join(step % (i, 0.6) for i in range(0, 41, 10)),
        setup + "\n" + "\n".join(step % (i, 0.0) for i in range(41)),
    )
    [output] = begun
    assert output["output_type"] == "display_data"
    assert re.fullmatch(r"estimating: 20 of 40 after 2 s, about \d s left", output["data"]["text/plain"])
    assert [output["data"] for output in ended] == [{"text/plain": ""}]
    assert short == []


def test_scripts_are_silent(tmp_path: Path) -> None:
    assert notebook_line("estimating") is silent
    code = (
        "import IPython, sys; from IPython.core.interactiveshell import InteractiveShell; InteractiveShell.instance();"
        f"sys.path.insert(0, {str(Path(dronevio.__file__).parents[1])!r});"
        "from dronevio.models.progress import notebook_line, silent; print(notebook_line('estimating') is silent)"
    )
    pytest.importorskip("IPython")
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={"HOME": str(tmp_path)}
    )
    assert (ended.stdout, ended.stderr) == ("True\n", "")
