"""Measurements in the images of a recording, and their relation to the IMU."""

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from dronevio.estimator.imu.outliers import outlying_samples
from dronevio.inspection.appearance import Appearance, appearance_of
from dronevio.inspection.flow import Flow, flow_between, rotation_of
from dronevio.inspection.lens import LensCheck, changed_flow, check_lens
from dronevio.inspection.offsets import OffsetCourse, offset_course
from dronevio.inspection.relation import Gyroscope, Relation, Rotations, played_backwards, relate
from dronevio.inspection.sampling import sampled_runs
from dronevio.inspection.stereo import StereoCheck, check_stereo
from dronevio.models.arrays import Array, Image
from dronevio.models.defects import Defect
from dronevio.models.imu import ImuSamples
from dronevio.models.progress import Progress, silent
from dronevio.models.protocols import Recording
from dronevio.models.rotation import log_so3
from dronevio.models.state import CameraFrame

PAIR_S = 0.04
"""Shortest time between the two images of a pair [s]; over shorter ones, a drone hardly rotates."""
APPEARANCE_EVERY = 4
"""Every fourth frame is enough for brightness and blur, which change slowly."""
STEREO_EVERY = 10
"""Every tenth frame is enough for the relative pose of two cameras, which is constant."""
SHOWN = 3
"""Number of frames of which the page shows the images."""
BELONGS = 0.9
"""Share of the rotation of the images that their gyroscope explains. Recordings have 0.99 and more; the gyroscope of
another flight reaches 0.2."""


@dataclass(frozen=True, eq=False)
class ImageSample:
    """Measurements in the sampled frames."""

    frames: int
    """Number of sampled frames."""
    t_ns: tuple[tuple[int, ...], ...]
    """Time stamps of `appearance` of each camera [ns]."""
    appearance: tuple[tuple[Appearance, ...], ...]
    """Properties of images of each camera."""
    flows: tuple[Flow, ...]
    """Matches between successive images of the first camera."""
    stereo: tuple[tuple[Flow, ...], ...]
    """Matches between images of the first and of each further camera at the same time."""
    repeated: tuple[tuple[int, ...], ...]
    """Time stamps of images of each camera that equal the one before and are not blank [ns]."""
    compared: int
    """Number of frames that were compared with the one before."""
    shown: tuple[CameraFrame, ...]
    """Some frames for the page."""
    defects: tuple[Defect, ...]
    """Images that cannot be read."""


@dataclass(frozen=True, eq=False)
class Measured:
    """A recording with what was measured in it."""

    recording: Recording
    """The recording."""
    sound_imu: ImuSamples
    """Its IMU samples without outliers."""
    sample: ImageSample
    """Measurements in the sampled frames."""
    gyroscope: Gyroscope | None
    """The gyroscope; None for fewer than two samples."""
    rotations: Rotations
    """Rotations of the first camera between its images, where they are determined."""
    relation: Relation | None
    """Relation of these rotations to the gyroscope; None if there are too few."""
    backwards: float
    """Share of the variance that the gyroscope explains if the images are played backwards; 0 if not tried."""
    course: OffsetCourse | None
    """The offset over the recording; None if it is not determined."""
    lens: LensCheck | None
    """Change of the first lens that agrees best with the motion; None if it is not determined."""
    stereo: tuple[StereoCheck | None, ...] = field(default=())
    """Relative pose of the first and each further camera; None where they have no view in common."""

    @property
    def belongs(self) -> bool:
        """Whether the gyroscope explains the rotation of the images."""
        return self.relation is not None and self.relation.agreement > BELONGS


