# %% [markdown]
# # Visual SLAM: one loop by hand
#
# This lesson follows section 7.4.3 of F. Dellaert and S. Hutchinson,
# *Introduction to Robotics and Perception*
# ([roboticsbook.org](https://www.roboticsbook.org)). The chapter ends with a
# statement: the IMU drifts, and visual SLAM hardly does where loops can be
# closed. The lesson shows it on one loop. A drone flies once around an office
# floor and does not know exactly where it has arrived. It notices that an image
# resembles an earlier one, verifies that both show the same place, and corrects
# its whole path. Each step is carried out by hand first. Then
# `dronevio.estimator.slam.VisualSlam`, which does all of them during the
# flight, is compared with it.
#
# | symbol | meaning | unit |
# | --- | --- | --- |
# | $T_k = (R_k, p_k)$ | pose of the IMU at keyframe $k$ | –, m |
# | $\hat T_k$ | the same by the odometry | –, m |
# | $Z_{ij}$ | measured pose of keyframe $j$ in the frame of keyframe $i$ | –, m |
# | $X$ | landmark of an old keyframe, in its level frame | m |
# | $b$ | ray to a corner in a new keyframe, in its level frame | – |
# | $w$ | visual word | – |
#
# A level frame has its origin in the IMU and its z axis vertical.

# %%
import tempfile
from dataclasses import replace

import dronevio as dv
import matplotlib.pyplot as plt
import numpy as np
from dronevio.models.rotation import (
    inverse_pose,
    log_so3,
    pose_matrix,
    quat_wxyz_from_matrix,
    rotation_z,
    yaw_rad_from_matrix,
)

SEED = 1

# %% [markdown]
# ## 1. A lap with a poor gyroscope
#
# The flight is one fast lap of the scenario `corridor-difficult`: 68 m around
# the core of an office floor, and back to the landing pad. The drone has one
# camera of 10 Hz. Its IMU has five times the noise of EuRoC's, which its
# calibration states, and the scale of its gyroscope errs by 1.5 %, which
# the calibration does not state. A typical data sheet allows as much
# (`dronevio.models.imu_presets.imu_named`).

# %%
GYRO_SCALE = 1.015
NOISE = 5.0

rig = dv.rig_named("pinhole")
imu = replace(
    rig.imu,
    gyro_noise_density=NOISE * rig.imu.gyro_noise_density,
    gyro_random_walk=NOISE * rig.imu.gyro_random_walk,
    accel_noise_density=NOISE * rig.imu.accel_noise_density,
    accel_random_walk=NOISE * rig.imu.accel_random_walk,
)
camera = replace(rig.cameras[0], rate_hz=10.0)
scenario = dv.scenario_named("corridor-difficult", SEED)
scenario = replace(
    scenario,
    rig=replace(rig, imu=imu, cameras=(camera,)),
    plan=replace(scenario.plan, landing_s=5.0, final_rest_s=3.0),
)
folder = tempfile.TemporaryDirectory()  # it is removed when the kernel ends
recording = dv.fly(scenario, folder.name)
assert recording.ground_truth is not None
truth = recording.ground_truth
steps_m = np.linalg.norm(np.diff(truth.p_world_imu, axis=0), axis=1)
print(f"{len(recording.frame_times_ns)} frames in {truth.t_s[-1]:.1f} s")
print(f"path {steps_m.sum():.0f} m")

# %% [markdown]
# `VisualSlam` contains the odometry of the lesson `odometry`, and builds a map
# around it without changing it. It receives the measurements in the order of
# time. What it does with the loop is the subject of section 6; until then, only
# its *keyframes* are used. A keyframe joins the map when it leaves the window
# of the odometry, one to six seconds after its frame, and holds the pose
# $\hat T_k$ by the odometry, the corners of its image with their descriptors,
# and its landmarks (`dronevio.estimator.slam.MapKeyframe`).

# %%
slam = dv.VisualSlam(recording.rig)
estimates = []
for measurement in dv.measurements(recording):
    if isinstance(measurement, dv.ImuSamples):
        gyro_rad_s = GYRO_SCALE * measurement.gyro_rad_s
        slam.add_imu(replace(measurement, gyro_rad_s=gyro_rad_s))
    else:
        estimates.append(slam.add_frame(measurement))

