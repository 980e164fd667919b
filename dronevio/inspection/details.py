"""What the page of an inspection shows beside the findings."""

from dataclasses import dataclass

from dronevio.eval.run import EstimatorRun
from dronevio.inspection.inertial import AllanDeviation, Spectrum
from dronevio.inspection.measured import Measured


@dataclass(frozen=True, eq=False)
class Details:
    """Everything that the page shows beside the findings."""

    measured: Measured
    """The measurements in the images."""
    rest_ns: tuple[tuple[int, int], ...]
    """Beginning and end of each interval of rest [ns]."""
    spectrum: Spectrum | None
    """Spectrum of the IMU."""
    allan: AllanDeviation | None
    """Allan deviation of the longest rest."""
    run: EstimatorRun | None
    """Run of the odometry, if one was asked for."""
