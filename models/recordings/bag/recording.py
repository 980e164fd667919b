"""Reading of recordings from bags of ROS 1 and ROS 2.

Topics are found by their message type. Bags that this package wrote are read without loss of precision; for others, the
calibration that is not in the bag (IMU noise, often the extrinsics of the cameras) comes from Kalibr's files. Times are
those of the message headers, and of the log where a header has none. The images of a frame may differ in their time
stamps by a small tolerance; the time stamp of the frame is that of the image of the first camera.

Opening a bag reads the time stamp of each image; `BagRecording.frame` decodes the images of one frame.
"""

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array
from dronevio.models.defects import Defect
from dronevio.models.errors import InputError
from dronevio.models.imu import ImuModel, ImuSamples, Sampling, Times
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.imu import read_imu_rows
from dronevio.models.recordings.bag.messages import ImageMessage, grey_image
from dronevio.models.recordings.bag.missing import MissingParts
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.rig import bag_rig, read_calibrations
from dronevio.models.recordings.bag.stamps import TopicStamps
from dronevio.models.recordings.bag.topics import IMAGE_TYPES, IMU_TYPES, find_topics, image_topics, truth_topic
from dronevio.models.recordings.bag.truth import read_bag_frame_truth, read_bag_truth
from dronevio.models.recordings.bag.writer import TRUTH_TOPIC
from dronevio.models.recordings.bit_depth import MAX_BITS, DeepImage, significant_bits, spread, to_8bit
from dronevio.models.recordings.frame_groups import ABSENT, FrameGroups, grouped_frames
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.recordings.images import DamagedImageError, assembled_frame
from dronevio.models.recordings.repair import (
    IMAGE_STAMPS,
    imu_defects,
    increasing_rows,
    repaired_samples,
    unpaired_images,
)
from dronevio.models.recordings.segments import Split, segment_name, split_at_steps, usable_segments
from dronevio.models.rig import Cameras, Rig, camera_indices
from dronevio.models.state import CameraFrame, Trajectory

MAX_TIME_S = 1e9  # longer than any recording