keyframes = slam.mapper.keyframes
count = len(keyframes)
t_ns = np.array([keyframe.t_ns for keyframe in keyframes])
t_s = (t_ns - recording.frame_times_ns[0]) * 1e-9
odometry = np.array([keyframe.T_odom_imu for keyframe in keyframes])
true_poses = truth.Ts_world_imu[np.searchsorted(truth.t_ns, t_ns)]
frames = np.abs(recording.frame_times_ns[:, None] - t_ns).argmin(axis=0)
corners = np.mean([len(keyframe.features) for keyframe in keyframes])
landmarks = np.mean([len(keyframe.landmark_ids) for keyframe in keyframes])
print(f"{count} keyframes up to {t_s[-1]:.1f} s")
print(f"{corners:.0f} corners and {landmarks:.0f} landmarks in each (mean)")

# %% [markdown]
# Yaw and position of the start are not observable. To look at the drift, the
# path is put at the true yaw and position of the first keyframe, so that its
# error at the end is what has accumulated. The absolute trajectory error (ATE)
# is the root mean square of the position errors after the best alignment of yaw
# and position, as usual (`dronevio.evaluation.ate`).

# %%


def in_world(poses):
    """Return poses with yaw and position of the first one as in truth."""
    R = true_poses[0, :3, :3] @ poses[0, :3, :3].T
    R = rotation_z(yaw_rad_from_matrix(R))
    p = true_poses[0, :3, 3] - R @ poses[0, :3, 3]
    return pose_matrix(R, p) @ poses


def ate_m(poses, at_ns=t_ns):
    """Return the absolute trajectory error of poses, at the keyframes."""
    quat_wxyz = quat_wxyz_from_matrix(poses[:, :3, :3])
    path = dv.Trajectory(at_ns, poses[:, :3, 3], quat_wxyz)
    return dv.ate(truth, path).rmse


def difference(T_a, T_b):
    """Return the rotation and the distance between two poses [°] and [m]."""
    T = inverse_pose(T_a) @ T_b
    angle_deg = np.degrees(np.linalg.norm(log_so3(T[:3, :3])))
    return angle_deg, np.linalg.norm(T[:3, 3])


drift_deg, drift_m = difference(true_poses[-1], in_world(odometry)[-1])
print(f"drift at the end {drift_m:.2f} m and {drift_deg:.1f}°")
print(f"ATE of the odometry {ate_m(odometry):.3f} m")
assert drift_m > 0.2, "the odometry does not drift"

# %% jupyter={"source_hidden": true}
# Figure: the lap from above by truth and by odometry, and its end enlarged
from dronevio.sim.worlds.corridor import CORE_M, HIGH_M
from matplotlib.patches import Rectangle

TRUTH, BEFORE, AFTER, WRONG = "0.25", "#d55e00", "#009e73", "#cc0000"


def draw_floor(ax):
    """Draw the walls of the floor and the true path."""
    for (x, y), colour in ((HIGH_M[:2], "white"), (CORE_M, "0.88")):
        size = 2.0 * x, 2.0 * y
        ax.add_patch(Rectangle((-x, -y), *size, fc=colour, ec="0.5"))
    ax.plot(
        *truth.p_world_imu[:, :2].T, color=TRUTH, linewidth=1, label="truth"
    )
    ax.set(aspect="equal", xlim=(-12.4, 12.4), ylim=(-7.4, 7.4))
    ax.set(xlabel="x [m]", ylabel="y [m]")


def draw_path(ax, poses, colour, label):
    """Draw a path through the keyframes."""
    x, y = in_world(poses)[:, :2, 3].T
    ax.plot(x, y, ".-", color=colour, linewidth=1, markersize=3, label=label)


def enlarge(ax):
    """Show the surroundings of the landing pad."""
    ax.set(xlim=(-3.2, 2.2), ylim=(-6.8, -4.4))


figure, axes = plt.subplots(
    1, 2, figsize=(9, 2.9), width_ratios=(1.25, 1), layout="constrained"
)
for ax in axes:
    draw_floor(ax)
    draw_path(ax, odometry, BEFORE, "odometry")
enlarge(axes[1])
axes[0].legend(fontsize="small", loc="center")
axes[1].set_title("the end of the lap", fontsize=9)
plt.show()

