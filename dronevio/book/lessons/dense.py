# %% [markdown]
# # From points to surfaces: multi-view stereo
#
# The structure from motion of section 7.4.2 of F. Dellaert and S. Hutchinson,
# *Introduction to Robotics and Perception*
# ([roboticsbook.org](https://www.roboticsbook.org)), ends with accurate cameras
# and a sparse point cloud. The chapter mentions that multi-view stereo makes it
# dense, and leaves this out. The lesson fills the gap: it computes the depth of
# nearly every pixel, keeps the depths on which several images agree, and fuses
# them into a point cloud and a mesh. The methods are those of Furukawa and
# Hernández, *Multi-View Stereo: A Tutorial*, 2015.
#
# | symbol | meaning | unit |
# | --- | --- | --- |
# | $u$, $u'$ | pixel of the reference image and of a neighbouring image, $(u, v, 1)$ | px |
# | $K$, $K'$ | intrinsic matrices of both | px |
# | $R$, $t$ | rotation and translation from the reference camera to the neighbour | –, arbitrary |
# | $w$ | inverse depth of a pixel, $1/z$ | arbitrary |
# | $C(u, w)$ | cost of an inverse depth, 0 (equal) to 1 | – |
#
# The unit of length is arbitrary, as in the lesson `sfm`.

# %%
from dataclasses import replace

import dronevio as dv
import matplotlib.pyplot as plt
import numpy as np

# %% [markdown]
# ## 1. Cameras
#
# The lesson `sfm` reconstructs the cameras step by step; here one call does.
# `dronevio.estimator.dense.views.ViewLoader` removes the distortion of the
# lens, so that all cameras are pinhole cameras. The neighbours of an image are
# those with many common points and an angle of some degrees between the rays
# (`dronevio.estimator.dense.neighbours.select_neighbours`): a smaller angle
# gives inaccurate depths, a larger one images that look too different to be
# compared.
# %%
from dronevio.estimator.book.sfm import photograph_folder
from dronevio.estimator.dense.config import DenseConfig, ViewConfig
from dronevio.estimator.dense.neighbours import select_neighbours
from dronevio.estimator.dense.views import ViewLoader
from dronevio.models.image_sets import open_images
from dronevio.models.rotation import exp_so3
from scipy.ndimage import map_coordinates

REFERENCE = 2
ROTATION_ERROR_DEG = 0.0

images = open_images(photograph_folder())
[reconstruction] = dv.sfm(images).reconstructions
poses = reconstruction.Ts_world_cam.copy()
R_error = exp_so3(np.radians([ROTATION_ERROR_DEG, 0.0, 0.0]))
poses[REFERENCE, :3, :3] = poses[REFERENCE, :3, :3] @ R_error
reconstruction = replace(reconstruction, Ts_world_cam=poses)

load = ViewLoader(images, reconstruction, ViewConfig())
neighbours = select_neighbours(reconstruction, ViewConfig())
view = load(REFERENCE)
sources = [load(int(j)) for j in neighbours[REFERENCE]]
print(
    f"{len(load)} undistorted images of {view.grey.shape[1]} × {view.grey.shape[0]} px"
)
print(
    f"image {REFERENCE} is compared with images {neighbours[REFERENCE].tolist()}"
)

# %% [markdown]
# ## 2. The cost of a depth
#
# If the pixel $u$ had the inverse depth $w$, its point would appear in the
# neighbouring image at
#
# $$u' \sim K' \, (R \, K^{-1} u + w \, t),$$
#
# where $\sim$ means equal up to a factor. The right inverse depth is the one at
# which both images look the same. Single pixels are ambiguous, so that windows
# are compared, by the zero-mean normalized cross-correlation of their grey
# values $a_i$, $b_i$,
#
# $$\text{ZNCC} = \frac{\sum_i (a_i - \bar a)(b_i - \bar b)}
# {\sqrt{\sum_i (a_i - \bar a)^2 \sum_i (b_i - \bar b)^2}},$$
#
# which does not depend on brightness and contrast. The cost is
# $C = 1 - \text{ZNCC}$, the mean of the two neighbours that match best; in the
# others the point may be occluded. The next cell computes it for two pixels:
# one on the façade, at a point of the reconstruction, and one on the water.

