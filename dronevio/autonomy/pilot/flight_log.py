"""What a pilot decided, what was flown, and what it cost, for people."""

import time
from dataclasses import dataclass, field

from dronevio.estimator.mapping.depth_source import DepthSource
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.state import CameraFrame, Estimate, Trajectory
from dronevio.sim.closed_loop.frame_source import FrameSource


@dataclass(frozen=True)
class Decision:
    """A decision of the pilot."""

    t_ns: int
    """Time on the clock of the course [ns]."""
    what: str
    """What was decided, and why."""
    position_m: tuple[float, float, float]
    """Where the vehicle was to be in the world [m]."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory that was flown for a while, and the route that it follows."""

    t_ns: int
    """Time from which it was flown, on the clock of the course [ns]."""
    positions_m: Array
    """(N, 3) Positions in the world at equal intervals of a tenth of a second or less, to its end at rest [m]."""
    route_m: Array
    """(M, 3) Route to the goal in the world as it was then placed [m]."""


@dataclass
class StageTimes:
    """Processor times of the stages [ms], beside which the latencies of the settings are declared."""

    depth: list[float] = field(default_factory=list)
    """Of each depth image."""
    map: list[float] = field(default_factory=list)
    """Of each entry in the map."""
    plan: list[float] = field(default_factory=list)
    """Of each plan."""
    rendering: list[float] = field(default_factory=list)
    """Of the images of each frame."""
    listeners: list[float] = field(default_factory=list)
    """Of the listeners with each depth image."""


class TimedDepth:
    """A source of depth images with the processor time of each; implements `DepthSource`."""

    def __init__(self, source: DepthSource, times_ms: list[float]) -> None:
        """Wrap a source, whose times are appended to a list [ms]."""
        self._source, self._times_ms = source, times_ms

    def depth(self, frame: CameraFrame, estimate: Estimate) -> DepthImage | None:
        """Return the depth image that is known with a frame; None if there is none."""
        began = time.process_time()
        depth = self._source.depth(frame, estimate)
        self._times_ms.append(1e3 * (time.process_time() - began))
        return depth


class TimedFrames:
    """A renderer of frames with the processor time of each; implements `FrameSource`."""

    def __init__(self, source: FrameSource, times_ms: list[float]) -> None:
        """Wrap a renderer, whose times are appended to a list [ms]."""
        self._source, self._times_ms = source, times_ms

    def ready_ns(self, exposed_ns: int) -> int:
        """Return the time from which a frame can be rendered [ns]."""
        return self._source.ready_ns(exposed_ns)

    def frame(self, t_ns: int, exposed_ns: int, lit: bool, truth: Trajectory) -> CameraFrame:
        """Return a frame."""
        began = time.process_time()
        frame = self._source.frame(t_ns, exposed_ns, lit, truth)
        self._times_ms.append(1e3 * (time.process_time() - began))
        return frame