# %% [markdown]
# The lap turns by 360°, of which the gyroscope measures 1.5 % too much: 5.4°. The
# camera corrects about three quarters of it. What remains is a turn of the whole
# last part of the path. The estimator cannot notice it, because nothing that it
# measures between one keyframe and the next contradicts it.
#
# ## 2. Visual words
#
# Where has the drone been before? Its position cannot answer, since it drifts.
# The images can. A descriptor of 256 bits is assigned to the nearest of 4096
# *visual words* (`dronevio.estimator.slam.places.vocabulary.Vocabulary`), and a
# keyframe becomes the histogram $h$ of its words: a bag of words, in which the
# positions of the corners are forgotten. The similarity of two keyframes is the
# weight of the words that both contain, relative to what it would be if all
# were common:
#
# $$\begin{split}
# s(h, g) &= \frac{\sum_w m_w \min(h_w, g_w)}{\bar m \, \max(\sum_w h_w, \sum_w g_w)} \\
# m_w &= \log\Big(1 + \frac{K + 1}{n_w + 1}\Big), \qquad \bar m = \frac{\sum_w m_w h_w}{\sum_w h_w} .
# \end{split}$$
#
# A word that occurs in many, $n_w$, of the $K$ keyframes of the map says little
# about the place, and its weight $m_w$ is small.
# `dronevio.estimator.slam.places.index.PlaceIndex` computes the similarity to
# all earlier keyframes at once.

# %%
from dronevio.estimator.slam.places.index import PlaceIndex
from dronevio.estimator.slam.places.vocabulary import default_vocabulary

vocabulary = default_vocabulary()
words = [vocabulary.assign(each.features.descriptors) for each in keyframes]
index = PlaceIndex(vocabulary.size)
similarity = np.full((count, count), np.nan)
for n, of_keyframe in enumerate(words):
    similarity[n, :n] = index.similarities(of_keyframe, n)
    index.add(of_keyframe)

histograms = np.array(
    [np.bincount(w, minlength=vocabulary.size) for w in words]
)
containing = (histograms[:-1] > 0).sum(axis=0)
m = np.log(1.0 + count / (containing + 1.0))  # K = count - 1
h, g = histograms[-1], histograms[0]
size = max(h.sum(), g.sum())
by_hand = m @ np.minimum(h, g) / (m @ h / h.sum() * size)
print(f"similarity of the last and the first keyframe {by_hand:.4f}")
print(f"by PlaceIndex {similarity[-1, 0]:.4f}")
assert np.isclose(by_hand, similarity[-1, 0], rtol=1e-3)

# %% [markdown]
# Neighbours always resemble each other, and say nothing new. Only keyframes
# that are at least ten seconds older are compared.

# %%
MIN_AGE_S = 10.0

is_old = t_s[:, None] - t_s >= MIN_AGE_S
scores = np.where(is_old, similarity, -1.0)
best, best_score = scores.argmax(axis=1), scores.max(axis=1)
queries = np.flatnonzero(is_old.any(axis=1))
print(f"{len(queries)} keyframes have older ones to be compared with")

# %% jupyter={"source_hidden": true}
# Figure: the similarity of all pairs, and the best one of each over time
NEAR_M = 3.0
distance_m = np.linalg.norm(
    true_poses[:, None, :3, 3] - true_poses[:, :3, 3], axis=2
)
is_near = distance_m[queries, best[queries]] < NEAR_M
figure, (matrix, ax) = plt.subplots(
    1, 2, figsize=(9, 3.4), width_ratios=(1, 1.35), layout="constrained"
)
picture = matrix.imshow(similarity, vmin=0.1, vmax=0.35, cmap="viridis")
matrix.set(xlabel="earlier keyframe", ylabel="keyframe")
figure.colorbar(picture, ax=matrix, label="similarity")
for chosen, colour, label in (
    (~is_near, "0.6", "most similar one: another place"),
    (is_near, AFTER, "most similar one: within 3 m"),
):
    rows = queries[chosen]
    ax.plot(t_s[rows], best_score[rows], "o", color=colour, ms=4, label=label)
ax.set(xlabel="time [s]", ylabel="best similarity", ylim=(0.0, 0.45))
ax.grid(alpha=0.3)
ax.legend(fontsize="small", loc="lower right")
plt.show()

# %% [markdown]
# Along the diagonal of the matrix, keyframes resemble their neighbours. The
# loop is the small bright corner at the lower left: the last keyframes resemble
# the first ones. On the right, the colours come from the truth, which the drone
# does not know. Without them, only the last seconds stand out. The first
# keyframes at the right place are no more similar than many at wrong ones,
# since the wings of the floor have doors, lamps and chairs of the same kinds.
# The similarity proposes; something else has to decide.

