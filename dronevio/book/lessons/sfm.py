# %% [markdown]
# # Structure from motion, step by step
#
# This lesson follows section 7.4.2 of F. Dellaert and S. Hutchinson,
# *Introduction to Robotics and Perception*
# ([roboticsbook.org](https://www.roboticsbook.org)). The chapter adjusts a
# reconstruction of Villa Balbianello that another program has made, and names
# three difficult problems that come before: the detection of features, the
# association of data, and the initialization of the optimization. The lesson
# solves them, from the five photographs alone, with the functions that
# `dronevio sfm` consists of. In the end it returns to the experiment of the
# chapter.
#
# | symbol | meaning | unit |
# | --- | --- | --- |
# | $T_i = (R_i, c_i)$ | pose of camera $i$: orientation (camera to world) and position | –, arbitrary |
# | $p_j$ | position of point $j$ in the world frame | arbitrary |
# | $u_{ij}$ | observation of point $j$ in image $i$ | px |
# | $f$, $k_1$, $k_2$ | focal length and radial distortion | px, –, – |
# | $r$ | ray of a pixel, a unit vector in the camera frame | – |
#
# The camera frame has x right, y down and z forward. The unit of lengths is
# arbitrary, because a larger scene that is farther away gives the same images.
#
# A point $p$ with the coordinates $(x, y, z) = R_i^\top (p - c_i)$ in the frame
# of camera $i$ is projected to the pixel
#
# $$\begin{split}
# \pi_i(p) &= f \, (1 + k_1 \rho^2 + k_2 \rho^4) \, \Big(\frac{x}{z}, \frac{y}{z}\Big) + (c_x, c_y) \\
# \rho^2 &= \frac{x^2 + y^2}{z^2}
# \end{split}$$
#
# The class `dronevio.models.CameraModel` contains this projection and its
# inverse, for this and for other lenses.

# %%
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np

# %% [markdown]
# ## 1. The photographs
#
# `dronevio.models.image_sets.open_images` reads a folder of photographs, a
# video or a recording. These photographs contain no focal length, so that the
# camera model is a guess: a lens of average angle without distortion. All five
# are assumed to come from one camera. To use photographs of your own, change
# the folder.
# %%
from dronevio.estimator.book.sfm import photograph_folder
from dronevio.models.image_sets import open_images
from dronevio.models.rotation import skew
from matplotlib.patches import Circle

images = open_images(photograph_folder())
camera = images.cameras[0]
count = len(images.names)
print(f"{count} images of {camera.width} × {camera.height} px")
print(f"focal length {camera.fx:.0f} px ({images.focal_source[0]})")

# %% jupyter={"source_hidden": true}
# Figure: the five photographs of the villa on its rock
figure, axes = plt.subplots(1, count, figsize=(9, 1.5), layout="constrained")
for i, ax in enumerate(axes):
    ax.imshow(images.read(i))
    ax.set_title(f"image {i}", fontsize=9)
    ax.axis("off")
plt.show()

# %% [markdown]
# ## 2. Features
#
# A feature is a position in the image that is found again in other images, with
# a descriptor of its surroundings.
# `dronevio.estimator.sfm.features.detect_features` detects SIFT keypoints
# (Lowe, IJCV 2004): extrema of the image filtered by differences of Gaussians,
# over positions and scales. The descriptor consists of 4 × 4 histograms of
# gradient directions, relative to the main direction, with 8 bins each.

# %%
from dronevio.estimator.sfm.config import FeatureConfig
from dronevio.estimator.sfm.features import detect_features

features = [
    detect_features(images.read(i), FeatureConfig()) for i in range(count)
]
print("features in each image:", [len(each) for each in features])

# %% jupyter={"source_hidden": true}
# Figure: features of the first photograph as circles of their size
figure, ax = plt.subplots(figsize=(8, 5.3), layout="constrained")
ax.imshow(images.read(0), alpha=0.7)
some = features[0].pixels[::4], features[0].sizes_px[::4]
for pixel, size in zip(*some, strict=True):
    ax.add_patch(
        Circle(pixel, 0.5 * size, fill=False, color="#d55e00", linewidth=0.7)
    )