# %%
WINDOW_PX = 7


def correlations(u, v, inverse_depths):
    """Return the ZNCC of the windows around a pixel, for each inverse depth."""
    half = WINDOW_PX // 2
    rows, columns = np.mgrid[v - half : v + half + 1, u - half : u + half + 1]
    rays = np.linalg.inv(view.camera.K) @ [
        columns.ravel(),
        rows.ravel(),
        np.ones(WINDOW_PX**2),
    ]
    a = view.grey[rows, columns].ravel().astype(float)
    a -= a.mean()
    means = []
    for w in inverse_depths:
        scores = []
        for source in sources:
            T = np.linalg.inv(source.T_world_cam) @ view.T_world_cam
            x, y, z = source.camera.K @ (T[:3, :3] @ rays + w * T[:3, 3:])
            b = map_coordinates(
                source.grey, [y / z, x / z], order=1, mode="nearest"
            )
            b = b - b.mean()
            scores.append(a @ b / np.sqrt((a @ a + 1e-9) * (b @ b + 1e-9)))
        means.append(np.mean(sorted(scores)[-2:]))
    return np.array(means)


in_camera = (
    reconstruction.points - view.T_world_cam[:3, 3]
) @ view.T_world_cam[:3, :3]
projected = in_camera @ view.camera.K.T
projected = projected[:, :2] / projected[:, 2:]
is_seen = np.isin(
    np.arange(len(in_camera)),
    reconstruction.observation_point[
        reconstruction.observation_image == REFERENCE
    ],
)
is_seen &= (np.abs(projected - [330, 200]) < [200, 120]).all(axis=1)
often = np.where(is_seen, reconstruction.track_lengths(), 0)
point = int(np.argmax(often))
facade = np.rint(projected[point]).astype(int)
water = np.array([330, 400])
depths = in_camera[is_seen, 2]
inverse_depths = np.linspace(
    0.3 / np.median(depths), 2.0 / np.median(depths), 160
)
curves = [correlations(u, v, inverse_depths) for u, v in (facade, water)]

true_w, best_w = 1.0 / in_camera[point, 2], inverse_depths[curves[0].argmax()]
print(
    f"inverse depth of the point {true_w:.3f}, best correlation at {best_w:.3f}"
)
assert abs(best_w / true_w - 1.0) < 0.05, "the best correlation is elsewhere"

# %% jupyter={"source_hidden": true}
# Figure: correlation over the inverse depth, for the façade and the water
figure, (ax, picture) = plt.subplots(
    1, 2, figsize=(9, 3.2), layout="constrained"
)
for curve, name, colour in zip(
    curves, ("façade", "water"), ("#d55e00", "#0072b2"), strict=True
):
    ax.plot(inverse_depths, curve, color=colour, label=name)
ax.axvline(true_w, color="#009e73", label="structure from motion")
ax.set(xlabel="inverse depth w", ylabel="ZNCC", ylim=(-1, 1))
ax.grid(alpha=0.3)
ax.legend()
picture.imshow(view.colours)
for (u, v), colour in zip((facade, water), ("#d55e00", "#0072b2"), strict=True):
    picture.plot(
        u,
        v,
        "s",
        color=colour,
        markerfacecolor="none",
        markersize=9,
        markeredgewidth=2,
    )
picture.axis("off")
plt.show()