# %% jupyter={"source_hidden": true}
# Figure: the two most similar images of the flight, and those of its first part


def image_of(k):
    """Return the image of a keyframe."""
    return recording.frame(int(frames[k])).images[0]


figure, axes = plt.subplots(2, 2, figsize=(9, 6.1), layout="constrained")
for row, among in zip(
    axes, (queries, queries[t_s[queries] < 25.0]), strict=True
):
    n = among[best_score[among].argmax()]
    for ax, k in zip(row, (best[n], n), strict=True):
        ax.imshow(image_of(k), cmap="gray")
        ax.set_title(f"keyframe {k} at {t_s[k]:.1f} s", fontsize=9)
        ax.axis("off")
    row[1].set_title(
        f"keyframe {n} at {t_s[n]:.1f} s, similarity {best_score[n]:.3f}",
        fontsize=9,
    )
plt.show()

# %% [markdown]
# Above are the two most similar images of the whole flight, below those of its
# first 25 s. A person sees at once that the lower ones show different wings.
#
# ## 3. Geometry decides
#
# If both images show the same place, *one* rigid motion explains all matches
# between them. First the matches: each landmark of the old keyframe and the
# corner of the new one with the fewest different bits, if they are nearest to
# each other.

# %%
from dronevio.estimator.slam.places.matching import described_landmarks
from dronevio.estimator.slam.places.vocabulary import hamming_distances


def match(old, new):
    """Return rows of old and new corners, and the landmarks of the old."""
    rows, landmark = described_landmarks(old)
    if len(rows) == 0:
        return rows, rows, np.zeros((0, 3))
    bits = hamming_distances(
        old.features.descriptors[rows], new.features.descriptors
    )
    nearest = bits.argmin(axis=1)
    mutual = bits.argmin(axis=0)[nearest] == np.arange(len(rows))
    points = old.landmarks_imu[landmark[mutual]]
    return rows[mutual], nearest[mutual], points


# %% [markdown]
# A landmark $X$ of the old keyframe is seen by the new one along the ray $b$,
# from the camera at $o$. The accelerometer has measured which way is up in
# both, so that in level frames only yaw $\psi$ and translation $t$ are unknown:
#
# $$R_z(\psi)^\top (X - t) = o + \lambda \, b .$$
#
# Two landmarks determine the four unknowns (Kukelova et al., ACCV 2010), where
# the general problem needs three. RANSAC draws pairs of matches, solves for the
# pose of each pair, and counts the matches that agree within 3 px.
# `dronevio.estimator.slam.places.gravity_pose.sample_poses` computes the poses
# of all pairs at once.

# %%
from dronevio.estimator.slam.places.gravity_pose import (
    LevelMatches,
    level_pose_matrix,
    sample_poses,
    squared_errors,
)

PAIRS = 300
THRESHOLD_PX = 3.0

T_imu_cam = camera.T_imu_cam


