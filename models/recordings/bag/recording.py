"""Flights as ROS 2 bags, in: our own to the bit, other people's by what their messages say.

Topics are found by their type. What a bag of others does not say (the noise of its IMU, often where the cameras are)
comes from Kalibr's files. Times are those of the headers; when a message was received does not matter. The images of a
frame may be stamped apart by a little, and a frame is stamped as its first camera's image.

Opening a bag looks at each image once, for its time stamp, and keeps none; `BagRecording.frame` decodes one at a time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Self, cast

import numpy as np
import numpy.typing as npt
from rosbags.typesys.stores import ros2_humble as ros

from dronevio.models.imu import ImuSamples, Times
from dronevio.models.recordings.bag.file import BagFile
from dronevio.models.recordings.bag.messages import ImageMessage, grey_image, imu_samples
from dronevio.models.recordings.bag.options import BagTopics
from dronevio.models.recordings.bag.rig import bag_rig, read_calibrations
from dronevio.models.recordings.bag.topics import IMAGE_TYPES, find_topics, image_topics, truth_topic
from dronevio.models.recordings.bag.truth import read_bag_frame_truth, read_bag_truth
from dronevio.models.recordings.bag.writer import TRUTH_TOPIC
from dronevio.models.recordings.frame_truth import FrameTruth
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Trajectory

Array = npt.NDArray[np.float64]

SYNCHRONOUS_S = 1e-3
"""How far apart the images of one frame may be stamped [s]."""


@dataclass(frozen=True, eq=False)
class BagRecording:
    """A flight that was read from a ROS 2 bag; satisfies the `Recording` protocol."""

    name: str
    """Name of the file or folder."""
    rig: Rig
    """The calibration."""
    imu: ImuSamples
    """All IMU samples, in time order."""
    frame_times_ns: Times
    """(M,) Time stamps of the first camera's images to which all others have one [ns], strictly increasing."""
    ground_truth: Trajectory | None
    """The true motion of the IMU, where the bag has it."""
    frame_truth: FrameTruth | None
    """When and how frames were really exposed, where the bag has it."""
    topics: BagTopics
    """Which topics were read."""
    image_rows: npt.NDArray[np.int64] = field(repr=False)
    """(M, C) For each frame, which of its topic's messages each camera's image is."""
    images: tuple["ImageTopic", ...] = field(repr=False)
    """Of each camera, where its images are."""
    complete: bool = True
    """A bag that was cut off cannot be opened."""

    @classmethod
    def open(
        cls,
        path: Path | str,
        cameras: int | None = None,
        calibration: Sequence[Path] = (),
        topics: BagTopics | None = None,
        synchronous_s: float = SYNCHRONOUS_S,
    ) -> Self:
        """Read everything but the images.

        Args:
            path: An ``.mcap`` or ``.db3`` file, or a folder as ``ros2 bag`` makes it.
            cameras: Use only the first so many cameras; None for all.
            calibration: Kalibr's files, in place of what the bag says.
            topics: Which topics to read, where they cannot be found by type, or shall be others.
            synchronous_s: How far apart the images of one frame may be stamped [s].

        Raises:
            InputError: Something is missing, damaged or not supported, or it is not clear which topic is meant.
        """
        bag, files = BagFile(Path(path)), [Path(file) for file in calibration]
        calibrated = next((said.topics for said in read_calibrations(bag, files) if said.topics), ())
        chosen = find_topics(bag, topics or BagTopics(), calibrated, cameras)
        images = tuple(ImageTopic(bag, topic) for topic in chosen.images)
        times, rows = synchronized(bag, images, synchronous_s)
        rig, sampling = bag_rig(bag, chosen, read_calibrations(bag, files, _rate_hz(times)), _rate_hz(times))
        t_ns, messages = bag.stamped(chosen.imu)
        try:
            gyro, accel = imu_samples(cast("list[ros.sensor_msgs__msg__Imu]", messages))
        except ValueError as error:
            raise bag.fault(f"{chosen.imu}: {error}", "both in each message") from None
        if not (np.isfinite(gyro).all() and np.isfinite(accel).all()):
            raise bag.fault(f"{chosen.imu}: a number that is not finite", "finite numbers")
        return cls(
            name=Path(path).resolve().stem,
            rig=rig,
            imu=ImuSamples(t_ns, gyro, accel, sampling),
            frame_times_ns=times,
            ground_truth=read_bag_truth(bag, chosen.truth) if chosen.truth else None,
            frame_truth=read_bag_frame_truth(bag),
            topics=chosen,
            image_rows=rows,
            images=images,
        )

    def frame(self, index: int) -> CameraFrame:
        """Return the frame of the given index, 0 ≤ index < M.

        Raises:
            InputError: An image of it is damaged, or not of the calibration's size.
        """
        images = tuple(
            topic.image(row, camera.model.width, camera.model.height)
            for topic, row, camera in zip(self.images, self.image_rows[index].tolist(), self.rig.cameras, strict=True)
        )
        return CameraFrame(int(self.frame_times_ns[index]), images)