ax.set_title("every fourth feature of image 0")
ax.axis("off")
plt.show()

# %% [markdown]
# ## 3. Matches
#
# Two features match if their descriptors are nearest neighbours of each other,
# and if the distance $d_1$ to the nearest descriptor is clearly smaller than
# the distance $d_2$ to the second nearest (the ratio test):
#
# $$d_1 \le 0.8 \, d_2.$$
#
# The next cell does this with NumPy;
# `dronevio.estimator.sfm.matching.match_features` adds a bound on the distance,
# and a lower bound that accounts for the rounding of the descriptors.

# %%
from dronevio.estimator.sfm.config import MatchingConfig
from dronevio.estimator.sfm.matching import match_features

FIRST, SECOND = 0, 2


def unit(detected):
    """Return descriptors of length 1."""
    d = detected.descriptors.astype(float)
    return d / np.linalg.norm(d, axis=1, keepdims=True)


squared = np.maximum(
    2.0 - 2.0 * unit(features[FIRST]) @ unit(features[SECOND]).T, 0.0
)
distance = np.sqrt(squared)
nearest = distance.argmin(axis=1)
mutual = distance.argmin(axis=0)[nearest] == np.arange(len(nearest))
d1, d2 = np.sort(distance, axis=1)[:, :2].T
by_hand = np.flatnonzero(mutual & (d1 <= 0.8 * d2))

matches = match_features(features[FIRST], features[SECOND], MatchingConfig())
common = np.intersect1d(by_hand, matches[:, 0])
print(f"by hand {len(by_hand)} matches, match_features {len(matches)}")
print(f"in common {len(common)}")

# %% [markdown]
# ## 4. Geometric verification
#
# Some matches are wrong. The correct ones satisfy the epipolar constraint: the
# ray of one image, the ray of the other and the vector between both cameras lie
# in one plane. With the pose $(R, t)$ of the second camera in the frame of the
# first,
#
# $$r_1^\top E \, r_2 = 0, \qquad E = [t]_\times R,$$
#
# where $[t]_\times$ is the matrix of the cross product with $t$.
# `dronevio.estimator.sfm.two_view.verify` estimates $E$ by RANSAC: it solves
# for $E$ from random minimal samples of matches, and keeps the one with the
# most inliers. It then decomposes $E$ into rotation and translation, of which
# four combinations exist, and takes the one with most points in front of both
# cameras. It also refuses scenes without information on depth: a rotation
# without translation, or a plane.

# %%
from dronevio.estimator.sfm.config import VerificationConfig
from dronevio.estimator.sfm.two_view import verify, view_of

views = [view_of(each.pixels, camera, is_calibrated=False) for each in features]
pair = verify(
    FIRST, SECOND, (views[FIRST], views[SECOND]), matches, VerificationConfig()
)
assert pair is not None, "there are too few correct matches"
print(f"{len(pair.matches)} of {len(matches)} matches are verified")
print(f"geometry: {pair.geometry}")
print(f"median angle between the rays: {np.degrees(pair.angle_rad):.1f}°")


def epipolar_px(matches):
    """Return the distances of matches from their epipolar planes."""
    assert pair is not None
    R, t = pair.T_first_second[:3, :3], pair.T_first_second[:3, 3]
    normals = views[SECOND].bearings[matches[:, 1]] @ (skew(t) @ R).T
    sines = np.sum(views[FIRST].bearings[matches[:, 0]] * normals, axis=1)
    return camera.fx * np.abs(sines) / np.linalg.norm(normals, axis=1)


is_verified = np.isin(matches[:, 0], pair.matches[:, 0])
good_px = np.median(epipolar_px(pair.matches))
other_px = np.median(epipolar_px(matches[~is_verified]))
print(f"median distance: verified {good_px:.2f} px, others {other_px:.1f} px")

# %% jupyter={"source_hidden": true}
# Figure: matches between two photographs, verified ones green, others red
figure, ax = plt.subplots(figsize=(9, 3.2), layout="constrained")
ax.imshow(np.hstack([images.read(FIRST), images.read(SECOND)]), alpha=0.6)
for (i, j), good in zip(matches, is_verified, strict=True):
    (x0, y0), (x1, y1) = features[FIRST].pixels[i], features[SECOND].pixels[j]
    colour, width = ("#009e73", 0.4) if good else ("red", 1.0)
    ax.plot([x0, x1 + camera.width], [y0, y1], color=colour, linewidth=width)