def verified_by_hand(old, new):
    """Return matches, which of them agree, the pose, and all counts."""
    old_rows, new_rows, points = match(old, new)
    R_old, R_new = old.T_odom_imu[:3, :3], new.T_odom_imu[:3, :3]
    rays = np.column_stack([new.features.xy[new_rows], np.ones(len(new_rows))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    level = LevelMatches(
        points @ R_old.T,
        rays @ (R_new @ T_imu_cam[:3, :3]).T,
        np.tile(R_new @ T_imu_cam[:3, 3], (len(rays), 1)),
    )
    poses = sample_poses(level, PAIRS, np.random.default_rng(SEED))
    if len(poses) == 0:
        agrees = np.zeros(len(old_rows), bool)
        return old_rows, new_rows, agrees, np.eye(4), np.zeros(1, int)
    limit = (THRESHOLD_PX / camera.model.fx) ** 2
    agrees = squared_errors(poses, level) < limit
    counts = agrees.sum(axis=1)
    k = counts.argmax()
    Z = level_pose_matrix(poses.yaw_rad[k], poses.t[k], R_old, R_new)
    return old_rows, new_rows, agrees[k], Z, counts


# %% [markdown]
# The next cell verifies the most similar keyframe of each keyframe in the order
# of the flight, and takes the first one for which enough matches agree. That is
# the loop. Of those before it, the most similar one is kept for comparison.

# %%
MIN_AGREEING = 16

agreeing = np.array(
    [
        verified_by_hand(keyframes[best[n]], keyframes[n])[2].sum()
        for n in queries
    ]
)
j = int(queries[np.argmax(agreeing >= MIN_AGREEING)])
i = int(best[j])
assert distance_m[j, i] < NEAR_M, "the loop connects two places"

before = queries[queries < j]
false_j = int(before[best_score[before].argmax()])
false_i = int(best[false_j])
for name, new, old in (("loop", j, i), ("not a loop", false_j, false_i)):
    agrees = verified_by_hand(keyframes[old], keyframes[new])[2]
    print(f"{name}: keyframe {new} at {t_s[new]:.1f} s,")
    print(f"  like keyframe {old} at {t_s[old]:.1f} s", end=", ")
    print(f"similarity {similarity[new, old]:.3f}")
    print(f"  {agrees.sum()} of {len(agrees)} matches agree", end=", ")
    print(f"true distance {distance_m[new, old]:.1f} m")

# %% jupyter={"source_hidden": true}
# Figure: matches of the loop and of a false candidate, before and after RANSAC


def draw_matches(ax, old, new, *, after):
    """Draw two images side by side with their matches."""
    a, b, agrees, *_ = verified_by_hand(keyframes[old], keyframes[new])
    images = np.hstack([image_of(old), image_of(new)])
    ax.imshow(images, cmap="gray", alpha=0.75)
    starts = keyframes[old].features.pixels[a]
    ends = keyframes[new].features.pixels[b] + [camera.model.width, 0]
    for start, end, good in zip(starts, ends, agrees, strict=True):
        colour = "#e69f00" if not after else AFTER
        if good or not after:
            ax.plot(*np.transpose([start, end]), color=colour, linewidth=0.9)
    ax.axis("off")
    state = f"{agrees.sum()} agree" if after else f"{len(agrees)} matches"
    ax.set_title(f"keyframes {old} and {new}: {state}", fontsize=9)


figure, axes = plt.subplots(2, 2, figsize=(9, 3.5), layout="constrained")
for row, (old, new) in zip(axes, ((i, j), (false_i, false_j)), strict=True):
    for ax, after in zip(row, (False, True), strict=True):
        draw_matches(ax, old, new, after=after)
plt.show()

# %% [markdown]
# Above is the loop: after RANSAC, the lines connect the same things, and run
# nearly parallel. Below is the most similar of the false candidates. Both
# images show things of the same kinds, and some corners look alike, but no
# motion explains more than a few of its matches. Two always agree, because they
# determine the pose, and one or two more may agree by chance.

# %% jupyter={"source_hidden": true}
# Figure: similarity and number of agreeing matches of all best candidates
figure, ax = plt.subplots(figsize=(6.5, 3.2), layout="constrained")
for chosen, colour, label in (
    (~is_near, "0.6", "another place"),
    (is_near, AFTER, "within 3 m"),
):
    of_chosen = best_score[queries[chosen]], agreeing[chosen]
    ax.plot(*of_chosen, "o", color=colour, ms=4, label=label)
ax.axhline(MIN_AGREEING, color="0.3", linestyle="--", linewidth=1)
ax.set(xlabel="similarity", ylabel="agreeing matches")
ax.grid(alpha=0.3)
ax.legend(fontsize="small", title="true distance")
plt.show()

# %% [markdown]
# No limit on the similarity separates right from wrong; one on the number of
# agreeing matches does. It also rejects a few right candidates, with few
# landmarks or from a metre away, where corners look different. That is
# harmless: another keyframe of the place is accepted.
#
# `dronevio.estimator.slam.places.verification.verify`
# matches in both directions, with the ratio test, refines the pose by least
# squares, and returns its covariance, or the reason of the rejection.

# %%
from dronevio.estimator.slam.places.verification import (
    PlaceMatch,
    VerificationConfig,
    verify,
)

settings = VerificationConfig()
loop = verify(keyframes[j], keyframes[i], recording.rig, settings)
false = verify(keyframes[false_j], keyframes[false_i], recording.rig, settings)
print("false candidate:", false)
assert isinstance(loop, PlaceMatch), "the loop is rejected"

Z_hand = verified_by_hand(keyframes[i], keyframes[j])[3]
Z_true = inverse_pose(true_poses[i]) @ true_poses[j]
Z_odometry = inverse_pose(odometry[i]) @ odometry[j]
for name, Z in (
    ("odometry", Z_odometry),
    ("by hand", Z_hand),
    ("verify", loop.T_match_query),
):
    error_deg, error_m = difference(Z_true, Z)
    print(f"error of Z, {name:<9} {1e3 * error_m:4.0f} mm {error_deg:5.2f}°")

# %% [markdown]
# Two images, half a minute apart, tell the pose of one in the frame of the
# other to one to three centimetres. By the odometry, it is wrong by 25 cm.
#
# ## 4. The pose graph
#
# A pose graph has the poses of the keyframes as unknowns, and relative poses
# between them as factors. The odometry measures each keyframe in the frame of
# the one before, and the loop adds a single factor between $i$ and $j$:
#
# $$\begin{split}
# \min_T \; & \sum_k \big|\mathrm{Log}(\hat Z_k^{-1} \, T_{k-1}^{-1} T_k)\big|^2_{\Sigma} \\
# & + \rho\big(|\mathrm{Log}(Z_{ij}^{-1} \, T_i^{-1} T_j)|^2_{\Lambda}\big), \qquad
# \hat Z_k = \hat T_{k-1}^{-1} \hat T_k .
# \end{split}$$
#
# Without the loop, the solution is the odometry itself. $\Sigma$ says how far a
# step of the odometry may be wrong: 0.3° and 2 cm are a guess, which allows
# $\sqrt{178} \cdot 0.3° = 4.0°$ after the lap. The loss $\rho$ of the loop is
# Cauchy's, for the case that it is wrong. With GTSAM, the graph is a dozen
# lines.

# %%
import gtsam
from gtsam.symbol_shorthand import X

STEP_SIGMA_DEG = 0.3
STEP_SIGMA_M = 0.02
LOOP_SIGMA_DEG = 0.5
LOOP_SIGMA_M = 0.05


def sigmas(rotation_deg, position_m):
    """Return the noise model of a relative pose, rotation first."""
    each = np.repeat([np.radians(rotation_deg), position_m], 3)
    return gtsam.noiseModel.Diagonal.Sigmas(each)


def optimized(loops, *, is_robust):
    """Return the poses of the keyframes with loops (i, j, Z)."""
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    T = [gtsam.Pose3(pose) for pose in odometry]
    graph.addPriorPose3(X(0), T[0], sigmas(0.01, 1e-4))
    step = sigmas(STEP_SIGMA_DEG, STEP_SIGMA_M)
    for k in range(count):
        initial.insert(X(k), T[k])
        if k > 0:
            Z_k = T[k - 1].between(T[k])
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), Z_k, step))
    noise = sigmas(LOOP_SIGMA_DEG, LOOP_SIGMA_M)
    if is_robust:
        loss = gtsam.noiseModel.mEstimator.Cauchy.Create(1.0)
        noise = gtsam.noiseModel.Robust.Create(loss, noise)
    for i, j, Z in loops:
        factor = gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(Z), noise)
        graph.add(factor)
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, initial)
    result = optimizer.optimize()
    print(f"error {graph.error(initial):.1f} before", end=", ")
    print(f"{graph.error(result):.1f} after")
    return np.array([result.atPose3(X(k)).matrix() for k in range(count)])


