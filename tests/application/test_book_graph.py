"""The drawing of a factor graph."""

from pathlib import Path

import pytest
from matplotlib.axes import Axes

from dronevio.book.figures import save_figure
from dronevio.book.imu_plots import draw_factor_graph
from dronevio.estimator.book.imu import GraphFactor

FACTORS = (
    GraphFactor("PriorFactorPose3", ("x0",)),
    GraphFactor("ImuFactor", ("x0", "v0", "x1", "v1", "b0")),
    GraphFactor("ImuFactor", ("x1", "v1", "x2", "v2", "b0")),
)


def test_drawing_has_one_edge_for_each_key(monkeypatch: pytest.MonkeyPatch) -> None:
    """Edges are lines; factors and variables are markers."""
    edges: list[object] = []
    markers: list[object] = []
    plot = Axes.plot

    def counted(axes: Axes, *args: object, **kwargs: object) -> object:
        (markers if "markersize" in kwargs else edges).append(args)
        return plot(axes, *args, **kwargs)  # type: ignore[arg-type]

    monkeypatch.setattr(Axes, "plot", counted)
    draw_factor_graph(FACTORS)
    assert len(edges) == 11
    assert len(markers) == 3 + 7  # three factors; three poses, three velocities and the bias


def test_the_same_graph_gives_the_same_file(tmp_path: Path) -> None:
    for name in ("one.svg", "other.svg"):
        save_figure(draw_factor_graph(FACTORS), tmp_path / name)
    assert (tmp_path / "one.svg").read_bytes() == (tmp_path / "other.svg").read_bytes()
    assert "ImuFactor" in (tmp_path / "one.svg").read_text(encoding="utf-8")