@dataclass(frozen=True, eq=False)
class BagRecording:
    """A recording in a bag; satisfies the `Recording` protocol."""

    name: str
    """Name of the file or folder of the bag."""
    rig: Rig
    """Calibration of cameras and IMU."""
    imu: ImuSamples
    """IMU samples of the whole recording."""
    frame_times_ns: Times
    """(M,) Time stamps of the frames, strictly increasing [ns]: those of the images of the first camera that all other
    cameras match; with `repair`, also those that not every camera has."""
    ground_truth: Trajectory | None
    """Ground truth of the IMU, None if the bag has none."""
    frame_truth: FrameTruth | None
    """Ground truth of the frames, None if the bag has none."""
    topics: BagTopics
    """Topics that were read."""
    image_rows: npt.NDArray[np.int64] = field(repr=False)
    """(M, C) Index of the message of each frame and camera in the image topic, `ABSENT` where there is none."""
    image_delays_ns: Times = field(repr=False)
    """(M, C) How much later than its frame each image is stamped [ns]."""
    images: tuple["ImageTopic", ...] = field(repr=False)
    """Image topic of each camera."""
    complete: bool = True
    """Whether the recording is complete; a truncated bag cannot be opened."""
    repair: bool = False
    """Whether damaged images are left out of their frames; otherwise they raise an error."""
    defects: tuple[Defect, ...] = field(default=(), repr=False)
    """Defects that were found when the bag was opened with `repair`."""
    later: tuple["BagRecording", ...] = field(default=(), repr=False)
    """Segments after steps of the clock, each a recording of its own, if the bag was opened with `repair`; see
    `dronevio.models.recordings.segments`."""

    @classmethod
    def open(
        cls,
        path: Path | str,
        cameras: Cameras = None,
        calibration: Sequence[Path] = (),
        topics: BagTopics | None = None,
        sync_tolerance_s: float | None = None,
        repair: bool = False,
        imu: ImuModel | None = None,
    ) -> "BagRecording":
        """Read everything except the images.

        Args:
            path: A ``.bag``, ``.mcap`` or ``.db3`` file, or a folder written by ``ros2 bag``.
            cameras: Cameras to use, in the order of the calibration or of the topics.
            calibration: Calibration files of Kalibr, which replace the calibration in the bag.
            topics: Topics to read instead of those found by message type.
            sync_tolerance_s: Largest difference between the exposures of two images of one frame [s]; None for half of
                the time between frames, at most 25 ms.
            repair: Whether to go on with damaged images, time stamps that do not increase and IMU samples that are not
                finite, and to list them in `defects`. Otherwise, damaged images, equal time stamps and samples that are
                not finite raise an error, and frames that not every camera has are left out.
            imu: Model of the IMU in place of that of the calibration, for a bag without noise densities. Its rate is
                replaced by that of the samples.

        Raises:
            InputError: A topic or a field is missing, damaged, not supported or ambiguous; or, with `repair`, IMU and
                cameras do not overlap in time.
            ConfigError: A camera does not exist.
        """
        bag, files = BagFile(Path(path)), [Path(file) for file in calibration]
        parts = MissingParts(bag)
        selected = find_topics(bag, topics or BagTopics(), _calibrated_topics(bag, files), parts)
        used = camera_indices(cameras, len(selected.images)) if selected.images else ()
        selected = replace(selected, images=tuple(selected.images[index] for index in used))
        if not selected.images or not selected.imu:  # raises for all that is missing
            bag_rig(bag, selected, used, read_calibrations(bag, files), 20.0, parts, imu)
        imu_stamps, imu_values = read_imu_rows(bag, selected.imu)
        streams = [imu_stamps, *(bag.stamps(topic) for topic in selected.images)]
        split = split_at_steps([each.t_ns for each in streams])
        if not repair:
            _check_clock(bag, streams, split)
            split = Split(split.stamps, (), ((),) * len(streams))
        streams = [replace(each, t_ns=t_ns) for each, t_ns in zip(streams, split.stamps, strict=True)]
        truths, frame_truth = _truths(bag, selected.truth, imu_stamps, split), read_bag_frame_truth(bag)

        def segment(index: int) -> "BagRecording":
            own = [each.selected(split.rows(k)[index]) for k, each in enumerate(streams)]
            images = tuple(ImageTopic(bag, stamps, repair) for stamps in own[1:])
            calibrations = read_calibrations(bag, files, _rate_hz(images[0].t_ns))
            rig, sampling = bag_rig(bag, selected, used, calibrations, _rate_hz(images[0].t_ns), parts, imu)
            frames = _frames(bag, images, rig, sync_tolerance_s, repair)
            times = frames.t_ns
            samples, imu_found = _imu_of(bag, own[0], imu_values[split.rows(0)[index]], sampling, repair)
            if imu is not None and len(samples) > 1:
                rig = replace(rig, imu=replace(imu, rate_hz=_rate_hz(samples.t_ns)))
            defects: tuple[Defect, ...] = ()
            if repair:
                defects = (
                    *(defect for each in own for defect in each.defects),
                    *(defect for topic in images for defect in topic.defects),
                    *unpaired_images(times, frames.rows, selected.images),
                    *imu_found,
                    *imu_defects(samples, times, rig.time_offset_s, bag.path),
                    *split.defects(index, [each.place for each in streams]),
                )
            return cls(
                name=segment_name(Path(path).resolve().stem, index + 1, len(split.steps) + 1),
                rig=rig,
                imu=samples,
                frame_times_ns=times,
                ground_truth=truths[index],
                frame_truth=frame_truth,
                topics=selected,
                image_rows=frames.rows,
                image_delays_ns=frames.delays_ns,
                images=images,
                repair=repair,
                defects=defects,
            )

        segments = usable_segments(len(split.steps) + 1, segment)
        first, *later = [replace(each, defects=(*left_out, *each.defects)) for each, left_out in segments]
        return replace(first, later=tuple(later))

    def frame(self, index: int) -> CameraFrame:
        """Return the frame with a given index, 0 ≤ index < M.

        Raises:
            InputError: An image has another size than in the calibration; or it is damaged, unless `repair` is set.
        """
        reads = [
            None if row == ABSENT else partial(topic.image, row, camera.model.width, camera.model.height)
            for topic, row, camera in zip(self.images, self.image_rows[index].tolist(), self.rig.cameras, strict=True)
        ]
        return assembled_frame(int(self.frame_times_ns[index]), reads, self.repair, self.image_delays_ns[index])