class ImageTopic:
    """The images of one topic, one at a time: quickest in their order, but any can be asked for."""

    def __init__(self, bag: BagFile, topic: str) -> None:
        """Look when they were taken.

        Raises:
            InputError: There are none, their time stamps do not increase, or the bag is damaged.
        """
        self._bag, self._topic = bag, topic
        stamps = [(bag.stamp_ns(topic, raw), logged_ns) for logged_ns, raw in bag.raw(topic)]
        if not stamps:
            raise bag.fault(f"{topic}: no messages", "images")
        taken_ns, logged_ns = np.array(stamps, dtype=np.int64).T
        order = np.argsort(taken_ns, kind="stable")
        self.t_ns: Times = taken_ns[order]
        """(K,) When they were taken [ns], increasing."""
        self._logged_ns = logged_ns[order]
        bag.check_stamps(topic, self.t_ns)
        self._reader: BagFile | None = None
        self._ahead: Iterator[tuple[int, bytes]] = iter(())

    def image(self, row: int, width: int, height: int) -> npt.NDArray[np.uint8]:
        """Return the grey (height, width) image of a row.

        Raises:
            InputError: It is damaged, or of another size.
        """
        message = cast(ImageMessage, self._bag.decode(self._topic, self._message(row)))
        return grey_image(self._bag.path, f"{self._topic} at {self.t_ns[row]} ns", message, width, height)

    def _message(self, row: int) -> bytes:
        """Return the bytes of a message: the next one if that is the one, else found by when it was written."""
        wanted = int(self.t_ns[row])
        for _, raw in self._ahead:
            if self._bag.stamp_ns(self._topic, raw) == wanted:
                return raw
            break
        if self._reader is None:  # of its own, since one reader cannot be at two places in a file
            self._reader = BagFile(self._bag.path)
        self._ahead = self._reader.raw(self._topic, int(self._logged_ns[row]))
        for _, raw in self._ahead:
            if self._bag.stamp_ns(self._topic, raw) == wanted:
                return raw
        raise self._bag.fault(f"{self._topic}: the image of {wanted} ns is gone", "a bag that nobody changes meanwhile")


def read_truth(path: Path) -> Trajectory:
    """Read the true motion in a bag, and nothing else of it.

    Raises:
        InputError: The bag is damaged, or has none.
    """
    bag = BagFile(path)
    topic = truth_topic(bag)
    if not topic:
        raise bag.fault("no true motion", f"one, such as {TRUTH_TOPIC}")
    return read_bag_truth(bag, topic)


def read_bag_frame_times(path: Path) -> Times | None:
    """Return the time stamps (M,) [ns] of the first camera's images in a bag, None where it has none.

    Raises:
        InputError: The bag is damaged.
    """
    bag = BagFile(path)
    if not bag.of_type(*IMAGE_TYPES):
        return None
    calibrated = next((said.topics for said in read_calibrations(bag, []) if said.topics), ())
    return ImageTopic(bag, image_topics(bag, calibrated)[0]).t_ns


def synchronized(
    bag: BagFile, images: Sequence[ImageTopic], synchronous_s: float
) -> tuple[Times, npt.NDArray[np.int64]]:
    """Return the frames: time stamps (M,) [ns], and for each which image (M, C) of each camera belongs to it.

    Raises:
        InputError: There is none.
    """
    times = images[0].t_ns
    rows, apart = [np.arange(len(times))], [np.zeros(len(times), np.int64)]
    for other in images[1:]:
        after = np.clip(np.searchsorted(other.t_ns, times), 1, max(len(other.t_ns) - 1, 1))
        before = after - 1
        after = np.minimum(after, len(other.t_ns) - 1)
        nearer = np.where(np.abs(other.t_ns[after] - times) < np.abs(other.t_ns[before] - times), after, before)
        rows.append(nearer)
        apart.append(np.abs(other.t_ns[nearer] - times))
    worst = np.max(apart, axis=0)
    kept = worst <= synchronous_s * 1e9
    if not kept.any():
        found = f"no two images of all {len(images)} cameras closer in time than {worst.min() * 1e-9:.4g} s"
        raise bag.fault(found, f"frames whose images are stamped within {synchronous_s:g} s")
    return times[kept], np.stack(rows, axis=1)[kept]


def _rate_hz(times_ns: Times) -> float:
    """Return the rate of frames [Hz]; 20 where there is but one."""
    return 1e9 / float(np.median(np.diff(times_ns))) if len(times_ns) > 1 else 20.0
