"""Make the moving picture of exploration for docs/images: a drone finds its way through an office, and its map grows.

An image flight of ``dv.explore`` with visual SLAM. Every 0.4 s: on the left the map at the height of the hover with the
estimated path so far, the route to the goal and the plan; on the right the image of the left camera. The figures of the
flight and the hash of the picture are recorded beside it, in ``explore.json``, for the captions in the pages::

    .venv/bin/python tools/explore_picture.py

``make pictures`` makes it with the others. It takes two minutes.
"""

import hashlib
import json
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import numpy.typing as npt
import tyro
from PIL import Image, ImageDraw, ImageFont

import dronevio as dv
from dronevio.autonomy.pilot.explorer import Explorer
from dronevio.autonomy.settings import ExploreSettings
from dronevio.models.arrays import Array
from dronevio.models.depth import DepthImage
from dronevio.models.occupancy import FREE, OCCUPIED, OccupancyGrid
from dronevio.models.rotation import inverse_pose
from dronevio.models.state import CameraFrame, Estimate
from dronevio.sim.world import flight_area

Picture = npt.NDArray[np.uint8]

INTERVAL_NS, SHOWN_MS, LAST_MS = 400_000_000, 200, 2500
"""Time of the flight between two frames, and how long a frame and the last one are shown."""
PX_PER_M, EDGE_M = 22.0, 0.3
MAP_PX = np.array([448.0, 374.0])
"""Width and height to which the map of a small world is enlarged [px]."""
WIDTH_PX, GAP_PX, CAPTION_PX = 800, 8, 132
COLOURS = 96
UNKNOWN_GREY, FREE_GREY, OCCUPIED_GREY, PAPER_GREY, INK_GREY = 176, 255, 24, 24, 235
GREEN, BLUE, ORANGE = (0, 140, 100), (0, 114, 178), (213, 94, 0)


@dataclass(frozen=True, eq=False)
class Moment:
    """What the drone knows at a time."""

    t_ns: int
    """Time of the flight [ns]."""
    grid: OccupancyGrid
    """The map, in the map frame."""
    T_map_imu: Array
    """(4, 4) Estimated pose of the IMU."""
    speed_m_s: float
    """Estimated speed [m/s]."""
    image: Picture
    """(H, W) Image of the left camera."""


