# %% [markdown]
# # Exploration: through a door that nobody has mapped
#
# This lesson follows section 7.4.3 of F. Dellaert and S. Hutchinson,
# *Introduction to Robotics and Perception*
# ([roboticsbook.org](https://www.roboticsbook.org)). It calls visual SLAM a
# superpower of autonomous drones, "allowing them to map their environment in
# real time and affording it to do obstacle avoidance and planning in hitherto
# unknown environments". Here a drone does so. It shall fly to a goal in an
# office of which it knows nothing, and the goal is in a room, behind a door.
# First it takes each step by hand, in front of that door: a depth image, what
# it says about the map, a path, and a trajectory. Then the same steps, ten
# depth images and five plans a second, fly it there.
#
# | symbol | meaning | unit |
# | --- | --- | --- |
# | $u$ | pixel of a depth image, $(u, v, 1)$ | px |
# | $K$ | intrinsic matrix of its camera | px |
# | $z$, $\sigma$ | depth of a pixel, and its standard deviation | m |
# | $l$ | log-odds that a cell of the map is occupied | – |
# | $p(t)$ | position of the trajectory at time $t$ | m |
# | $T$ | duration of the trajectory | s |

# %%
import dronevio as dv
import matplotlib.pyplot as plt
import numpy as np
from dronevio.models.occupancy import FREE, OCCUPIED, UNKNOWN
from dronevio.models.rotation import pose_matrix, rotation_z

WORLD, SEED = "office", 2
GOAL = np.array([-6.9, 0.55, 1.2])  # in the world [m]
CELL_M = 0.1

# %% [markdown]
# ## 1. A depth image
#
# A stereo pair measures the depth $z$ of a pixel from the disparity $d$ between
# both images: $z = f b / d$ with the focal length $f$ and the distance $b$
# between the cameras. An error $\sigma_d$ of the disparity is one of
# $\sigma = z^2 \sigma_d / (f b)$ of the depth: it grows with the square of the
# distance. `dronevio.estimator.mapping.depth_source.depth_source` computes such
# depth images from rendered pairs. That takes time. Here
# `dronevio.autonomy.ray_sensing.RayCameras` casts rays into the office instead,
# and adds the errors that stereo has.
#
# The drone has flown along the corridor, 1.2 m above the floor, and has turned
# toward the door. In this part of the lesson its poses are known.

# %%
from dronevio.autonomy.ray_sensing import (
    DriftingOdometry,
    RayCameras,
    RaySensing,
)
from dronevio.estimator.mapping.dense_mapper import DenseMapper
from dronevio.models.rotation import quat_wxyz_from_matrix

rig = dv.rig_named("euroc-stereo")
no_drift = RaySensing(drift_m_per_sqrt_m=0.0, yaw_drift_rad_per_sqrt_m=0.0)
cameras = RayCameras(WORLD, SEED, rig, SEED, no_drift)
odometry = DriftingOdometry(cameras, SEED, no_drift)
mapper = DenseMapper(rig, source=cameras)


def look(t_ns, x, y, heading_deg):
    """Return the depth image of a drone that hovers, and put it in the map."""
    R, p = rotation_z(np.radians(heading_deg)), np.array([x, y, 1.2])
    T = pose_matrix(R, p) @ rig.T_vehicle_imu
    quat_wxyz = quat_wxyz_from_matrix(T[:3, :3])
    still = dv.Trajectory(
        np.array([t_ns, t_ns + 1]),
        np.tile(T[:3, 3], (2, 1)),
        np.tile(quat_wxyz, (2, 1)),
        np.zeros((2, 3)),
    )
    frame = cameras.frame(t_ns, t_ns, True, still)
    return mapper.add_frame(frame, odometry.add_frame(frame))