ax.axis("off")
plt.show()

# %% [markdown]
# Verified matches of all pairs are connected to tracks
# (`dronevio.estimator.sfm.tracks.connect_tracks`): the observations of one
# point in several images. `dronevio.estimator.sfm.model.Scene` holds them. This
# is the data association of the whole problem.

# %%
from dronevio.estimator.sfm.model import Scene
from dronevio.estimator.sfm.tracks import connect_tracks

IS_CALIBRATED = False

pairs = []
for i in range(count):
    for j in range(i + 1, count):
        putative = match_features(features[i], features[j], MatchingConfig())
        both = views[i], views[j]
        verified = verify(i, j, both, putative, VerificationConfig())
        if verified is not None:
            pairs.append(verified)
            angle_deg = np.degrees(verified.angle_rad)
            count_ij = len(verified.matches)
            print(
                f"images {i}, {j}: {count_ij:3d} verified, angle {angle_deg:4.1f}°"
            )

tracks = connect_tracks(pairs, np.array([len(each) for each in features]))
observations = list(zip(tracks.image, tracks.feature, strict=True))
pixels = np.array([features[i].pixels[k] for i, k in observations])
# The positions of large features are less certain.
sigmas = np.array([features[i].sigmas[k] for i, k in observations])
scene = Scene(
    tracks, pixels, sigmas, images.image_camera, np.array([IS_CALIBRATED])
)
print(f"{tracks.count} tracks with {len(pixels)} observations")

# %% [markdown]
# ## 5. Triangulation of the seed
#
# A reconstruction begins with a pair of images. It needs many matches, so that
# its pose is accurate, and a large angle between the rays, so that the depths
# are determined. The frame of its first camera becomes the world frame, and the
# distance between both cameras becomes the unit of length.
#
# The point of two rays is where they are nearest to each other. The rays from
# $c_1$ and $c_2$ in the directions $r_1$ and $r_2$ (in the world frame) are
# nearest at the lengths $s_1$ and $s_2$ for which the connection is orthogonal
# to both:
#
# $$\begin{split}
# s_1 - (r_1 \cdot r_2) \, s_2 &= r_1 \cdot (c_2 - c_1) \\
# (r_1 \cdot r_2) \, s_1 - s_2 &= r_2 \cdot (c_2 - c_1)
# \end{split}$$

# %%
SEED_PAIR = (0, 2)

seed = next(p for p in pairs if (p.first, p.second) == SEED_PAIR)
T_1, T_2 = np.eye(4), seed.T_first_second
r_1 = views[seed.first].bearings[seed.matches[:, 0]] @ T_1[:3, :3].T
r_2 = views[seed.second].bearings[seed.matches[:, 1]] @ T_2[:3, :3].T
midpoints = []
for one, other in zip(r_1, r_2, strict=True):
    cosine, between = one @ other, T_2[:3, 3] - T_1[:3, 3]
    A = np.array([[1.0, -cosine], [cosine, -1.0]])
    s_1, s_2 = np.linalg.solve(A, [one @ between, other @ between])
    midpoints.append(0.5 * (T_1[:3, 3] + s_1 * one + T_2[:3, 3] + s_2 * other))
points_by_hand = np.array(midpoints)

# %% [markdown]
# `dronevio.estimator.sfm.structure.triangulate` does the same for all tracks at
# once, with any number of rays and with outliers.
# `dronevio.estimator.sfm.model.SfmState` is the state of the reconstruction:
# cameras, poses and points, not a number (NaN) as long as they are unknown.

# %%
from dronevio.estimator.sfm.config import TriangulationConfig
from dronevio.estimator.sfm.model import SfmState
from dronevio.estimator.sfm.structure import triangulate

poses = np.full((count, 4, 4), np.nan)
poses[seed.first], poses[seed.second] = T_1, T_2
state = SfmState(
    cameras=images.cameras,
    Ts_world_cam=poses,
    points=np.full((tracks.count, 3), np.nan),
    is_inlier=np.zeros(len(pixels), bool),
)
state = triangulate(scene, state, TriangulationConfig())