# %% [markdown]
# On the façade the correlation has one clear maximum, at the depth of the point
# from structure from motion. On the water it has none: the waves have moved
# between the photographs. No method can find a depth there; a good one notices.
#
# `dronevio.estimator.dense.sweep.sweep` computes the costs of all pixels and
# inverse depths. A constant inverse depth is a plane parallel to the image,
# hence the name plane sweep; and the warp of a whole image by a plane is a
# homography, which is fast.
#
# ## 3. Semi-global matching
#
# The best depth of each pixel alone is noisy. Surfaces are mostly smooth, which
# semi-global matching (Hirschmüller, PAMI 2008) expresses by an energy over all
# pixels,
#
# $$E(w) = \sum_u C(u, w_u) + \sum_{u, u_2} P(w_u, w_{u_2}),$$
#
# where the second sum is over neighbouring pixels $u$, $u_2$, and the penalty
# $P$ is 0 for equal depths, $P_1$ for a difference of one step, and $P_2$ for
# more. The minimum over an image is too expensive, but along a line dynamic
# programming finds it: the cost of reaching the depth step $d$ at a pixel is
#
# $$\begin{split}
# L(u, d) = C(u, d) + \min \big( & L(u - 1, d), \; L(u - 1, d \pm 1) + P_1, \\
# & \min_i L(u - 1, i) + P_2 \big) .
# \end{split}$$
#
# `dronevio.estimator.dense.sgm.aggregate` adds these costs for lines from eight
# directions. The next cell sweeps planes over images of half the resolution,
# and takes the best depth of each pixel before and after the aggregation.

# %%
from dronevio.estimator.dense.config import DepthConfig
from dronevio.estimator.dense.sgm import aggregate
from dronevio.estimator.dense.sweep import SCALE, Warp, sweep

config = DepthConfig(window_px=WINDOW_PX)
small = view.halved()
warps = [Warp(small, source.halved()) for source in sources]
planes = np.linspace(0.5, 1.6, 64, dtype=np.float32) / np.float32(
    np.median(depths)
)
costs = sweep(small, warps, None, None, planes, WINDOW_PX, config.best_views)
P_1, P_2 = SCALE * config.small_penalty, SCALE * config.large_penalty
total = aggregate(costs, small.grey, P_1, P_2)
rough, smooth = planes[costs.argmin(axis=1)], planes[total.argmin(axis=1)]

# %% jupyter={"source_hidden": true}
# Figure: the image, depths of single pixels, and those of semi-global matching
figure, axes = plt.subplots(1, 3, figsize=(9, 2.3), layout="constrained")
axes[0].imshow(small.colours)
for ax, w, title in zip(
    axes[1:], (rough, smooth), ("pixels alone", "aggregated"), strict=True
):
    ax.imshow(w, cmap="turbo", vmin=planes[0], vmax=planes[-1])
    ax.set_title(f"inverse depth: {title}", fontsize=9)
for ax in axes:
    ax.axis("off")
plt.show()

# %% [markdown]
# `dronevio.estimator.dense.depth.estimate_depth` repeats this on images of
# increasing resolution: each one searches a few depths around the result of the
# one before. It also sweeps planes along the large surfaces of the scene
# (`dronevio.estimator.dense.directions.dominant_normals`), for which windows on
# a slanted roof look alike in both images.
#
# The points of structure from motion are a test that is independent of the
# window and the penalties. They are computed from the positions of features
# alone.

# %%
from dronevio.estimator.dense.depth import estimate_depth
from dronevio.estimator.dense.directions import dominant_normals
from dronevio.estimator.dense.neighbours import observed_points

normals = dominant_normals(reconstruction.points, config.directions)
known_points = observed_points(reconstruction, REFERENCE)
depth_map = estimate_depth(view, sources, known_points, normals, config)

u, v = np.rint(projected[is_seen]).astype(int).T
deviation = np.abs(depth_map.inverse_depth[v, u] * in_camera[is_seen, 2] - 1.0)
good = np.mean(deviation < 0.02)
print(f"median difference from the sparse points {np.median(deviation):.2%}")
print(f"{good:.0%} of the points differ by less than 2 %")
assert good > 0.8, "the depths differ from those of the sparse points"

# %% [markdown]
# ## 4. Consistency
#
# A wrong depth in one image is hardly ever confirmed by another. A depth is
# kept if the depth maps of at least two other images agree: its point is
# projected into the other image, the point of the other depth map at that pixel
# is projected back, and has to return within one pixel and 1 % of the depth.
# The depths that agree are averaged.
# `dronevio.estimator.dense.consistency.consistent_depth` implements this;
# `dronevio.estimator.dense.pipeline.estimate_depths` and
# `dronevio.estimator.dense.pipeline.filter_depths` apply both steps to all
# images.