HERE = np.array([-6.3, 3.2, 1.2])
way = [(x, HERE[1], -30.0) for x in np.arange(-8.5, HERE[0], 0.2)]
way += [(*HERE[:2], angle) for angle in np.arange(-30.0, -61.0, -6.0)]
depths = [look(100_000_000 * k, *pose) for k, pose in enumerate(way)]
depth = depths[-1]
near, far = depth.depth_m.min(), depth.depth_m.max()
print(f"{len(depths)} depth images of {depth.depth_m.shape[1]}", end=" × ")
print(f"{depth.depth_m.shape[0]} px")
print(f"the last one: depths from {near:.1f} m to {far:.1f} m")
for z in (1.0, 4.0):
    print(f"standard deviation at {z:.0f} m: {8.0 * z**2:.0f} mm")

# %% jupyter={"source_hidden": true}
# Figure: the office from above with the views, and the last depth image
from dronevio.autonomy.true_map import true_map
from dronevio.sim.world import flight_area, solid_space

solids = solid_space(WORLD, SEED)
office = true_map(solids)
pad = flight_area(WORLD, SEED).pad
PATH, PLAN, TRUE, SEEN = "#0072b2", "#d55e00", "0.25", "#009e73"


def draw_office(ax):
    """Draw what is solid at the height of the flight, the pad and the goal."""
    level = office.states[:, :, int(1.2 / office.cell_m)] == OCCUPIED
    low, high = office.low_m, office.high_m
    ax.imshow(
        np.where(level, 0.0, np.nan).T,
        extent=(low[0], high[0], low[1], high[1]),
        origin="lower",
        cmap="gray",
        alpha=0.35,
    )
    ax.plot(*pad[:2], "s", color=TRUE, label="pad")
    ax.plot(*GOAL[:2], "*", color=PLAN, markersize=11, label="goal")
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


figure, (ax, picture) = plt.subplots(
    1, 2, figsize=(9, 3.1), width_ratios=(1.15, 1), layout="constrained"
)
draw_office(ax)
for x, y, angle in way:
    direction = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    ax.quiver(x, y, *direction, color=SEEN, scale=18, width=0.004)
ax.set(xlim=(-10.0, -1.5), ylim=(-2.5, 4.6))
ax.legend(fontsize="small", loc="lower right", framealpha=1.0)
image = picture.imshow(depth.depth_m, cmap="turbo", vmin=0.0, vmax=8.0)
figure.colorbar(image, ax=picture, shrink=0.7, label="depth [m]")
picture.set_title("the last depth image", fontsize=9)
picture.axis("off")
plt.show()

# %% [markdown]
# The door stands open. Behind it, the rays end at the far wall of the room. The
# goal is not in sight: it is behind the wall beside the door.
#
# ## 2. Free, occupied, unknown
#
# The point of a pixel is $X = o + R \, z K^{-1} u$ for a camera at $o$ with the
# orientation $R$. It says that there is a surface at $X$, and as much about the
# way: all cells between $o$ and $X$ are free. About what lies behind $X$ it
# says nothing. This third state, *unknown*, is what distinguishes a map for
# flying from a point cloud: a cell without a point may be empty, or nobody has
# looked.
#
# Single measurements are wrong now and then. Each cell therefore holds the
# log-odds that it is occupied,
#
# $$l = \log \frac{P(\text{occupied})}{P(\text{free})},$$
#
# to which every ray adds a number: 1.5 in the cell of its end, and −0.4 in the
# cells before it (Moravec and Elfes, 1985; Hornung et al., 2013). The next cell
# does this with the row of the last depth image that is level with the camera.

# %%
from dronevio.models.occupancy import OccupancyGrid

HIT, MISS = 1.5, -0.4
RANGE_M = 4.0  # larger depths are not used
QUARTER_M = 0.25 * CELL_M

R, o = depth.T_odom_cam[:3, :3], depth.T_odom_cam[:3, 3]
row = depth.camera.height // 2
points = depth.camera.rays()[row] * depth.depth_m[row][:, None] @ R.T + o
cells = OccupancyGrid(
    np.array([-9.0, -2.0, 0.0]), CELL_M, np.zeros((70, 65, 1), np.uint8)
)
log_odds = np.zeros(cells.states.shape[:2])
for X, z in zip(points, depth.depth_m[row], strict=True):
    share = np.arange(0.0, min(1.0, RANGE_M / z), QUARTER_M / z)[:, None]
    passed = np.unique(cells.cells(o + share * (X - o))[:, :2], axis=0)
    end = cells.cells(X)[:2]
    passed = passed[np.any(passed != end, axis=1)]
    log_odds[tuple(passed.T)] += MISS
    if z < RANGE_M:
        log_odds[tuple(end)] += HIT