def describe(step, state):
    """Print the size of a reconstruction and its reprojection errors."""
    errors_px = state.errors_px(scene, state.used(scene))
    rms_px = np.sqrt(np.mean(errors_px**2))
    images, points = state.is_registered.sum(), state.has_point.sum()
    f = state.cameras[0].fx
    size = f"{images} images {points:4d} points"
    print(f"{step:<28} {size} {rms_px:5.2f} px, f = {f:.0f} px")


describe("seed", state)

rows = np.flatnonzero(tracks.image == seed.first)
track_of = dict(zip(tracks.feature[rows], tracks.track[rows], strict=True))
relative = []
for p, feature in zip(points_by_hand, seed.matches[:, 0], strict=True):
    if feature in track_of:
        q = state.points[track_of[feature]]
        relative.append(np.linalg.norm(p - q) / np.linalg.norm(q))
print(
    f"difference from the points by hand: {np.nanmedian(relative):.1e} (median)"
)
assert np.nanmedian(relative) < 0.01, "the points differ from those by hand"

# %% [markdown]
# ## 6. Bundle adjustment
#
# The adjustment estimates poses, points and the camera together. It minimizes
# the sum of the squared reprojection errors over all observations,
#
# $$\min_{T, \, p, \, f, \, k} \; \sum_{(i, j)} \big| \pi_i(p_j) - u_{ij} \big|^2 ,$$
#
# with the Levenberg-Marquardt method.
# `dronevio.estimator.sfm.adjustment.adjust` has one reprojection error for each
# observation, as the factor graph of the chapter, and factors of GTSAM that hold
# the first pose and the distance to another one, because images determine neither
# position, orientation nor scale. The points are eliminated by the Schur
# complement, so that a linear system in the poses is left. Observations with large errors are removed
# afterwards (`dronevio.estimator.sfm.structure.remove_outliers`).

# %%
from dronevio.estimator.sfm.adjustment import BundleAdjustmentConfig, adjust
from dronevio.estimator.sfm.structure import remove_outliers


def adjusted(state):
    """Return the reconstruction after bundle adjustment, without outliers."""
    state = adjust(scene, state, state.used(scene), BundleAdjustmentConfig())
    return remove_outliers(scene, state, TriangulationConfig())


state = adjusted(state)
describe("seed, adjusted", state)

# %% [markdown]
# Two images already correct the guessed focal length. The errors are smaller
# than a pixel because the positions of features are interpolated.
#
# ## 7. Resection: one image after another
#
# An image that observes known points has a known pose: that for which the
# points are projected to their observations. At least three points are
# necessary, and RANSAC is used again, because a track may be wrong.
# `dronevio.estimator.sfm.resection.resect` returns the pose and the inliers.
# New points are then triangulated from the additional image
# (`dronevio.estimator.sfm.structure.complete`), and everything is adjusted. The
# next image is the one that observes the most points.

# %%
from dronevio.estimator.sfm.config import ResectionConfig
from dronevio.estimator.sfm.resection import resect
from dronevio.estimator.sfm.structure import complete

while not state.is_registered.all():
    has_point = state.has_point[tracks.track]
    visible = np.bincount(tracks.image[has_point], minlength=count)
    image = int(np.argmax(np.where(state.is_registered, 0, visible)))
    rows = np.flatnonzero((tracks.image == image) & has_point)
    pose = resect(
        state.points[tracks.track[rows]],
        state.bearings(scene, rows),
        state.cameras[0].fx,
        ResectionConfig(),
    )
    assert pose is not None, f"image {image} cannot be registered"
    poses, is_inlier = state.Ts_world_cam.copy(), state.is_inlier.copy()
    poses[image], is_inlier[rows] = pose
    state = replace(state, Ts_world_cam=poses, is_inlier=is_inlier)
    describe(f"image {image}, {pose[1].sum()} of {len(rows)} points", state)
    state = adjusted(complete(scene, state, TriangulationConfig()))
    describe("  completed and adjusted", state)