# %%
from dronevio.estimator.dense.pipeline import estimate_depths, filter_depths

settings = DenseConfig(depth=config)
maps = estimate_depths(load, reconstruction, neighbours, settings)
consistent = filter_depths(maps, neighbours, settings)
for i, (one, other) in enumerate(zip(maps, consistent, strict=True)):
    before, after = (np.mean(each.inverse_depth > 0.0) for each in (one, other))
    print(
        f"image {i}: {before:.0%} of the pixels correlate, {after:.0%} are left"
    )

# %% jupyter={"source_hidden": true}
# Figure: the image, its depths before and after the test of consistency
figure, axes = plt.subplots(1, 3, figsize=(9, 2.3), layout="constrained")
axes[0].imshow(view.colours)
for ax, chosen, title in zip(
    axes[1:], (maps, consistent), ("correlated", "confirmed"), strict=True
):
    w = chosen[REFERENCE].inverse_depth
    ax.imshow(
        np.where(w > 0.0, w, np.nan),
        cmap="turbo",
        vmin=planes[0],
        vmax=planes[-1],
    )
    ax.set_title(title, fontsize=9)
for ax in axes:
    ax.axis("off")
plt.show()

# %% [markdown]
# ## 5. Fusion
#
# All depth maps together contain each part of the surface several times.
# `dronevio.estimator.dense.fusion.fuse` averages the points in each voxel of
# the size of a pixel. An inverse depth has the weight $w^2$, because the error
# of a depth grows with its distance. To look at the cloud, the next cell
# projects it into cameras that took no photograph: from the left and from
# above.

# %%
from dronevio.estimator.dense.fusion import fuse
from dronevio.estimator.dense.meshing.tsdf import pixel_size

coloured = ((one, load(i).colours) for i, one in enumerate(consistent))
cloud = fuse(coloured, spacing=pixel_size(consistent))
print(f"{len(cloud)} points, {len(reconstruction.points)} in the sparse cloud")

target = np.median(cloud.points, axis=0)


def picture_from(T_view_cam, points, colours, size=2):
    """Return the image of points from a camera, near ones in front."""
    T = view.T_world_cam @ T_view_cam
    p = (points - T[:3, 3]) @ T[:3, :3]
    p, colours = p[p[:, 2] > 0.1], colours[p[:, 2] > 0.1]
    order = np.argsort(-p[:, 2])
    x, y, z = view.camera.K @ p[order].T
    image = np.full((view.camera.height, view.camera.width, 3), 255, np.uint8)
    for dx in range(size):
        for dy in range(size):
            u, v = (
                np.rint(x / z).astype(int) + dx,
                np.rint(y / z).astype(int) + dy,
            )
            inside = (
                (u >= 0)
                & (v >= 0)
                & (u < image.shape[1])
                & (v < image.shape[0])
            )
            image[v[inside], u[inside]] = colours[order][inside]
    return image


def orbit(yaw_deg, pitch_deg):
    """Return the pose of a camera that orbits the centre of the cloud."""
    centre = (target - view.T_world_cam[:3, 3]) @ view.T_world_cam[:3, :3]
    T = np.eye(4)
    T[:3, :3] = exp_so3(np.radians([0.0, yaw_deg, 0.0])) @ exp_so3(
        np.radians([pitch_deg, 0.0, 0.0])
    )
    T[:3, 3] = centre - T[:3, :3] @ centre
    return T


# %% jupyter={"source_hidden": true}
# Figure: the point cloud from the left and from above
figure, axes = plt.subplots(1, 2, figsize=(9, 3.1), layout="constrained")
for ax, angles, title in zip(
    axes,
    ((35.0, 0.0), (0.0, -30.0)),
    ("from the left", "from above"),
    strict=True,
):
    ax.imshow(picture_from(orbit(*angles), cloud.points, cloud.colours))
    ax.set_title(title, fontsize=9)
    ax.axis("off")
plt.show()