by_hand = np.where(log_odds > 0.0, OCCUPIED, FREE)
by_hand[log_odds == 0.0] = UNKNOWN
for name, state in (("free", FREE), ("occupied", OCCUPIED)):
    print(f"{np.count_nonzero(by_hand == state)} cells are {name}")

# %% [markdown]
# The map does the same with all pixels of all images, in three dimensions. It
# starts from the cells, not from the rays: a cell is free only if *all* pixels
# that it covers see past it, by 1.5 standard deviations, so that a chair leg
# between two rays does not get lost
# (`dronevio.estimator.mapping.evidence.evidence`).
# `dronevio.estimator.mapping.DenseMapper` has gathered this evidence on the way.

# %%
known = mapper.fused()
assert known is not None
x, y = np.meshgrid(np.arange(70), np.arange(65), indexing="ij")
centres = cells.centres(np.stack([x, y, np.zeros_like(x)], axis=-1))
centres[..., 2] = o[2]
states = known.at(centres)
both = (by_hand != UNKNOWN) & (states != UNKNOWN)
same = np.mean(by_hand[both] == states[both])
for name, state in (("free", FREE), ("occupied", OCCUPIED)):
    volume = CELL_M**3 * np.count_nonzero(known.states == state)
    print(f"{volume:.1f} m³ are {name}")
print(f"{same:.0%} of the cells by hand are the same in the map")
print("the goal is", ("unknown", "free", "occupied")[int(known.at(GOAL))])
assert same > 0.9, "the map differs from that by hand"
assert known.at(GOAL) == UNKNOWN, "the goal has been seen"

# %% jupyter={"source_hidden": true}
# Figure: what is free, occupied and unknown, by hand and in the map
from matplotlib.colors import ListedColormap

STATES = ListedColormap(["0.78", "white", "black"])  # unknown, free, occupied


def draw_states(ax, states, low, high, legend=False):
    """Draw states (X, Y) of cells between two corners."""
    ax.imshow(
        states.T,
        extent=(low[0], high[0], low[1], high[1]),
        origin="lower",
        cmap=STATES,
        vmin=0,
        vmax=2,
        interpolation="nearest",
    )
    ax.set_facecolor("0.78")
    ax.plot(*GOAL[:2], "*", color=PLAN, markersize=11)
    ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")


figure, axes = plt.subplots(
    1, 2, figsize=(9, 4.2), sharex=True, sharey=True, layout="constrained"
)
for ax, shown, title in zip(
    axes,
    (by_hand, states),
    ("by hand: one row of one image", f"map of {len(depths)} images"),
    strict=True,
):
    draw_states(ax, shown, cells.low_m, cells.high_m)
    ax.plot(*o[:2], "o", color=SEEN, markersize=5)
    ax.set_title(title, fontsize=9)
plt.show()

# %% [markdown]
# White is free, black is occupied, grey is unknown; the green dot is the drone,
# the star is the goal.
#
# ## 3. A path through what is not known
#
# The goal is in the grey. A path through known-free cells alone does not exist.
# The *free-space assumption* helps: all that is unknown counts as free until it
# is seen. The drone follows the shortest path under this assumption as far as
# it is known, sees more, and plans again. It arrives if there is a way, since
# each time that it does not, it has learnt of an obstacle (Koenig, Tovey and
# Smirnov, *Artificial Intelligence* 147, 2003).
#
# A cell is passable if no surface is nearer than the radius of the body, 0.45 m
# with its margins (`dronevio.autonomy.planning.body.Body`). A* expands the cell
# with the least sum of the cost so far and the distance to the goal, which is
# never more than the cost to come (Hart, Nilsson and Raphael, 1968). The next
# cell searches in the slice of the last figure.