# %% jupyter={"source_hidden": true}
# Figure: reprojections of the last image, and the errors of all images
rows = np.flatnonzero(state.used(scene) & (tracks.image == image))
T = state.Ts_world_cam[image]
in_camera = (state.points[tracks.track[rows]] - T[:3, 3]) @ T[:3, :3]
reprojected = state.cameras[0].project(in_camera)
figure, (ax, histogram) = plt.subplots(
    1, 2, figsize=(9, 3.3), width_ratios=(1.5, 1), layout="constrained"
)
ax.imshow(images.read(image), alpha=0.7)
ax.scatter(
    *pixels[rows].T,
    s=22,
    facecolors="none",
    edgecolors="#0072b2",
    label="observed",
)
ax.scatter(*reprojected.T, s=4, color="#d55e00", label="reprojected")
ax.set_title(f"image {image}")
ax.legend(fontsize="small")
ax.axis("off")
histogram.hist(
    np.minimum(state.errors_px(scene, state.used(scene)), 1.5),
    bins=60,
    color="#d55e00",
)
histogram.set(
    xlabel="reprojection error [px]", ylabel="observations", title="all images"
)
plt.show()

# %% jupyter={"source_hidden": true}
# Figure: the points in their colours, from the front and from above
points, colours = state.points, np.full((tracks.count, 3), np.nan)
for i, k, t in zip(tracks.image, tracks.feature, tracks.track, strict=True):
    colours[t] = features[i].colours[k] / 255.0
shown = state.has_point & (
    np.abs(points - np.nanmedian(points, axis=0)) < 3.0
).all(axis=1)
figure, (front, above) = plt.subplots(
    1, 2, figsize=(9, 4), layout="constrained"
)
front.scatter(points[shown, 0], -points[shown, 1], c=colours[shown], s=7)
front.set(
    title="seen from the first camera", xlabel="x", ylabel="−y", aspect="equal"
)
above.scatter(points[shown, 0], points[shown, 2], c=colours[shown], s=7)
for i, T in enumerate(state.Ts_world_cam):
    above.quiver(
        T[0, 3],
        T[2, 3],
        T[0, 2],
        T[2, 2],
        color="#d55e00",
        scale=12,
        width=0.006,
    )
    above.annotate(f"{i}", (T[0, 3], T[2, 3]), color="#d55e00")
above.set(
    title="from above, with the cameras", xlabel="x", ylabel="z", aspect="equal"
)
plt.show()

# %% [markdown]
# ## 8. The experiment of the chapter
#
# The chapter begins with the reconstruction of the program Bundler, which is
# already accurate, and adjusts it: the error decreases from 126.9 to 125.5.
# `dronevio.estimator.book.sfm.run_sfm_experiment` carries this out. With
# `perturbation=0` it starts where the chapter starts. A perturbation of 1 moves
# cameras and points before the adjustment, so that there is something to see.

# %%
# Figure: points and reprojections before and after the bundle adjustment
from dronevio.book.sfm_plots import draw_sfm_cloud
from dronevio.estimator.book.sfm import run_sfm_experiment

PERTURBATION = 1.0

experiment = run_sfm_experiment(np.random.default_rng(0), PERTURBATION)
print(f"error of Bundler's reconstruction {experiment.bundler_error:.1f}")
print(f"error before {experiment.initial_error:.1f}")
print(f"error after {experiment.final_error:.1f}")
assert experiment.final_error < 130.0, "it has ended in another minimum"
draw_sfm_cloud(experiment)

# %% [markdown]
# Do both reconstructions agree? They differ by position, orientation and scale
# of the world frame. `dronevio.eval.metrics.alignment.umeyama` returns the
# similarity transformation that aligns the camera positions best.

# %%
from dronevio.eval.metrics.alignment import umeyama

chapter = run_sfm_experiment(np.random.default_rng(0), perturbation=0.0)
theirs, ours = chapter.Ts_world_cam[:, :3, 3], state.Ts_world_cam[:, :3, 3]
similarity = umeyama(theirs, ours, with_scale=True)
aligned = (
    similarity.scale * ours @ similarity.R_truth_estimate.T + similarity.t_m
)
residual = np.sqrt(np.mean(np.sum((aligned - theirs) ** 2, axis=1)))
extent = np.sqrt(np.mean(np.sum((theirs - theirs.mean(axis=0)) ** 2, axis=1)))
print(f"camera positions differ by {residual / extent:.1%} of their extent")
print(f"focal length {state.cameras[0].fx:.0f} px")
print(f"focal length by Bundler {chapter.focal_px.mean():.0f} px")
assert residual < 0.03 * extent, "the camera positions are wrong"