class ImageTopic:
    """Images of one topic, decoded one at a time; access in the order of time is fastest."""

    def __init__(self, bag: BagFile, stamps: TopicStamps, repair: bool = False) -> None:
        """Take the time stamps of the images.

        Args:
            bag: The bag.
            stamps: Time stamps of the images to use.
            repair: Whether to use the first of several images with the same time stamp.

        Raises:
            InputError: Two images have the same time stamp.
        """
        topic, t_ns = stamps.topic, stamps.t_ns
        self._bag, self._topic = bag, topic
        order, defects = increasing_rows(t_ns, IMAGE_STAMPS, lambda row: f"{topic}: image at {t_ns[row]} ns")
        if not repair:
            bag.check_stamps(topic, np.sort(t_ns))
        self.defects = defects
        """Defects of the time stamps."""
        self.t_ns: Times = t_ns[order]
        """(K,) Time stamps of the images, increasing [ns]."""
        self._stamps = stamps.selected(order)
        self._bits: int | None = None  # significant bits of images of 16 bits, once there was one
        self._reader: BagFile | None = None
        self._following: Iterator[tuple[int, bytes]] = iter(())

    def image(self, row: int, width: int, height: int) -> npt.NDArray[np.uint8]:
        """Return the grey image (height, width) with index ``row`` in the order of time stamps.

        Images of 16 bits are scaled by the range that occurs in those of the topic.

        Raises:
            DamagedImageError: The image is damaged.
            InputError: The image has another size or encoding.
        """
        deep = self._stored(row, width, height)
        if deep.dtype != np.uint8 and self._bits is None:
            self._bits = significant_bits(self._readable(width, height))
        return to_8bit(deep, self._bits or MAX_BITS)

    def _readable(self, width: int, height: int) -> Iterator[DeepImage]:
        """Yield some images of the topic as they are stored, of those that can be read."""
        for row in spread(range(len(self.t_ns))):
            with suppress(InputError):
                yield self._stored(row, width, height)

    def _stored(self, row: int, width: int, height: int) -> DeepImage:
        """Return an image as it is stored; see `image`."""
        raw = self._message(row)
        try:
            message = cast(ImageMessage, self._bag.decode(self._topic, raw))
        except InputError as error:
            where = f"{self._topic} at {self.t_ns[row]} ns: a message that cannot be decoded"
            raise DamagedImageError(error.path, where, "an image") from None
        return grey_image(self._bag.path, f"{self._topic} at {self.t_ns[row]} ns", message, width, height)

    def _message(self, row: int) -> bytes:
        """Return the bytes of the message with index ``row``: the following one, or else found by its log time."""
        stamps = self._stamps
        times, (before, count) = (int(stamps.logged_ns[row]), int(stamps.header_ns[row])), stamps.twins[row].tolist()
        for logged_ns, raw in self._following:
            if count == 1 and (logged_ns, self._bag.stamp_ns(self._topic, raw)) == times:
                return raw
            break
        if self._reader is None:  # a separate reader, because a reader has one position in the file
            self._reader = BagFile(self._bag.path)
        self._following = self._reader.raw_messages(self._topic, times[0])
        for logged_ns, raw in self._following:
            if (logged_ns, self._bag.stamp_ns(self._topic, raw)) == times:
                if before == 0:
                    return raw
                before -= 1
        raise self._bag.error(
            f"{self._topic}: the image of {self.t_ns[row]} ns is missing", "a bag that does not change while it is read"
        )


def read_truth(path: Path, poses_ns: Times | None = None) -> Trajectory:
    """Read the ground truth of a bag.

    Args:
        path: The bag.
        poses_ns: Time stamps of poses; where the clock of the truth steps, it is the part with the most of these, or
            the first one [ns].

    Raises:
        InputError: The bag is damaged or has no ground truth.
    """
    bag = BagFile(path)
    topic = truth_topic(bag)
    if not topic:
        raise bag.error("no ground truth", f"a topic with true poses, such as {TRUTH_TOPIC}")
    split = split_at_steps([bag.stamps(topic).t_ns])
    if not any(step[0].is_fall for step in split.steps):
        return read_bag_truth(bag, topic)
    parts = [read_bag_truth(bag, topic, rows) for rows in split.rows(0)]
    poses_ns = parts[0].t_ns if poses_ns is None else poses_ns
    return max(parts, key=lambda part: int(np.sum((poses_ns >= part.t_ns[0]) & (poses_ns <= part.t_ns[-1]))))