# %%
import heapq
from scipy.ndimage import distance_transform_edt

RADIUS_M = 0.45
UNKNOWN_IS_FREE = True


def a_star(passable, start, goal):
    """Return the cells (N, 2) of the shortest path; None without one."""
    queue, cost = [(0.0, start)], {start: 0.0}
    before: dict[tuple[int, int], tuple[int, int]] = {}
    while queue:
        _, cell = heapq.heappop(queue)
        if cell == goal:
            path = [cell]
            while path[-1] != start:
                path.append(before[path[-1]])
            return np.array(path[::-1])
        for step in np.ndindex(3, 3):
            to = cell[0] + step[0] - 1, cell[1] + step[1] - 1
            inside = 0 <= to[0] < 70 and 0 <= to[1] < 65
            if not inside or not passable[to]:
                continue
            new = cost[cell] + np.hypot(to[0] - cell[0], to[1] - cell[1])
            if new < cost.get(to, np.inf) - 1e-9:
                cost[to], before[to] = new, cell
                rest = np.hypot(goal[0] - to[0], goal[1] - to[1])
                heapq.heappush(queue, (new + rest, to))
    return None


def from_cell(point):
    """Return the cell (i, j) of a point in the slice."""
    i, j, _ = cells.cells(point)
    return int(i), int(j)


is_blocked = states == OCCUPIED
if not UNKNOWN_IS_FREE:
    is_blocked |= states == UNKNOWN
passable = CELL_M * distance_transform_edt(~is_blocked) >= RADIUS_M
path_cells = a_star(passable, from_cell(HERE), from_cell(GOAL))
assert path_cells is not None, "there is no path to the goal"
by_hand_m = CELL_M * np.linalg.norm(np.diff(path_cells, axis=0), axis=1).sum()
seen = states[tuple(path_cells.T)] == FREE
print(
    f"path by hand {by_hand_m:.2f} m, {seen.mean():.0%} of its cells are free"
)

# %% [markdown]
# `dronevio.autonomy.planning.goal_path.path_to_goal` searches in three
# dimensions, and with a body that is a flat cylinder: a sphere would not fit
# below the lintel of the door. Steps between neighbouring cells have eight
# directions in the plane, which makes paths up to 8 % too long. It therefore
# replaces stretches of the path by straight lines where these are free.

# %%
from dronevio.autonomy.planning.body import Body
from dronevio.autonomy.planning.goal_path import path_to_goal
from dronevio.autonomy.planning.route import Route

body = Body(radius_m=RADIUS_M)
path = path_to_goal(known, HERE, GOAL, body, (0.5, 2.0), np.zeros((0, 3)))
assert isinstance(path, Route), "there is no path to the goal"
waypoints = path.waypoints
print(f"path_to_goal {path.length_m:.2f} m, {path.expansions} cells expanded")
assert path.length_m < by_hand_m, "the shortcuts make the path longer"


def through_door(waypoints):
    """Return whether a path passes the wall y = 2 m between its jambs."""
    along = np.linspace(0.0, len(waypoints) - 1.0, 1000)
    rows = np.arange(len(waypoints))
    x, y = (np.interp(along, rows, waypoints[:, k]) for k in (0, 1))
    crossing = x[np.argmax(y < 2.0)]
    return -5.5 < crossing < -4.3


assert through_door(waypoints), "the path does not lead through the door"