def measure(recording: Recording, progress: Progress = silent) -> Measured:
    """Return the measurements in the images of a recording, and their relation to the IMU.

    Args:
        recording: The recording.
        progress: Called with the number of frames that were sampled.
    """
    sample = _sampled(recording, progress)
    imu, outlying = recording.imu, outlying_samples(recording.imu, recording.rig.imu)
    sound = ImuSamples(imu.t_ns[~outlying], imu.gyro_rad_s[~outlying], imu.accel_m_s2[~outlying], imu.sampling)
    gyroscope = Gyroscope(sound) if len(sound) > 1 else None
    rotations, relation, backwards, course, lens = _rotations(sample.flows), None, 0.0, None, None
    if gyroscope is not None and len(rotations):
        relation = relate(rotations, gyroscope)
    if gyroscope is not None and relation is not None:
        if relation.agreement <= BELONGS:
            reverse = relate(played_backwards(rotations), gyroscope)
            backwards = 0.0 if reverse is None else reverse.agreement
        pixel_rad = 1.0 / recording.rig.cameras[0].model.fx
        course = offset_course(rotations, gyroscope, relation)
        lens = _lens(sample.flows, rotations, recording, gyroscope, relation, course, pixel_rad)
        if lens is not None and relation.agreement <= BELONGS and lens.cost_ratio > 1.0:
            corrected = _rotations([changed_flow(flow, lens) for flow in sample.flows])
            again = relate(corrected, gyroscope)
            if again is not None and again.agreement > BELONGS:  # the lens alone is to blame
                rotations, relation = corrected, again
                course = offset_course(rotations, gyroscope, relation)
            else:
                lens = None
    checks = tuple(
        check_stereo(flows, recording.rig.cameras[0], camera)
        for flows, camera in zip(sample.stereo, recording.rig.cameras[1:], strict=True)
    )
    return Measured(recording, sound, sample, gyroscope, rotations, relation, backwards, course, lens, checks)


def _lens(
    flows: Sequence[Flow],
    rotations: Rotations,
    recording: Recording,
    gyroscope: Gyroscope,
    relation: Relation,
    course: OffsetCourse | None,
    pixel_rad: float,
) -> LensCheck | None:
    """Return the change of the lens that agrees best, by rotations with the relation or else by the calibration."""
    start = np.array([flow.t_ns[0] for flow in flows], dtype=np.int64)
    end = np.array([flow.t_ns[1] for flow in flows], dtype=np.int64)
    pairs = Rotations(start, end, np.full((len(flows), 3), np.nan))
    duration_s = np.array([flow.duration_s for flow in flows])[:, None]
    if relation.agreement > BELONGS and 0.67 < relation.scale < 1.5:
        # The rotation and the bias are those of the relation, its scale is what the lens is asked for.
        rates = (gyroscope.rates(pairs, relation.offset_s) - relation.bias_rad_s) @ relation.Q.T
    elif relation.agreement > BELONGS or (course is not None and course.step_is_significant):
        return None
    else:
        Q, offset_s = recording.rig.cameras[0].T_imu_cam[:3, :3].T, calibrated_offset_s(recording)
        bias = np.nanmedian(gyroscope.rates(rotations, offset_s) - rotations.rate_rad_s @ Q, axis=0)
        rates = (gyroscope.rates(pairs, offset_s) - bias) @ Q.T
    return check_lens(flows, rates * duration_s, pixel_rad)


def _rotations(flows: Sequence[Flow]) -> Rotations:
    """Return the rotations between the images of flows where they are determined."""
    rates = np.array([rotation_of(flow) / flow.duration_s for flow in flows]).reshape(-1, 3)
    start = np.array([flow.t_ns[0] for flow in flows], dtype=np.int64)
    end = np.array([flow.t_ns[1] for flow in flows], dtype=np.int64)
    return Rotations(start, end, rates)[np.isfinite(rates).all(axis=1)]


