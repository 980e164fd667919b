"""Events of one estimator in a recording: health, keyframes, loop closures and messages, with their positions."""

from collections.abc import Sequence

import numpy as np
import rerun as rr

from dronevio.eval.rerun.entities import EstimateEntities
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.run import is_warning
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.state import Estimate, Health

KEYFRAME = "keyframe"
"""Event of an estimate whose frame became a keyframe."""
_NORMAL_HEALTH = (Health.INITIALIZING, Health.TRACKING)


class EventLog:
    """Logs the events of one estimator."""

    def __init__(self, sink: Sink, entities: EstimateEntities) -> None:
        """Take the output of the rows, and the paths of the estimator's entities."""
        self._sink = sink
        self._entities = entities
        self._last_health: Health | None = None
        self._t_ns: list[Times] = []
        self._p: list[Array] = []

    def add_positions(self, t_ns: Times, p: Array) -> None:
        """Add the next positions (N, 3) in the displayed world frame [m] at times (N,) [ns]."""
        self._t_ns.append(t_ns)
        self._p.append(p)

    def log(self, estimates: Sequence[Estimate]) -> None:
        """Log events and changes of health of the next estimates, as text and as markers at the last position."""
        rows: list[tuple[int, str, str]] = []
        health: list[tuple[int, str]] = []
        keyframes: list[int] = []
        for estimate in estimates:
            keyframes += [estimate.t_ns] * (KEYFRAME in estimate.events)
            texts = [text for text in estimate.events if text != KEYFRAME]
            rows += [(estimate.t_ns, text, "WARN" if is_warning(text) else "INFO") for text in texts]
            if estimate.health != self._last_health:
                self._last_health = estimate.health
                level = "INFO" if self._last_health in _NORMAL_HEALTH else "WARN"
                rows.append((estimate.t_ns, f"health: {self._last_health}", level))
                health.append((estimate.t_ns, str(self._last_health)))
        t_ns = np.array([t for t, _, _ in rows], dtype=np.int64)
        texts = [text for _, text, _ in rows]
        log = rr.TextLog.columns(text=texts, level=[level for _, _, level in rows])
        self._sink.columns(self._entities.events, t_ns, log)
        changes = rr.StateChange.columns(state=[name for _, name in health])
        self._sink.columns(self._entities.health, np.array([t for t, _ in health], dtype=np.int64), changes)
        self._log_markers(self._entities.keyframes, np.array(keyframes, dtype=np.int64), None)
        self._log_markers(self._entities.event_markers, *_joined_by_time(t_ns, texts))
        self._log_loops(estimates)

    def _log_markers(self, entity: str, t_ns: Times, labels: Sequence[str] | None) -> None:
        """Log points, optionally with labels, at the positions at times (N,) [ns] from the first pose on."""
        known = [i for i, t in enumerate(t_ns) if self._p and t >= self._t_ns[0][0]]
        if known:
            texts = None if labels is None else [labels[i] for i in known]
            columns = rr.Points3D.columns(positions=self._positions_at(t_ns[known]), labels=texts)
            self._sink.columns(entity, t_ns[known], columns)

    def _log_loops(self, estimates: Sequence[Estimate]) -> None:
        """Log a line between the two positions of each loop, from the frame on at which it was closed."""
        loops = [(estimate.t_ns, *pair) for estimate in estimates for pair in estimate.closed_loops_ns]
        if loops and self._p:
            closed_ns, then_ns, now_ns = np.array(loops, dtype=np.int64).T
            columns = np.stack([self._positions_at(now_ns), self._positions_at(then_ns)], axis=1).astype(np.float32)
            distinct, counts = np.unique(closed_ns, return_counts=True)
            strips = rr.LineStrips3D.columns(strips=columns).partition(counts)
            self._sink.columns(self._entities.loops, distinct, strips)

    def _positions_at(self, t_ns: Times) -> Array:
        """Return the positions (N, 3) of the last poses up to times (N,) [ns]."""
        rows = np.searchsorted(np.concatenate(self._t_ns), t_ns, side="right") - 1
        return np.concatenate(self._p)[np.maximum(rows, 0)]


def _joined_by_time(t_ns: Times, texts: Sequence[str]) -> tuple[Times, list[str]]:
    """Return the distinct ones of ascending times (N,) [ns], and the texts of each joined by commas."""
    distinct, first = np.unique(t_ns, return_index=True)
    ends = [*first, len(texts)][1:]
    return distinct, [", ".join(texts[start:end]) for start, end in zip(first, ends, strict=True)]