# %% [markdown]
# ## 4. A trajectory inside free boxes
#
# A path has corners, which no drone can fly. Its rotors push along one axis of
# its body, so that its acceleration follows from its attitude, the jerk from
# its angular rates, and the snap, the fourth derivative of the position, from
# the torques. Mellinger and Kumar (ICRA 2011) fly the trajectories with the
# least
#
# $$\int_0^T \Big|\frac{d^4 p}{dt^4}\Big|^2 dt .$$
#
# Without obstacles, the calculus of variations yields $p^{(8)} = 0$: a
# polynomial of degree 7. From rest at $a$ to rest at $b$, it is
#
# $$p(t) = a + (b - a)(35 \tau^4 - 84 \tau^5 + 70 \tau^6 - 20 \tau^7), \qquad
# \tau = t / T .$$
#
# Its largest speed is $\frac{35}{16} |b - a| / T$, and its largest acceleration
# $7.51 \, |b - a| / T^2$, so that the limits of the drone determine $T$.
# `dronevio.autonomy.planning.trajectory.corridor_trajectory` finds the same
# where its box is wide. It tries durations until a limit is reached, and
# stops within a few percent of the fastest.

# %%
from dronevio.autonomy.planning.corridor import Corridor
from dronevio.autonomy.planning.trajectory import corridor_trajectory
from dronevio.sim.paths.limits import Limits

limits = Limits(speed_m_s=2.0, accel_m_s2=3.0)
a, b = HERE, HERE + [3.0, 0.0, 0.0]
at_rest = np.vstack([a, np.zeros((3, 3))])  # velocity, acceleration, jerk
wide = Corridor((a - 9.0)[None], (b + 9.0)[None])
free = corridor_trajectory(wide, at_rest, b, limits)
assert free is not None
T_hand = max(35.0 / 16.0 * 3.0 / limits.speed_m_s, np.sqrt(7.51 * 3.0 / 3.0))
tau = np.linspace(0.0, 1.0, 101)
p_hand = 35.0 * tau**4 - 84.0 * tau**5 + 70.0 * tau**6 - 20.0 * tau**7
p_hand = a + p_hand[:, None] * (b - a)
apart = np.linalg.norm(free.path(tau * free.duration_s) - p_hand, axis=1)
print(f"duration by hand {T_hand:.2f} s, corridor_trajectory", end=" ")
print(f"{free.duration_s:.2f} s")
print(f"largest difference of the curves {1e3 * apart.max():.2f} mm")
assert T_hand < free.duration_s * 1.02 < 1.1 * T_hand, "durations differ"
assert apart.max() < 0.005, "the curves differ"

# %% [markdown]
# Between walls, the trajectory has to stay where the body has room. A *corridor*
# of overlapping boxes of free cells is laid around the path, and each piece of
# the trajectory is a Bézier curve whose control points are in one box. The
# curve is inside their convex hull, and therefore inside the box (Liu et al.,
# RA-L 2017, with polyhedra; Gao et al., 2019, with boxes). The squared snap is
# a quadratic function of the control points, and the boxes are linear bounds: a
# quadratic program (`dronevio.autonomy.planning.corridor.corridor_along`).
#
# Here the assumption of section 3 ends. The plan goes along the path only as
# far as it is *known* to be free, and is at rest there. If no other plan
# follows, the drone stops in front of what it has not seen.
# `dronevio.autonomy.planning.known_space.LocalSpace` tells where the body has
# room, with its radius to surfaces and 0.35 m to what is unknown.

# %%
from dataclasses import replace
from dronevio.autonomy.planning.corridor import corridor_along
from dronevio.autonomy.planning.known_space import LocalSpace
from dronevio.autonomy.planning.local_plan import sampled
from dronevio.autonomy.planning.route import route

PROPELLERS_M = 0.33  # they reach as far from the axis
KNOWN_SPACE_ONLY = True


def plan(grid):
    """Return corridor and trajectory along the path as far as a grid allows."""
    space = LocalSpace.of(grid, body, HERE)
    ahead = sampled(waypoints, HERE)
    is_clear = space.is_clear(body.radius_m)
    has_room = space.clearances(ahead) >= body.radius_m
    end = ahead[-1] if has_room.all() else ahead[np.argmin(has_room) - 1]
    way = route(
        space.grid, space.distance, HERE, end, clearance_m=body.radius_m
    )
    assert isinstance(way, Route)
    corridor = corridor_along(space.grid, is_clear, way.waypoints, 2.0)
    assert corridor is not None
    trajectory = corridor_trajectory(corridor, at_rest, end, limits)
    assert trajectory is not None, "no trajectory was found"
    return corridor, trajectory