def _sampled(recording: Recording, progress: Progress) -> ImageSample:
    """Return the measurements in the sampled frames of a recording."""
    cameras = recording.rig.cameras
    runs = sampled_runs(recording.frame_times_ns) if cameras else []
    total, done = sum(map(len, runs)), 0
    candidates = [index for run in runs for index in run[::STEREO_EVERY].tolist()]
    shares = (np.arange(SHOWN) + 0.5) / SHOWN
    chosen = {candidates[int(share * len(candidates))] for share in shares} if candidates else set()
    flows: list[Flow] = []
    shown: list[CameraFrame] = []
    defects: list[Defect] = []
    t_ns: list[list[int]] = [[] for _ in cameras]
    appearance: list[list[Appearance]] = [[] for _ in cameras]
    stereo: list[list[Flow]] = [[] for _ in cameras[1:]]
    repeated: list[list[int]] = [[] for _ in cameras]
    compared = 0
    for run in runs:
        last: CameraFrame | None = None
        earlier: deque[tuple[int, Image]] = deque()
        for position, index in enumerate(run.tolist()):
            frame = recording.frame(index)
            defects += frame.defects
            if index in chosen:
                shown.append(frame)
            for camera, image in enumerate(frame.images):
                if image.size and position % APPEARANCE_EVERY == 0:
                    t_ns[camera].append(frame.t_ns)
                    appearance[camera].append(appearance_of(image))
                if last is not None and _equals(image, last.images[camera]):
                    repeated[camera].append(frame.t_ns)
            compared += last is not None
            if position % STEREO_EVERY == 0:
                for k, flow in _across(frame, recording):
                    stereo[k].append(flow)
            flows += _along(frame, earlier, recording)
            last, done = frame, done + 1
            progress(done, total)
    return ImageSample(
        total,
        tuple(map(tuple, t_ns)),
        tuple(map(tuple, appearance)),
        tuple(flows),
        tuple(map(tuple, stereo)),
        tuple(map(tuple, repeated)),
        compared,
        tuple(shown),
        tuple(defects),
    )


def _along(frame: CameraFrame, earlier: "deque[tuple[int, Image]]", recording: Recording) -> Iterator[Flow]:
    """Yield the matches with the newest image of the first camera that is old enough, and keep the new one."""
    image = frame.images[0]
    if not image.size:
        return
    now_ns = _exposure_ns(frame, 0)
    old = [entry for entry in earlier if now_ns - entry[0] >= PAIR_S * 1e9]
    if old:
        t_ns, before = old[-1]
        if not np.array_equal(before, image):
            yield flow_between(before, image, (t_ns, now_ns), recording.rig.cameras[0].model)
        while earlier and earlier[0][0] <= t_ns:
            earlier.popleft()
    earlier.append((now_ns, image))


def _across(frame: CameraFrame, recording: Recording) -> Iterator[tuple[int, Flow]]:
    """Yield the matches of the first camera with each further one, with its index."""
    first = recording.rig.cameras[0].model
    for k, (image, camera) in enumerate(zip(frame.images[1:], recording.rig.cameras[1:], strict=True)):
        if image.size and frame.images[0].size:
            yield k, flow_between(frame.images[0], image, (frame.t_ns, frame.t_ns), first, camera.model)


def _equals(image: Image, last: Image) -> bool:
    """Return whether an image equals the one before and has contrast."""
    if not image.size or image.shape != last.shape or not np.array_equal(image[:1], last[:1]):
        return False
    return bool(np.array_equal(image, last)) and int(image.max()) - int(image.min()) > 1


def calibrated_offset_s(recording: Recording) -> float:
    """Return the calibrated time offset of the first camera [s]."""
    rig = recording.rig
    return rig.time_offset_s + rig.cameras[0].time_offset_s


def _exposure_ns(frame: CameraFrame, camera: int) -> int:
    """Return the time stamp of the image of a camera [ns]."""
    delays = frame.image_delays_ns
    return frame.t_ns + (delays[camera] if delays else 0)


def angle_deg(R: Array) -> float:
    """Return the angle of a rotation matrix (3, 3) [°]."""
    return float(np.degrees(np.linalg.norm(log_so3(R))))