the_loop = (i, j, loop.T_match_query)
corrected = optimized([the_loop], is_robust=True)
end_deg, end_m = difference(true_poses[-1], in_world(corrected)[-1])
print(f"end of the lap: {drift_m:.2f} m and {drift_deg:.1f}° before")
print(f"                {end_m:.2f} m and {end_deg:.1f}° after")
print(f"ATE {ate_m(odometry):.3f} m before", end=", ")
print(f"{ate_m(corrected):.3f} m after")
assert end_m < 0.2 * drift_m, "the loop does not correct the path"

# %% jupyter={"source_hidden": true}
# Figure: the path before and after the loop is closed, whole and enlarged
figure, axes = plt.subplots(
    2, 2, figsize=(9, 5.4), height_ratios=(1.25, 1), layout="constrained"
)
for column, poses, colour, name in (
    (0, odometry, BEFORE, "odometry"),
    (1, corrected, AFTER, "with one loop"),
):
    for ax in axes[:, column]:
        draw_floor(ax)
        draw_path(ax, poses, colour, name)
        ax.plot(
            *in_world(poses)[[i, j], :2, 3].T,
            "o-",
            color="#0072b2",
            label="keyframes of the loop",
        )
    enlarge(axes[1, column])
    title = f"{name}: ATE {ate_m(poses):.3f} m"
    axes[0, column].set_title(title, fontsize=9)
    axes[0, column].legend(fontsize="small", loc="center")