def clearance_m(trajectory):
    """Return the distances of a trajectory to what is solid in truth."""
    t_s = np.linspace(0.0, trajectory.duration_s, 400)
    return solids.clearance(trajectory.path(t_s))


local_map = mapper.local_map
assert local_map is not None
is_unknown = local_map.states == UNKNOWN
trusting = replace(
    local_map,
    states=np.where(is_unknown, FREE, local_map.states).astype(np.uint8),
)
corridor, trajectory = plan(local_map)
trusting_corridor, trusting_trajectory = plan(trusting)
for name, each in (
    ("in known space", trajectory),
    ("trusting the assumption", trusting_trajectory),
):
    print(f"{name}: {each.duration_s:.2f} s, at least", end=" ")
    print(f"{clearance_m(each).min():.2f} m from solids")
flown = trajectory if KNOWN_SPACE_ONLY else trusting_trajectory
assert clearance_m(flown).min() > PROPELLERS_M, "the propellers touch"

# %% jupyter={"source_hidden": true}
# Figure: path, corridor and trajectory at the door, and speed and acceleration
from matplotlib.patches import Rectangle


def outline_solids(ax):
    """Outline what is solid in truth at the height of the flight."""
    is_solid = office.states[:, :, int(1.2 / office.cell_m)] == OCCUPIED
    i, j = (np.arange(count) + 0.5 for count in is_solid.shape)
    x, y = (office.low_m[k] + office.cell_m * n for k, n in ((0, i), (1, j)))
    ax.contour(x, y, is_solid.T, levels=[0.5], colors="#cc0000", linewidths=0.8)


figure, (ax, over_time) = plt.subplots(
    1, 2, figsize=(9, 3.9), width_ratios=(1.2, 1), layout="constrained"
)
draw_states(ax, states, cells.low_m, cells.high_m)
ax.plot(*waypoints[:, :2].T, "--", color=PATH, label="path")
for low, high in zip(corridor.low_m, corridor.high_m, strict=True):
    ax.add_patch(
        Rectangle(low[:2], *(high - low)[:2], fc=SEEN, alpha=0.12, ec="none")
    )
    ax.add_patch(Rectangle(low[:2], *(high - low)[:2], fc="none", ec=SEEN))
for each, style, label in (
    (trusting_trajectory, ":", "trusting plan"),
    (trajectory, "-", "plan"),
):
    line = each.path(np.linspace(0.0, each.duration_s, 200))[:, :2].T
    ax.plot(*line, style, color=PLAN, linewidth=2, label=label)
outline_solids(ax)
ax.set(xlim=(-8.0, -3.4), ylim=(-1.0, 4.2))
ax.legend(fontsize="small", loc="lower right")
t_s = np.linspace(0.0, trajectory.duration_s, 400)
for order, limit, colour, label in (
    (1, limits.speed_m_s, PATH, "speed [m/s]"),
    (2, limits.accel_m_s2, PLAN, "acceleration [m/s²]"),
):
    size = np.linalg.norm(trajectory.path.derivative(order)(t_s), axis=1)
    over_time.plot(t_s, size, color=colour, label=label)
    over_time.axhline(limit, color=colour, linestyle="--", linewidth=1)
over_time.set(xlabel="time [s]", ylim=(0.0, 3.4))
over_time.grid(alpha=0.3)
over_time.legend(fontsize="small", loc="lower right")
plt.show()

# %% [markdown]
# On the left are the known states with the corridor, and in red what is solid
# in truth. Behind the wall beside the door, where the drone has not seen it,
# stands a cabinet. A plan that trusts the assumption as far as the goal cuts
# its corner: it would hit it with a propeller. The plan in known space ends
# inside the door, from where the cabinet is in sight.
#
# On the right, neither speed nor acceleration exceeds its limit. The plan is
# short and at rest at its end, so that it stays far below the limit of the
# speed: in unknown space, a drone is as fast as it sees far.
#
# ## 5. The flight
#
# `dronevio.explore` repeats these steps from the take-off on. Ten times a
# second a depth image enters the map; once a second, and whenever an obstacle
# appears on it, the path is sought anew; five times a second a plan replaces
# the last one, from the state in which the drone will be when the plan is
# ready. A controller flies it, in a simulation with forces and collisions. The
# drone does not know its pose: the odometry drifts, by 4 mm after one metre and
# with the square root of the path. Without images
# (`dronevio.autonomy.ray_sensing.RaySensing`), the flight takes some ten
# seconds; with rendered stereo and visual SLAM, the same call without
# `without_images`, it takes a minute or two.