def read_bag_frame_times(path: Path) -> tuple[Times, ...]:
    """Return the time stamps (M,) [ns] of the images of the first camera in each segment of a bag; none without images.

    Raises:
        InputError: The bag is damaged.
    """
    bag = BagFile(path)
    if not bag.topics_of_type(*IMAGE_TYPES):
        return ()
    stamps = bag.stamps(image_topics(bag, _calibrated_topics(bag, ()))[0])
    split = split_at_steps([stamps.t_ns])
    if len(split.steps):  # what the camera has in common with the IMU
        imu = bag.topics_of_type(*IMU_TYPES)
        split = split_at_steps([stamps.t_ns, *(bag.stamps(topic).t_ns for topic in imu[:1])])
    stamps = replace(stamps, t_ns=split.stamps[0])
    return tuple(ImageTopic(bag, stamps.selected(rows), repair=True).t_ns for rows in split.rows(0))


def _calibrated_topics(bag: BagFile, files: Sequence[Path]) -> tuple[str, ...]:
    """Return the image topics that the calibration names, in Kalibr's files or in the bag; empty if there are none."""
    calibrations = read_calibrations(bag, files)
    return next((calibration.topics for calibration in calibrations if calibration.topics), ())


def _check_clock(bag: BagFile, streams: Sequence[TopicStamps], split: Split) -> None:
    """Raise InputError if the clock of a bag steps back, or a header has no time stamp."""
    for stamps, lone in zip(streams, split.lone, strict=True):
        if stamps.unset.any():
            bag.check_stamps(stamps.topic, np.sort(stamps.header_ns))
        for step in lone:
            raise bag.error(f"{stamps.place(step.row)}: {step}", "time stamps of a clock that runs on")
    for step in (step[0] for step in split.steps if step[0].is_fall):
        raise bag.error(f"{streams[0].place(step.row)}: {step}", "time stamps of a clock that runs on")


def _truths(bag: BagFile, topic: str, imu: TopicStamps, split: Split) -> tuple[Trajectory | None, ...]:
    """Return the ground truth of each segment: the part with its steps if it has them too, or else the whole."""
    count = len(split.steps) + 1
    if not topic:
        return (None,) * count
    if count > 1:
        own = split_at_steps([imu.t_ns, bag.stamps(topic).t_ns])
        if len(own.steps) == len(split.steps):
            return tuple(read_bag_truth(bag, topic, rows) for rows in own.rows(1))
    return (read_bag_truth(bag, topic),) * count


def _imu_of(
    bag: BagFile, stamps: TopicStamps, values: Array, sampling: Sampling, repair: bool
) -> tuple[ImuSamples, tuple[Defect, ...]]:
    """Return IMU samples in the order of time, and their defects.

    Raises:
        InputError: No sample is finite; or, without `repair`, two have the same time stamp or one is not finite.
    """
    topic = stamps.topic
    if not repair:
        bag.check_stamps(topic, np.sort(stamps.t_ns))
    t_ns, rows, defects = repaired_samples(stamps.t_ns, values, lambda row: f"{topic}: sample at {stamps.t_ns[row]} ns")
    if not len(rows) or (len(rows) < len(values) and not repair):
        raise bag.error(f"{topic}: a non-finite number", "finite numbers")
    gyro, accel = np.ascontiguousarray(values[rows, :3]), np.ascontiguousarray(values[rows, 3:])
    return ImuSamples(t_ns, gyro, accel, sampling), defects


def _frames(
    bag: BagFile, images: Sequence[ImageTopic], rig: Rig, sync_tolerance_s: float | None, repair: bool
) -> FrameGroups:
    """Return the frames for which every camera has an image; with `repair`, also those of some cameras.

    Raises:
        InputError: No frame has an image of each camera.
    """
    stamps, offsets_s = [topic.t_ns for topic in images], [camera.time_offset_s for camera in rig.cameras]
    groups = grouped_frames(stamps, offsets_s, sync_tolerance_s)
    if groups.is_complete.any():
        return groups if repair else groups[groups.is_complete]
    groups = grouped_frames(stamps, offsets_s, MAX_TIME_S)
    t_ns = np.stack([of[rows] for of, rows in zip(stamps, groups.rows[groups.is_complete].T, strict=True)])
    differ_s = 1e-9 * float(np.ptp(t_ns, axis=0).min(initial=MAX_TIME_S * 1e9))
    expected = "half of the time between frames" if sync_tolerance_s is None else f"{sync_tolerance_s:g} s"
    raise bag.error(
        f"no images of all {len(images)} cameras closer in time than {differ_s:.4g} s",
        f"frames whose time stamps differ by at most {expected}",
    )


def _rate_hz(times_ns: Times) -> float:
    """Return the rate [Hz] of time stamps (M,) [ns]; 20 if there is only one."""
    return 1e9 / float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 20.0
