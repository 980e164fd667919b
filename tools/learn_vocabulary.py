"""Learns the visual words for the recognition of places from recordings of rendered flights.

    python tools/learn_vocabulary.py recordings/hall-medium-0 recordings/forest-medium-0 …

The result replaces estimator/slam/places/vocabulary.npy, which was learnt on hall-medium-v0, hall-race-v0 and
room-aggressive-v0 of seed 0 with the rig euroc-stereo. Every recording needs ground truth, from which the direction of
gravity is taken. The same recordings give the same bytes.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from dronevio.estimator.slam.map.keyframe import Descriptors
from dronevio.estimator.slam.places.features import PlaceFeatureExtractor
from dronevio.estimator.slam.places.vocabulary import learn_vocabulary
from dronevio.estimator.types import NO_FEATURES
from dronevio.models.errors import DronevioError
from dronevio.models.recordings.open import open_recording

OUTPUT = Path(__file__).parents[1] / "estimator" / "slam" / "places" / "vocabulary.npy"
INTERVAL_NS = 500_000_000  # time between the frames that are used
SEED = 0


def descriptors_of(folder: Path) -> Descriptors:
    """Return the descriptors (N, 32) of the first camera of a recording.

    Raises:
        InputError: The recording cannot be read.
    """
    recording, extractor = open_recording(folder, 1), PlaceFeatureExtractor()
    truth = recording.ground_truth
    if truth is None:
        raise SystemExit(f"{folder}: no ground truth; expected the orientation of the IMU")
    times = recording.frame_times_ns + round(recording.rig.time_offset_s * 1e9)
    found, last_ns = [], None
    for index, t_ns in enumerate(times.tolist()):
        if last_ns is not None and t_ns - last_ns < INTERVAL_NS:
            continue
        last_ns = t_ns
        nearest = int(np.argmin(np.abs(truth.t_ns - t_ns)))
        images = recording.frame(index).images
        features = extractor.extract(images, recording.rig, truth.rotations[nearest], NO_FEATURES, cameras=[0])
        found.append(features.descriptors)
    return np.concatenate(found)


def main() -> None:
    """Learn the vocabulary and write it."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recordings", nargs="+", type=Path, help="folders of recordings with ground truth")
    parser.add_argument("--out", type=Path, default=OUTPUT, help="file to write")
    arguments = parser.parse_args()
    try:
        descriptors = np.concatenate([descriptors_of(folder) for folder in arguments.recordings])
        vocabulary = learn_vocabulary(descriptors, SEED)
    except DronevioError as error:
        sys.exit(f"{error}")
    np.save(arguments.out, vocabulary.as_array(), allow_pickle=False)
    print(f"{arguments.out}: {vocabulary.size} words from {len(descriptors)} descriptors")


if __name__ == "__main__":
    main()