# %%
DRIFT_M = 0.004  # after one metre

moments: list[tuple[int, OccupancyGrid]] = []


def keep(depth, estimate, pilot):
    """Keep a slice of the map twice a second."""
    if not moments or depth.t_ns >= moments[-1][0] + 500_000_000:
        grid = pilot.mapper.fused()
        moments.append((depth.t_ns, grid))


flight = dv.explore(
    WORLD,
    goal=GOAL.tolist(),
    seed=SEED,
    without_images=RaySensing(drift_m_per_sqrt_m=DRIFT_M),
    listeners=[keep],
)
scores = flight.scores
assert scores.ate_m is not None and scores.distance_to_goal_m is not None
print(f"{scores.outcome} after {scores.time_s:.1f} s")
print(f"{len(flight.plans)} plans, median speed", end=" ")
print(f"{scores.median_speed_m_s:.1f} m/s")
print(f"path {scores.path_m:.1f} m; the shortest one of all", end=" ")
print(f"{scores.shortest_m:.1f} m")
print(f"distance to the goal {scores.distance_to_goal_m:.2f} m", end=", ")
print(f"ATE {1e3 * scores.ate_m:.0f} mm")
assert scores.outcome == "reached", "the drone has not reached the goal"
assert scores.distance_to_goal_m < 0.5, "it believes that it is at the goal"

# %% jupyter={"source_hidden": true}
# Figure: the map at three times of the flight with path, plan and true position
from dronevio.models.rotation import inverse_pose

plan_ns = np.array([p.t_ns + flight.waited_ns for p in flight.plans])
truth = flight.flight.truth
T_map_world = inverse_pose(flight.T_world_map)


def map_slice(grid):
    """Return the states of the slice of a map at the height of the flight."""
    points = centres @ T_map_world[:3, :3].T + T_map_world[:3, 3]
    return grid.at(points)


figure, axes = plt.subplots(
    1, 3, figsize=(9, 3.6), sharex=True, sharey=True, layout="constrained"
)
x, y = np.meshgrid(np.arange(86), np.arange(75), indexing="ij")
low, high = np.array([-10.0, -2.9]), np.array([-1.4, 4.6])
centres = np.stack(
    [
        low[0] + CELL_M * (x + 0.5),
        low[1] + CELL_M * (y + 0.5),
        np.full(x.shape, 1.2),
    ],
    axis=-1,
)
for ax, at_ns in zip(
    axes,
    (plan_ns[0], 0.55 * plan_ns[0] + 0.45 * plan_ns[-1], plan_ns[-1]),
    strict=True,
):
    t_ns, grid = min(moments, key=lambda moment: abs(moment[0] - at_ns))
    p = flight.plans[max(int(np.searchsorted(plan_ns, t_ns)) - 1, 0)]
    draw_states(ax, map_slice(grid), low, high)
    outline_solids(ax)
    ax.plot(*p.route_m[:, :2].T, "--", color=PATH, label="path")
    ax.plot(*p.positions_m[:, :2].T, color=PLAN, linewidth=2, label="plan")
    so_far = truth.p_world_imu[truth.t_ns <= t_ns]
    ax.plot(*so_far[:, :2].T, color=SEEN, label="flown")
    ax.plot(*so_far[-1, :2], "o", color=SEEN, markersize=5)
    ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    ax.set_title(f"{1e-9 * (t_ns - truth.t_ns[0]):.1f} s", fontsize=9)
    ax.label_outer()