plt.show()

# %% [markdown]
# The optimization has moved the end by 25 cm, the middle of the lap by less,
# and the start not at all. It spreads the contradiction over all steps. This is
# more than a jump at the end: a map that is attached to the keyframes moves
# with them.
#
# ## 5. A wrong loop
#
# What if the false candidate had been believed? The next cell adds it to the
# graph, with the best pose that RANSAC has found for it, once with the squared
# error and once with the robust loss.

# %%
IS_ROBUST = True

Z_false = verified_by_hand(keyframes[false_i], keyframes[false_j])[3]
both = [the_loop, (false_i, false_j, Z_false)]
bent = optimized(both, is_robust=False)
robust = optimized(both, is_robust=IS_ROBUST)
print(f"ATE with the squared error {ate_m(bent):.3f} m")
print(f"ATE with the robust loss   {ate_m(robust):.3f} m")
is_kept = ate_m(robust) < 1.2 * ate_m(corrected)
assert is_kept, "the wrong loop has bent the map"

# %% jupyter={"source_hidden": true}
# Figure: the path with a wrong loop, by the squared error and the robust loss
figure, axes = plt.subplots(
    1, 2, figsize=(9, 3.0), sharex=True, sharey=True, layout="constrained"
)
for ax, poses, colour, name in (
    (axes[0], bent, WRONG, "squared error"),
    (axes[1], robust, AFTER, "robust loss"),
):
    draw_floor(ax)
    draw_path(ax, poses, colour, name)
    x, y = in_world(poses)[[false_i, false_j], :2, 3].T
    ax.plot(x, y, "o--", color="#0072b2", label="the wrong loop")
    ax.set_title(f"{name}: ATE {ate_m(poses):.3f} m", fontsize=9)
    ax.legend(fontsize="small", loc="center")
axes[0].autoscale()
plt.show()

# %% [markdown]
# One wrong loop destroys the map if it counts as much as the others. With the
# squared error, its force grows with its contradiction. With Cauchy's loss the
# force becomes small again, and the odometry and the right loop prevail. A
# robust loss is the last line of defence, not the first: it compares a loop
# with the odometry, and where that has drifted far, it may reject a right loop.
#
# ## 6. VisualSlam
#
# `VisualSlam` has closed the loop during the flight. It does the same with more
# care (`dronevio.estimator.slam.mapper.Mapper`): a place counts when a second
# keyframe confirms it (`dronevio.estimator.slam.PlaceRecognizer`). The pose is
# measured again by patches around the landmarks
# (`dronevio.estimator.slam.places.localization.Localizer`). The covariances of
# the factors are those that the odometry knows, and a few of them hold gravity
# (`dronevio.estimator.slam.map.odometry_factors.odometry_factors`). Graduated
# non-convexity accepts or rejects the loops together
# (`dronevio.estimator.slam.map.pose_graph.optimize`). With the loops, a bundle
# adjustment of all landmarks and IMU measurements follows
# (`dronevio.estimator.slam.adjustment.bundle_adjustment.adjust`).

# %%
closed = [e for e in estimates if e.closed_loops_ns]
assert closed, "VisualSlam has closed no loop"
first_ns = recording.frame_times_ns[0]
for estimate in closed:
    at_s = (estimate.t_ns - first_ns) * 1e-9
    print(f"{at_s:.1f} s: {len(estimate.closed_loops_ns)} loops closed")
    for then_ns, now_ns in estimate.closed_loops_ns[:3]:
        k, n = np.searchsorted(t_ns, [then_ns, now_ns])
        print(f"  keyframe {n} in the frame of keyframe {k}")

final = slam.final_map()
assert final is not None
slam.close()
final_poses = final.Ts_map_imu[np.searchsorted(final.t_ns, t_ns)]
since = int(frames[0])
online_ns = recording.frame_times_ns[since:]
online = np.array([estimate.T_map_imu for estimate in estimates[since:]])
paths = {
    "odometry": (t_ns, odometry),
    "one loop by hand": (t_ns, corrected),
    "VisualSlam, online": (online_ns, online),
    "VisualSlam, final map": (t_ns, final_poses),
}
for name, (at_ns, poses) in paths.items():
    print(f"ATE {name:<21} {ate_m(poses, at_ns):.3f} m")