# %% [markdown]
# The whole pipeline, with further tests for wrong images, masks, several
# cameras, and robust loss functions, is one call: `dronevio.api.sfm`, or
# `dronevio sfm FOLDER` on the command line. It also writes the formats of other
# programs. The lesson `dense` goes on from its points to surfaces.

# %%
import dronevio as dv

result = dv.sfm(photograph_folder())
[reconstruction] = result.reconstructions
errors_px = reconstruction.reprojection_errors_px()
print(f"{len(reconstruction.image_names)} images")
print(f"{len(reconstruction.points)} points")
print(f"median error {np.median(errors_px):.2f} px")

# %% [markdown]
# ## Exercises
#
# **1. The ratio test.** In section 3, accept all mutual nearest neighbours: use
# `MatchingConfig(ratio=1.0)`. How many matches are there, and how many remain
# verified in section 4?
#
# <details markdown="1"><summary>Answer</summary>
#
# With the ratio test, 240 matches, of which 219 are verified. Without it, 805
# matches, of which 352 are verified. RANSAC also works with more than half of
# the matches wrong. But a wrong match that is near the epipolar plane by chance
# is verified, too: the constraint is only one equation, and a plane contains
# many features. Such matches are found later, in tracks of three or more
# images.
#
# </details>
#
# **2. The seed.** Which seed pair gives the most points after section 6, and
# which one the smallest difference from the solution of the chapter in the end?
# Try the pairs (0, 1), (0, 4) and (3, 4).
#
# <details markdown="1"><summary>Answer</summary>
#
# The pair (0, 1) has the most points, 379, but its angle is 11°, and it
# estimates a focal length of 600 px. The pair (0, 4) has 66 points and the
# largest angle. In the end all four results differ from that of the chapter by
# 1.3 % to 1.6 %: as soon as all images are adjusted together, the seed has
# little effect, provided that it does not fail.
#
# </details>
#
# **3. Uncertain depths.** The standard deviation of the depth $z$ of a point
# that two cameras with the distance $b$ observe is about
# $\sigma_z \approx z^2 \sigma / (f b)$, with an error of $\sigma$ pixels.
# Derive this from the equations of section 5, and evaluate it for the seed and
# σ = 0.3 px. Compare with the differences of the depths before and after the
# adjustment with all images.
#
# <details markdown="1"><summary>Hint</summary>
#
# Two parallel cameras have the disparity $d = f b / z$. Differentiate it: an
# error $\sigma$ of the disparity is an error $z^2 \sigma / (f b)$ of the depth.
# With z = 3.05 (the median), f = 538 px and b = 1, the result is 0.005. To
# compare, keep the state of section 6 under another name, and take the
# coordinate z of all points that both states have. The median difference is
# 0.016, and 0.007 after the depths are scaled so that their medians agree.
#
# </details>
#
# ## What to change to see it break
#
# Each of these changes makes a check of the lesson fail with an
# `AssertionError`.
#
# **A wrong calibration.** In section 4, declare that the guessed focal length
# of 768 px is a calibration. The adjustment no longer corrects it. The
# reprojection errors remain small, below one pixel, but the camera positions
# are wrong: a small error does not prove that the model is right.
#
# ```python
# IS_CALIBRATED = True
# ```
#
# **A seed with too small an angle.** In section 5, begin with images 2 and 3.
# The angle between the rays is 4° only, so that depths and focal length are
# badly determined, and the next image does not fit the points.
#
# ```python
# SEED_PAIR = (2, 3)
# ```
#
# **A start that is too far away.** In section 8, perturb by five times as much.
# Levenberg-Marquardt only finds the minimum in whose basin it begins. This is
# why the previous sections compute an initial value for every pose and every
# point.
#
# ```python
# PERTURBATION = 5.0
# ```