# %% [markdown]
# ## 6. A mesh
#
# A point cloud has no inside and outside. The truncated signed distance
# function (Curless and Levoy, SIGGRAPH 1996) has: for each voxel with the depth
# $z_i$ in image $i$, whose depth map has $1/w_i$ at the same pixel,
#
# $$D = \frac{\sum_i w_i^2 \, \text{clip}\big((1/w_i - z_i) / \tau, \, -1, \, 1\big)}{\sum_i w_i^2}$$
#
# is positive in front of the surface and negative behind it, with the
# truncation distance $\tau$. The surface is where $D = 0$; voxels behind by
# more than $\tau$ are not updated. `dronevio.estimator.dense.meshing.tsdf.integrate`
# computes the function in blocks near the surface,
# `dronevio.estimator.dense.meshing.surface_nets.surface_nets` its zero level, and
# `dronevio.estimator.dense.meshing.mesh.build_mesh` the mesh with colours.

# %%
from dronevio.estimator.dense.config import MeshConfig
from dronevio.estimator.dense.meshing.mesh import build_mesh
from dronevio.estimator.dense.meshing.tsdf import integrate

volume = integrate(consistent, MeshConfig())
mesh = build_mesh(volume, cloud, MeshConfig().min_triangles)
print(f"{len(mesh.vertices)} vertices, {len(mesh.triangles)} triangles")

# %% jupyter={"source_hidden": true}
# Figure: the mesh in its colours and shaded by its normals
light = view.T_world_cam[:3, :3] @ np.array([0.4, -0.6, -0.7])
shade = np.clip(mesh.normals @ light, 0.1, 1.0)[:, None] * 255.0
figure, axes = plt.subplots(1, 2, figsize=(9, 3.1), layout="constrained")
for ax, colours, title in zip(
    axes,
    (mesh.colours, np.tile(shade, 3).astype(np.uint8)),
    ("colours", "shaded"),
    strict=True,
):
    ax.imshow(picture_from(orbit(20.0, -10.0), mesh.vertices, colours, size=3))
    ax.set_title(title, fontsize=9)
    ax.axis("off")
plt.show()

# %% [markdown]
# ## Exercises
#
# **1. The window.** Repeat section 3 with `WINDOW_PX = 3` and `WINDOW_PX = 15`.
# How do the share of good depths and the edges of the depth map change?
#
# <details markdown="1"><summary>Answer</summary>
#
# With 3 px the edges are sharper, but the plain walls between the windows are
# missing: a small window has too little texture. With 15 px the towers become
# wider and edges round, since a window that contains two surfaces has no right
# depth. The share of good depths decreases by some percent, and the number of
# points in the cloud decreases in both cases.
#
# </details>
#
# **2. Confirmation.** In section 4, set
# `consistency=ConsistencyConfig(min_views=1)`, and then 3. How many pixels
# remain, and what does the cloud look like?
#
# <details markdown="1"><summary>Answer</summary>
#
# The class is `dronevio.estimator.dense.config.ConsistencyConfig`. With one
# other image there are half as many points again, among them wrong ones on the
# water and in the sky, since two images agree by chance now and then. With
# three, a third of the points is lost: the cloud is clean, but trees and rock
# have holes where only two other images see them.
#
# </details>
#
# **3. Depth and inverse depth.** Why are the steps of a sweep equal in inverse
# depth, and not in depth?
#
# <details markdown="1"><summary>Answer</summary>
#
# The equation of section 2 is linear in $w$ before the division. If the cameras
# move sideways, the third coordinate does not depend on $w$, and equal steps of
# $w$ are equal steps of $u'$ in pixels. Equal steps in depth would be too
# coarse near the camera, and too fine far from it.
#
# </details>
#
# ## What to change to see it break
#
# Each of these changes makes a check of the lesson fail with an
# `AssertionError`.
#
# **A wrong pose.** In section 1, rotate the reference camera by half a degree.
# This moves its image by 5 px, mostly across the epipolar lines, so that no
# depth brings the images together: less than half of the depths are good.
#
# ```python
# ROTATION_ERROR_DEG = 0.5
# ```
#
# **No context.** In section 2, compare windows of a single pixel. Its zero-mean
# value is zero, and correlates with nothing.
#
# ```python
# WINDOW_PX = 1
# ```