class Recorder:
    """Keeps what the drone knows, every 0.4 s."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.moments: list[Moment] = []
        self.path: list[tuple[int, Array]] = []
        self._frame: CameraFrame | None = None

    def frame(self, frame: CameraFrame) -> None:
        """Receive a frame before its depth."""
        self._frame = frame

    def depth(self, depth: DepthImage, estimate: Estimate, pilot: Explorer) -> None:
        """Keep a moment if the next one is due; implements `FlightListener`."""
        state, T, frame = estimate.state, estimate.T_map_imu, self._frame
        if state is None or T is None or frame is None:
            return
        self.path.append((depth.t_ns, T))
        if self.moments and depth.t_ns < self.moments[-1].t_ns + INTERVAL_NS:
            return
        grid = pilot.mapper.fused()
        if grid is not None:
            speed_m_s = float(np.linalg.norm(state.velocity_m_s))
            self.moments.append(Moment(depth.t_ns, grid, T, speed_m_s, frame.images[0].copy()))


@cache
def font(size_px: int) -> ImageFont.FreeTypeFont:
    """Return the font of the captions."""
    return ImageFont.truetype(str(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / "DejaVuSans.ttf"), size_px)


class Drawing:
    """Draws the moments of a flight."""

    def __init__(self, flight: dv.Exploration, path: list[tuple[int, Array]]) -> None:
        """Take a flight and its estimated poses of the IMU in the map with their times."""
        self._flight = flight
        area = flight_area(flight.scenario.world, flight.scenario.seed_of_world)
        self._low, high = area.space.low[:2] - EDGE_M, area.space.high[:2] + EDGE_M
        self._scale = max(PX_PER_M, float((MAP_PX / (high - self._low)).min()))
        width, height = (int(self._scale * side) for side in high - self._low)
        x = self._low[0] + (np.arange(width) + 0.5) / self._scale
        y = self._low[1] + (np.arange(height)[::-1] + 0.5) / self._scale
        z = area.pad[2] + ExploreSettings().height_m
        points = np.stack([*np.meshgrid(x, y), np.full((height, width), z)], axis=-1)
        T_map_world = inverse_pose(flight.T_world_map)
        self._points_map = points @ T_map_world[:3, :3].T + T_map_world[:3, 3]
        self._size = width, height
        self._path_ns = np.array([t_ns for t_ns, _ in path])
        self._path_m = self._world(np.array([T[:3, 3] for _, T in path]))
        self._plan_ns = np.array([plan.t_ns + flight.waited_ns for plan in flight.plans])

    def picture(self, moment: Moment) -> Picture:
        """Return a frame (H, W, 3)."""
        width, height = self._size
        image_width = WIDTH_PX - width - GAP_PX
        image_height = round(moment.image.shape[0] * image_width / moment.image.shape[1])
        picture = np.full((max(height, image_height + CAPTION_PX), WIDTH_PX, 3), PAPER_GREY, np.uint8)
        picture[:height, :width] = self._map(moment)
        image = cv2.resize(moment.image, (image_width, image_height), interpolation=cv2.INTER_AREA)
        picture[:image_height, width + GAP_PX :] = image[..., None]
        return self._captioned(picture, moment, (width + GAP_PX + 4, image_height + 14))

    def _map(self, moment: Moment) -> Picture:
        """Return the map with path, route and plan."""
        states = moment.grid.at(self._points_map)
        grey = np.full(states.shape, UNKNOWN_GREY, np.uint8)
        grey[states == FREE], grey[states == OCCUPIED] = FREE_GREY, OCCUPIED_GREY
        picture = np.ascontiguousarray(np.repeat(grey[..., None], 3, axis=2))
        flown = self._path_m[self._path_ns <= moment.t_ns]
        number = int(np.searchsorted(self._plan_ns, moment.t_ns, side="right")) - 1
        plan = self._flight.plans[number] if number >= 0 else None
        if plan is not None:
            self._dashed(picture, plan.route_m, BLUE)
        self._line(picture, flown, GREEN, 2)
        if self._flight.goal_m is not None:
            cv2.drawMarker(
                picture, tuple(self._px(self._flight.goal_m[None])[0].tolist()), ORANGE, cv2.MARKER_STAR, 15, 2
            )
        self._vehicle(picture, moment)
        if plan is not None:  # over the vehicle: a plan may be as short
            self._line(picture, plan.positions_m, ORANGE, 2)
        return picture

    def _vehicle(self, picture: Picture, moment: Moment) -> None:
        """Draw a triangle that points where the camera looks."""
        T = self._flight.T_world_map @ moment.T_map_imu @ self._flight.scenario.rig.cameras[0].T_imu_cam
        ahead = T[:2, 2] / np.linalg.norm(T[:2, 2])
        aside = np.array([-ahead[1], ahead[0]])
        tips = T[:2, 3] + np.array([0.5 * ahead, -0.3 * ahead + 0.3 * aside, -0.3 * ahead - 0.3 * aside])
        cv2.fillPoly(picture, [self._px(tips)], GREEN, cv2.LINE_8)

    def _captioned(self, picture: Picture, moment: Moment, corner: tuple[int, int]) -> Picture:
        """Return a picture with time, speed, map and the meaning of the colours below a corner."""
        canvas = Image.fromarray(picture)
        pen = ImageDraw.Draw(canvas)
        pen.fontmode = "1"  # without grey edges, which would take colours of the palette
        x, y = corner
        free_m3 = np.count_nonzero(moment.grid.states == FREE) * moment.grid.cell_m**3
        ink = (INK_GREY,) * 3
        pen.text((x, y), f"{1e-9 * moment.t_ns:4.1f} s     {moment.speed_m_s:.1f} m/s", ink, font(20))
        pen.text((x, y + 30), f"{free_m3:.0f} m³ known to be free", ink, font(20))
        legend = ((GREEN, "flown"), (ORANGE, "plan, goal"), (BLUE, "route"))
        for k, (colour, name) in enumerate(legend):
            left = x + (0, 82, 204)[k]
            pen.rectangle((left, y + 76, left + 14, y + 82), colour)
            pen.text((left + 20, y + 70), name, ink, font(14))
        for k, (grey, name) in enumerate(((FREE_GREY, "free"), (OCCUPIED_GREY, "occupied"), (UNKNOWN_GREY, "unknown"))):
            left = x + (0, 82, 204)[k]
            pen.rectangle((left, y + 98, left + 14, y + 110), (grey,) * 3, ink)
            pen.text((left + 20, y + 96), name, ink, font(14))
        return np.asarray(canvas)

    def _world(self, points_map: Array) -> Array:
        """Return points (N, 3) of the map in the world."""
        T = self._flight.T_world_map
        return np.asarray(points_map @ T[:3, :3].T + T[:3, 3])

    def _px(self, points: Array) -> npt.NDArray[np.int32]:
        """Return the pixels (N, 2) of points (N, 2 or 3) of the world."""
        u, v = ((points[:, :2] - self._low) * self._scale).T
        return np.asarray(np.rint(np.stack([u, self._size[1] - 1 - v], axis=1)), np.int32)

    def _line(self, picture: Picture, points: Array, colour: tuple[int, int, int], width_px: int) -> None:
        """Draw a polyline through points (N, 3) of the world."""
        cv2.polylines(picture, [self._px(points)], False, colour, width_px, cv2.LINE_8)

    def _dashed(self, picture: Picture, points: Array, colour: tuple[int, int, int]) -> None:
        """Draw a dashed polyline through points (N, 3) of the world."""
        along = np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))
        for begin in np.arange(0.0, along[-1], 0.4):
            s = np.array([begin, min(begin + 0.22, along[-1])])
            ends = np.stack([np.interp(s, along, points[:, k]) for k in range(3)], axis=1)
            self._line(picture, ends, colour, 2)


def write_gif(out: Path, pictures: list[Picture]) -> None:
    """Write pictures (H, W, 3) with one palette: the colours of the lines, and greys."""
    chosen = [GREEN, BLUE, ORANGE, *((grey,) * 3 for grey in np.linspace(0, 255, COLOURS - 3).astype(int).tolist())]
    palette = Image.new("P", (1, 1))
    palette.putpalette([value for colour in chosen for value in colour])
    frames = [Image.fromarray(each).quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    durations = [SHOWN_MS] * (len(frames) - 1) + [LAST_MS]
    frames[0].save(out, save_all=True, append_images=frames[1:], duration=durations, loop=0, optimize=False)


@dataclass(frozen=True)
class ExplorePicture:
    """What to fly, and where to write it."""

    out: Path = Path("docs/images/explore.gif")
    """GIF file to write; the figures are written beside it, with the suffix .json."""
    scenario: str = "office"
    """World or scenario that is explored."""
    seed: int = 2
    """Seed of world, goal and errors."""


def make(picture: ExplorePicture) -> None:
    """Fly, draw, and record the figures."""
    recorder = Recorder()
    flight = dv.explore(picture.scenario, seed=picture.seed, listeners=[recorder.depth], on_frame=recorder.frame)
    drawing = Drawing(flight, recorder.path)
    write_gif(picture.out, [drawing.picture(moment) for moment in recorder.moments])
    document = {
        "command": f"dronevio explore --scenario {picture.scenario} --seed {picture.seed}",
        "figures": asdict(flight.scores),
        "sha256": hashlib.sha256(picture.out.read_bytes()).hexdigest(),
    }
    text = json.dumps(document, indent=2)
    picture.out.with_suffix(".json").write_text(text + "\n", encoding="utf-8")
    print(text)
    print(f"{picture.out.name}: {len(recorder.moments)} frames, {picture.out.stat().st_size * 1e-6:.1f} MB")


if __name__ == "__main__":
    make(tyro.cli(ExplorePicture, description=__doc__))