axes[0].legend(fontsize="small", loc="lower right")
plt.show()

# %% [markdown]
# At the start, the shortest path leads around the end of the wall that is in
# sight, and straight on to the goal: the long side of the wall has not been
# seen. The path moves along it as more of it becomes known, until it leads
# through the door. The cabinet enters the map before the drone comes near, and
# the path bends around it. What the drone has never needed to see is still
# grey.
#
# The drone has flown a tenth farther than the shortest path in a known office.
# That is the price of not knowing: small here, and large in a maze that is made
# to mislead, for which Koenig, Tovey and Smirnov bound it.
#
# This ends the chapter: seeing, estimating, mapping, planning and flying, in
# one loop. `dronevio explore` does it with images, and writes a report.
#
# ## Exercises
#
# **1. How fast?** A depth image is used up to 4 m, and a plan is flown 0.2 s
# after it. From which speed can the drone still stop before what it has just
# seen, if its body reaches 0.45 m ahead? Compare $v^2 / 2a$ with the end of
# `dronevio.autonomy.planning.local_plan.braking`, at 3 m/s². Give it a limit of
# the speed above $v$, such as 5 m/s: from its limit on, it brakes twice as hard.
#
# <details markdown="1"><summary>Answer</summary>
#
# With constant deceleration, $0.2 v + v^2 / 6 = 3.55$ m holds for 4.0 m/s. A
# drone cannot jump from no to full deceleration, since it has to tilt first.
# The trajectory of minimum snap from 2 m/s ends after 1.3 m, from 3 m/s after
# 2.8 m, and from 4 m/s after 5.1 m. With the latency, 3 m/s are the limit.
#
# </details>
#
# **2. How wide?** The door is 1.2 m wide. For which radii does the path of
# section 3 lead through it? Where is the rest of the 1.2 m?
#
# <details markdown="1"><summary>Answer</summary>
#
# Up to 0.5 m: the change of `RADIUS_M` below is the first that fails. A cell is
# occupied as a whole where the wall reaches into it, and distances are measured
# between the centres of cells, of 0.1 m. Each jamb may cost a cell. Smaller
# cells cost time: half their side is eight times their number.
#
# </details>
#
# **3. How often?** Fly with one plan a second, and then with depths up to 2 m,
# by `settings=` of `dronevio.explore` with
# `ExploreSettings(plan_rate_hz=1.0)` and
# `ExploreSettings(map=dv.DenseMapConfig(range_m=2.0))`
# (`dronevio.autonomy.settings.ExploreSettings`). Which of the two costs more
# time, and why?
#
# <details markdown="1"><summary>Answer</summary>
#
# With one plan a second, the flight takes 32 s instead of 23 s. Each plan ends
# at rest at the end of what was known when it was made, so that the drone
# nearly stops before it receives the next one. With 2 m it still takes 23 s: the
# median speed falls from 1.25 m/s to 1.17 m/s, but take-off and turns take most
# of the time. In a forest the range would count more.
#
# </details>
#
# ## What to change to see it break
#
# Each of these changes makes a check of the lesson fail with an
# `AssertionError`.
#
# **Nothing on trust.** In section 3, let the path lead through known space
# only. Nobody has seen the goal, and there is no path to it.
#
# ```python
# UNKNOWN_IS_FREE = False
# ```
#
# **A wider body.** In section 3, with a radius of 0.55 m, the door is too
# narrow for the cells of the map. The path looks for another way where nothing
# has been seen yet.
#
# ```python
# RADIUS_M = 0.55
# ```
#
# **Too much on trust.** In section 4, plan to the goal as if all were known. The
# trajectory meets the cabinet, which nobody has seen.
#
# ```python
# KNOWN_SPACE_ONLY = False
# ```
#
# **A poor odometry.** In section 5, let it drift 25 times as fast. The local map
# drifts with it, so that the drone still does not hit anything. But it stops
# beside the goal, and believes that it is there. This is what the loops of the
# lesson `slam` are for.
#
# ```python
# DRIFT_M = 0.1
# ```
