"""Videos: each frame is the one of its time stamp, in any order of the requests."""

from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import numpy.typing as npt
import pytest

from dronevio.models import CameraModel, ConfigError, InputError, image_video
from dronevio.models.recordings.video_frames import read_video_index

FRAMES = 40
WIDTH, HEIGHT = 64, 48


def level(index: int) -> int:
    """Return the brightness of a frame, by which it is recognized."""
    return 20 + 5 * index


def encode(path: Path, codec: str, pix_fmt: str = "yuv420p", options: dict[str, str] | None = None) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(25), options=options or {})
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, pix_fmt
        stream.gop_size, stream.bit_rate = 10, 4_000_000
        for index in range(FRAMES):
            pixels = np.full((HEIGHT, WIDTH, 3), level(index), np.uint8)
            pixels[: HEIGHT // 2, : WIDTH // 2] = (200, 40, 40)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")))
        container.mux(stream.encode(None))
    return path


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("videos")
    return {
        "mp4": encode(folder / "a.mp4", "libx264", options={"bf": "3", "x264-params": "open-gop=1"}),
        "mkv": encode(folder / "a.mkv", "libx264", options={"bf": "2"}),
        "mov": encode(folder / "a.mov", "mjpeg", "yuvj420p"),
        "avi": encode(folder / "a.avi", "mpeg4"),
        "webm": encode(folder / "a.webm", "libvpx-vp9", options={"cpu-used": "8", "auto-alt-ref": "1"}),
    }


def brightness(image: npt.NDArray[np.uint8]) -> float:
    return float(image[-HEIGHT // 3 :].mean())


@pytest.mark.parametrize("kind", ["mp4", "mkv", "mov", "avi", "webm"])
def test_frames_are_the_same_in_any_order(videos: dict[str, Path], kind: str) -> None:
    images = image_video(videos[kind])
    assert len(images) == FRAMES and images.names[12] == "frame-000012"
    in_order = [images.read(i) for i in range(FRAMES)]
    for index, image in enumerate(in_order):
        assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.uint8
        assert brightness(image) == pytest.approx(level(index), abs=2.4), index
    for index in np.random.default_rng(0).permutation(FRAMES).tolist():
        np.testing.assert_array_equal(images.read(index), in_order[index])


def test_channels_are_red_green_blue(videos: dict[str, Path]) -> None:
    corner = image_video(videos["mov"]).read(20)[4:16, 4:16].mean(axis=(0, 1))
    np.testing.assert_allclose(corner, (200, 40, 40), atol=12)


@pytest.mark.parametrize("kind", ["mp4", "avi"])
def test_every_tenth_frame_with_its_time(videos: dict[str, Path], kind: str) -> None:
    images = image_video(videos[kind], every=10)
    assert images.names == ("frame-000000", "frame-000010", "frame-000020", "frame-000030")
    assert images.t_ns is not None and images.is_ordered
    np.testing.assert_array_equal(np.diff(images.t_ns), 400_000_000)
    assert [round(brightness(images.read(i))) for i in range(4)] == pytest.approx([20, 70, 120, 170], abs=2)


def test_threads_may_read_at_once(videos: dict[str, Path]) -> None:
    images = image_video(videos["mp4"])
    with ThreadPoolExecutor(4) as pool:
        found = [brightness(image) for image in pool.map(images.read, range(FRAMES))]
    np.testing.assert_allclose(found, [level(i) for i in range(FRAMES)], atol=2.4)


def test_images_can_be_changed_by_the_caller(videos: dict[str, Path]) -> None:
    images = image_video(videos["avi"])
    first = images.read(3)
    kept = first.copy()
    first[:] = 0
    np.testing.assert_array_equal(images.read(3), kept)


def test_keyframes_are_found(videos: dict[str, Path]) -> None:
    index = read_video_index(videos["mp4"])
    assert len(index.pts) == FRAMES and 3 <= len(index.keyframe_pts) <= 5
    assert set(index.keyframe_pts.tolist()) <= set(index.pts.tolist())


def test_grey_videos_are_grey(tmp_path: Path) -> None:
    image = image_video(encode(tmp_path / "a.mkv", "ffv1", "gray")).read(7)
    assert image.shape == (HEIGHT, WIDTH)
    assert brightness(image) == pytest.approx(level(7), abs=2.4)


def test_a_calibration_is_used(videos: dict[str, Path]) -> None:
    model = CameraModel(WIDTH, HEIGHT, 60.0, 61.0, 31.0, 23.0)
    images = image_video(videos["mp4"], model=model)
    assert images.cameras == (model,) and images.is_calibrated.all() and images.focal_source == ("calibration",)
    guess = image_video(videos["mp4"])
    assert guess.cameras[0].fx == 1.2 * WIDTH and not guess.is_calibrated.any()
    with pytest.raises(InputError, match="64 × 48 px; expected 65 × 48 px as in the calibration"):
        image_video(videos["mp4"], model=CameraModel(65, 48, 60.0, 61.0, 31.0, 23.0))


@pytest.mark.parametrize("content", [None, b"", b"no video" * 100])
def test_files_that_are_no_videos_are_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "a.mp4"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mp4: .*expected a video that can be decoded"):
        image_video(path)


def test_videos_without_pictures_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("pcm_s16le", rate=8000)
        sound = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
        sound.sample_rate = 8000
        container.mux(stream.encode(sound))
    with pytest.raises(InputError, match="no video stream"):
        image_video(path)


def test_frames_without_time_stamps_are_refused(tmp_path: Path) -> None:
    """AVI stores the order of decoding only."""
    path = encode(tmp_path / "a.avi", "libx264", options={"bf": "3"})
    with pytest.raises(InputError, match="B-frames, whose times it does not store; expected a video with a time stamp"):
        image_video(path)


def test_damaged_frames_are_refused(videos: dict[str, Path], tmp_path: Path) -> None:
    data = bytearray(videos["mkv"].read_bytes())
    with av.open(str(videos["mkv"])) as container:
        packets = [(p.pos, p.size, p.pts) for p in container.demux(video=0) if p.size]
    for position, size, _ in packets[20:25]:
        assert position is not None
        start = position + size // 2
        data[start : start + size // 2] = bytes(size // 2)
    path = tmp_path / "a.mkv"
    path.write_bytes(data)
    images = image_video(path)
    assert brightness(images.read(2)) == pytest.approx(level(2), abs=2.4)
    with pytest.raises(InputError, match=r"a\.mkv: "):
        for index in range(18, 28):
            images.read(index)


def test_no_frame_distance_is_refused(videos: dict[str, Path]) -> None:
    with pytest.raises(ConfigError, match="expected 1 or more"):
        image_video(videos["mp4"], every=0)


def test_indices_beyond_the_end_are_refused(videos: dict[str, Path]) -> None:
    images = image_video(videos["mp4"], every=10)
    with pytest.raises(IndexError):
        images.read(4)
    np.testing.assert_array_equal(images.read(-1), images.read(3))