assert ate_m(final_poses) < ate_m(corrected), "the final map is worse"

# %% jupyter={"source_hidden": true}
# Figure: the errors of the position over time of the four paths
figure, ax = plt.subplots(figsize=(7.5, 3.2), layout="constrained")
for (name, (at_ns, poses)), colour in zip(
    paths.items(), (BEFORE, AFTER, "#56b4e9", "#0072b2"), strict=True
):
    p_true = truth.p_world_imu[np.searchsorted(truth.t_ns, at_ns)]
    error_m = np.linalg.norm(in_world(poses)[:, :3, 3] - p_true, axis=1)
    ax.plot((at_ns - first_ns) * 1e-9, error_m, color=colour, label=name)
ax.axvline(t_s[j], color="0.5", linestyle="--", linewidth=1)
ax.set(xlabel="time [s]", ylabel="position error [m]")
ax.set_title("aligned at the first keyframe", fontsize=9)
ax.grid(alpha=0.3)
ax.legend(fontsize="small")
plt.show()

# %% [markdown]
# The loop by hand, at the dashed line, is among its first. The online path
# is that of the odometry until the loop is closed, a few seconds later: a
# keyframe first has to leave the window of the odometry. Then the path jumps.
# What is left of the error is a shift of the whole map: nothing measures where
# the map is, and after an optimization it is put where its keyframes are
# nearest to the poses that were published before
# (`dronevio.estimator.slam.map.map_frame.frame_change`), so that its start has
# moved, too.
#
# The ATE of the online path does not profit, since the lap is over, and what
# has been published is not taken back. The keyframes of the lap are corrected,
# though, and by the final map most of all. Bundle adjustment estimates the
# motion again from all landmarks and IMU samples, where the loop by hand only
# distributes its contradiction over equal steps.
#
# A controller does not want jumps. It flies on the odometry, and its goals are
# given in the map.
#
# ## Exercises
#
# **1. Where the gyroscope errs.** An error of scale acts only where the drone
# turns. In section 4, make the rotation sigma of each step 0.1° plus 2 % of the
# angle by which the step turns
# (`np.linalg.norm(log_so3(Z_k.rotation().matrix()))`). What does that change in
# the middle of the lap?
#
# <details markdown="1"><summary>Answer</summary>
#
# The ATE decreases from 7.1 cm to 6.8 cm: the four corners take most of the
# rotation, as they do in truth, and the straight wings stay straight. A part of
# the rest is an error of scale: with a free scale, `dv.ate(truth, path,
# "sim3")`, 6.3 cm remain. One loop says little about the scale of a lap that
# ends where it began.
#
# </details>
#
# **2. More loops.** Add all most similar keyframes that `verify` accepts as
# loops. How many are there, and how does the ATE change? Where would another
# loop help more?
#
# <details markdown="1"><summary>Answer</summary>
#
# There are twelve, and the ATE is 6.7 cm (one: 7.1). All of them connect
# the end of the lap with its start, which one loop has done already. The error
# that remains is in the middle. A second lap would visit it again, and each
# wing would be connected with itself.
#
# </details>
#
# **3. How many pairs?** In the loop, 20 of 53 matches are right. With which
# probability does a pair of matches consist of two right ones? After how many
# pairs has RANSAC drawn one with a probability of 99 %? How many would be
# necessary with three matches for each pose? Check the answer with `PAIRS`.
#
# <details markdown="1"><summary>Answer</summary>
#
# The probability is $0.38^2 = 0.14$, so that
# $n = \log 0.01 / \log(1 - 0.14) = 31$ pairs suffice. With three matches it is
# $0.38^3 = 0.05$, and $n = 84$. That is what gravity saves, and the reason why
# 300 pairs are ample here. With 30 pairs, 11 matches agree.
#
# </details>
#
# ## What to change to see it break
#
# Each of these changes makes a check of the lesson fail with an
# `AssertionError`.
#
# **No geometry.** In section 3, be content with three agreeing matches. One of
# the first candidates passes, and the loop connects two wings.
#
# ```python
# MIN_AGREEING = 3
# ```
#
# **A loop that says too little.** In section 4, let its position be uncertain
# by 1 m. An error of 25 cm does not contradict that, and most of it stays.
#
# ```python
# LOOP_SIGMA_M = 1.0
# ```
#
# **No robust loss.** In section 5, use the squared error for both. The wrong
# loop bends the map.
#
# ```python
# IS_ROBUST = False
# ```
