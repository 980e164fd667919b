# %% [markdown]
# # Visual-inertial odometry on five frames
#
# This lesson follows section 7.4.3 of F. Dellaert and S. Hutchinson,
# *Introduction to Robotics and Perception*
# ([roboticsbook.org](https://www.roboticsbook.org)). The chapter describes in
# words how a drone combines its IMU with its camera while it flies: the IMU
# provides initial values of the poses, new landmarks are added as they come
# into view, and incremental optimization keeps the computation small. The
# lesson carries this out on five frames of a simulated flight. It calls each
# part of the estimator by hand, in the order in which
# `dronevio.estimator.VisualInertialOdometry` does, and compares each result
# with the ground truth.
#
# | symbol | meaning | unit |
# | --- | --- | --- |
# | $x = (R, p, v, b_g, b_a)$ | state: orientation (IMU to world), position, velocity, biases | |
# | $P$ | covariance of the state, (15, 15) | |
# | $\Delta R$, $\Delta v$, $\Delta p$ | preintegrated IMU measurements, as in the lesson `imu` | –, m/s, m |
# | $T_{ic}$ | pose of the camera in the IMU frame | –, m |
# | $f$ | ray of a feature, a unit vector in the camera frame | – |
# | $l$ | position of a landmark in the world frame | m |

# %%
import tempfile
from dataclasses import replace

import dronevio as dv
import matplotlib.pyplot as plt
import numpy as np
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix

SEED = 0

# %% [markdown]
# ## 1. The flight
#
# `dronevio.api.fly` simulates the drone, and renders the images of its camera.
# In the scenario `short`, it rests for 1.5 s, takes off, moves a little and
# lands. The IMU has 200 Hz and the camera 20 Hz. Five frames after the take-off
# are selected, with 0.15 s between them, in which the drone climbs by 0.4 m. A
# whole flight has more frames, but the computations are the same.

# %%
folder = tempfile.TemporaryDirectory()  # it is removed when the kernel ends
recording = dv.fly("short", folder.name, seed=SEED)
rig, imu = recording.rig, recording.rig.imu
frames = [32, 35, 38, 41, 44]
t_ns = recording.frame_times_ns[frames]

truth = recording.ground_truth
assert truth is not None and truth.velocity_m_s is not None
rows = np.searchsorted(truth.t_ns, t_ns)
true_poses = truth.Ts_world_imu[rows]
since_start_s = (t_ns - recording.frame_times_ns[0]) * 1e-9
for k, t, row in zip(frames, since_start_s, rows, strict=True):
    speed = np.linalg.norm(truth.velocity_m_s[row])
    print(f"frame {k} at {t:.2f} s, {speed:.2f} m/s")

# %% jupyter={"source_hidden": true}
# Figure: the five images of the camera while the drone takes off
figure, axes = plt.subplots(1, 5, figsize=(9, 1.5), layout="constrained")
for ax, k in zip(axes, frames, strict=True):
    ax.imshow(recording.frame(k).images[0], cmap="gray")
    ax.set_title(f"frame {k}", fontsize=9)
    ax.axis("off")
plt.show()

# %% [markdown]
# The pose of the camera in the IMU frame, its lens and the noise of the IMU are
# known by calibration (`dronevio.models.Rig`). The next cell can introduce
# errors into the calibration, for the last section.

# %%
EXTRINSIC_ERROR_DEG = 0.0
IMAGE_DELAY = 0

T_imu_cam = rig.cameras[0].T_imu_cam.copy()
T_imu_cam[:3, :3] = T_imu_cam[:3, :3] @ exp_so3(
    np.radians([EXTRINSIC_ERROR_DEG, 0.0, 0.0])
)
camera = replace(rig.cameras[0], T_imu_cam=T_imu_cam)
rig = replace(rig, cameras=(camera,))
model = camera.model
images = [recording.frame(k - IMAGE_DELAY) for k in frames]

# %% [markdown]
# ## 2. IMU samples between frames
#
# `dronevio.estimator.imu.buffer.ImuBuffer` receives the samples and returns
# those up to the time of a frame as increments: mean angular velocities and
# specific forces over intervals. Where a frame is between two samples, it
# divides the interval.

# %%
from dronevio.estimator.imu.buffer import ImuBuffer, Increments

buffer = ImuBuffer(imu)
buffer.add(recording.imu)
before = buffer.take_until(int(t_ns[0]))
increments = [buffer.take_until(int(t)) for t in t_ns[1:]]
for part in increments:
    print(f"{len(part.dt_s)} increments, {part.duration_s:.3f} s")

# %% [markdown]
# ## 3. Initialization
#
# While the drone rests, the accelerometer measures the reaction to gravity,
# which points upward. The mean specific force therefore gives the direction of
# the world's z axis in the IMU frame,
#
# $$R^\top \begin{pmatrix} 0 \\ 0 \\ 1 \end{pmatrix} = \frac{\bar a}{|\bar a|},$$
#
# and the mean of the gyroscope is its bias. Yaw and position are not
# observable; they define the world frame.
# `dronevio.estimator.initialization.static.initialize_static` implements this.
# The x axis of this IMU points up, as that of EuRoC's.

# %%
from dronevio.estimator.initialization.static import initialize_static

n = int(0.8 * imu.rate_hz)
rest = Increments(
    before.dt_s[-n:], before.gyro_rad_s[-n:], before.accel_m_s2[-n:]
)
start = initialize_static(int(t_ns[0]), [rest])

up = rest.accel_m_s2.mean(axis=0)
up /= np.linalg.norm(up)
print("up by hand:             ", np.round(up, 4))
print("up in initialize_static:", np.round(start.T_world_imu[2, :3], 4))
assert np.allclose(up, start.T_world_imu[2, :3], atol=1e-6)

# %% [markdown]
# Yaw and position are set to those of the truth, so that the estimate can be
# compared with it directly. The tilt of this initialization is accurate to
# 0.2°, which leaves little to correct. The lesson therefore rotates it by 3°
# more. The assumed standard deviation of 0.1 rad (5.7°) covers that.

# %%
from dronevio.estimator.initialization.static import InitialSigmas
from dronevio.models.rotation import rotation_z, yaw_rad_from_matrix

TILT_ERROR_DEG = 3.0

R, R_true = start.T_world_imu[:3, :3], true_poses[0, :3, :3]
R = rotation_z(yaw_rad_from_matrix(R_true @ R.T)) @ R
tilt_deg = np.degrees(np.linalg.norm(log_so3(R_true.T @ R)))
print(f"tilt error of the initialization {tilt_deg:.2f}°")
R = exp_so3(np.radians(TILT_ERROR_DEG) * np.array([0.8, -0.6, 0.0])) @ R
start = replace(start, T_world_imu=pose_matrix(R, true_poses[0, :3, 3]))
start = replace(start, covariance=InitialSigmas().covariance(R))

# %% [markdown]
# ## 4. Prediction by the IMU
#
# The increments between two frames are preintegrated (see the lesson `imu`),
# and predict the state at the next frame:
#
# $$\begin{split}
# R_{k+1} &= R_k \, \Delta R \\
# v_{k+1} &= v_k + g \, \Delta t + R_k \, \Delta v \\
# p_{k+1} &= p_k + v_k \, \Delta t + \tfrac12 g \, \Delta t^2 + R_k \, \Delta p
# \end{split}$$
#
# The covariance follows with the Jacobian $F$ of these equations and the
# covariance $Q$ of the preintegrated noise:
#
# $$P_{k+1} = F P_k F^\top + Q.$$
#
# `dronevio.estimator.propagator.ImuPropagation` computes both, with
# `dronevio.estimator.imu.preintegration.Preintegration` and
# `dronevio.estimator.imu.covariance.propagate_covariance`. The next cell
# predicts all frames from the first: dead reckoning.

# %%
from dronevio.estimator.backend.config import SmootherConfig
from dronevio.estimator.backend.landmarks import LandmarkConfig
from dronevio.estimator.backend.smoother import Keyframe, KeyframeSmoother
from dronevio.estimator.imu.preintegration import (
    PreintegrationConfig,
    PreintegrationParams,
)
from dronevio.estimator.propagator import ImuPropagation
from dronevio.estimator.types import NO_FEATURES, Calibration

noise = PreintegrationParams.of(imu, PreintegrationConfig())


def smoother_at(start, observations=NO_FEATURES):
    """Return a smoother with one keyframe."""
    return KeyframeSmoother(
        Calibration(rig),
        SmootherConfig(),
        LandmarkConfig(),
        start,
        start.covariance,
        observations,
    )


def position_error_mm(state, k):
    """Return the error of the position at frame k, and its standard deviation."""
    error_m = np.linalg.norm(state.T_world_imu[:3, 3] - true_poses[k, :3, 3])
    return 1e3 * error_m, 1e3 * np.sqrt(np.trace(state.covariance[3:6, 3:6]))


reckoning = ImuPropagation(noise, imu, start, smoother_at(start).gtsam_state)
reckoned = [start]
for part, t in zip(increments, t_ns[1:], strict=True):
    reckoning.add(part)
    reckoned.append(reckoning.state_at(int(t)))
for k, state in enumerate(reckoned):
    error_mm, sigma_mm = position_error_mm(state, k)
    print(f"frame {frames[k]}: error {error_mm:5.1f} mm, σ {sigma_mm:5.1f} mm")

# %% [markdown]
# After 0.6 s the position is wrong by 11 cm. The tilt error of 3° explains it:
# it turns 9.81 · sin 3° = 0.51 m/s² of gravity into an apparent horizontal
# acceleration, and ½ · 0.51 · 0.6² = 0.09 m.
#
# ## 5. Features and their prediction
#
# `dronevio.estimator.frontend.corners.detect_corners` detects corners: pixels
# at which the matrix of gradients has two large eigenvalues, so that a
# displacement in any direction is visible. At most one corner per cell of a
# grid keeps them evenly distributed.
#
# In the next frame, the gyroscope predicts where the features are. With the
# rotation $R_{c}$ from the previous camera frame to the current one,
#
# $$f_{k+1} \approx R_c \, f_k, \qquad R_c = R_{ic}^\top \, \Delta R^\top R_{ic},$$
#
# which is exact for distant points. `dronevio.estimator.frontend.klt.track`
# then finds them by the pyramidal Lucas-Kanade method: it minimizes the squared
# differences of a window of 11 × 11 pixels, from coarse to fine images.

# %%
from dronevio.estimator.frontend import klt
from dronevio.estimator.frontend.corners import CornerConfig, detect_corners

first, second = images[0].images[0], images[1].images[0]
corners = detect_corners(first, 2.0, np.zeros((0, 2)), 12, CornerConfig())
f_first = model.unproject(corners)

R_ic = camera.T_imu_cam[:3, :3]
dR = increments[0].rotation(start.gyro_bias_rad_s)
R_c = R_ic.T @ dR.T @ R_ic
predicted = model.project(f_first @ R_c.T)
tracked, is_found = klt.track(
    first, second, corners, predicted, window_px=11, levels=3
)
is_found &= (
    (tracked > 12) & (tracked < [model.width - 13, model.height - 13])
).all(axis=1)
flow_px = np.linalg.norm(tracked - corners, axis=1)[is_found]
missing_px = np.linalg.norm(tracked - predicted, axis=1)[is_found]
print(f"{len(corners)} corners, {is_found.sum()} found in the next frame")
print(f"median displacement {np.median(flow_px):.1f} px")
print(f"median distance from the prediction {np.median(missing_px):.1f} px")

# %% [markdown]
# ## 6. Outliers
#
# A match of a static point satisfies the epipolar constraint. As the rotation
# is known from the gyroscope, only the direction $t$ of the translation is
# unknown:
#
# $$t^\top (R_c f_k \times f_{k+1}) = 0.$$
#
# Two matches determine $t$: it is orthogonal to both normals
# $R_c f_k \times f_{k+1}$.
# `dronevio.estimator.frontend.ransac.epipolar_inliers` draws pairs of matches,
# and keeps the direction with which most matches agree. To see it work, the
# next cell moves some matches to wrong places.

# %%
from dronevio.estimator.frontend.ransac import epipolar_inliers

CORRUPTED = 30
THRESHOLD_PX = 0.5

rng = np.random.default_rng(SEED)
pixels_0, pixels_1 = corners[is_found], tracked[is_found].copy()
wrong = rng.choice(len(pixels_1), CORRUPTED, replace=False)
pixels_1[wrong] += rng.uniform(-15.0, 15.0, (CORRUPTED, 2))
xy_0, xy_1 = model.normalize(pixels_0), model.normalize(pixels_1)
is_inlier = epipolar_inliers(xy_0, xy_1, R_c, THRESHOLD_PX / model.fx, rng)
accepted = is_inlier[wrong].sum()
print(f"{is_inlier.sum()} of {len(is_inlier)} matches are inliers")
print(f"{accepted} of {CORRUPTED} wrong matches are among them")
assert accepted < 0.2 * CORRUPTED, "wrong matches are accepted"

f_0, f_1 = model.unproject(pixels_0), model.unproject(pixels_1)
normals = np.cross(f_0 @ R_c.T, f_1)[is_inlier]
t = np.linalg.svd(normals)[2][-1]
true_t = (true_poses[1, :3, :3] @ R_ic).T @ (
    true_poses[1, :3, 3] - true_poses[0, :3, 3]
)
angle = np.degrees(np.arccos(abs(t @ true_t) / np.linalg.norm(true_t)))
print(f"the direction of translation is {angle:.1f}° off the true one")

# %% jupyter={"source_hidden": true}
# Figure: the matches of two frames: inliers green, outliers red
figure, ax = plt.subplots(figsize=(7.5, 4.8), layout="constrained")
ax.imshow(second, cmap="gray", alpha=0.7)
for a, b, good in zip(pixels_0, pixels_1, is_inlier, strict=True):
    ax.plot(
        *np.transpose([a, b]), color="#009e73" if good else "red", linewidth=1.5
    )
ax.plot(*pixels_1[is_inlier].T, ".", color="#009e73", markersize=4)
ax.set_title("displacements from frame 32 to frame 35")
ax.axis("off")
plt.show()

# %% [markdown]
# The wrong matches that are accepted lie on the epipolar plane by chance. The
# smoother rejects them later by their reprojection errors.
#
# `dronevio.estimator.frontend.tracker.FeatureTracker` combines these steps,
# aligns each feature with the image in which it was first seen, and adds
# corners where features are missing. The next cell tracks through all five
# frames.

# %%
from dronevio.estimator.frontend.tracker import FeatureTracker, TrackerConfig

tracker = FeatureTracker(model, TrackerConfig())
tracker.track(images[0], np.eye(3))
observations = [tracker.replenish()]
for image, part in zip(images[1:], increments, strict=True):
    R_c = R_ic.T @ part.rotation(start.gyro_bias_rad_s).T @ R_ic
    kept = tracker.track(image, R_c)
    observations.append(tracker.replenish())
    print(
        f"{len(kept)} features tracked, {len(observations[-1])} with new ones"
    )

# %% [markdown]
# ## 7. Triangulation
#
# A landmark is the point nearest to its rays. With the camera positions $c_i$
# and the rays $f_i$ in the world frame, it solves
#
# $$\sum_i (I - f_i f_i^\top) \, l = \sum_i (I - f_i f_i^\top) \, c_i .$$
#
# `dronevio.estimator.backend.triangulation.triangulate` solves this for all
# landmarks, and refines them by Gauss-Newton steps on the reprojection errors.
# Here the poses are those of the prediction.

# %%
from dronevio.estimator.backend.triangulation import triangulate

cameras = [state.T_world_imu @ camera.T_imu_cam for state in reckoned]
common = sorted(
    set.intersection(*(set(observed.ids.tolist()) for observed in observations))
)
nearest = []
for identity in common:
    A, b = np.zeros((3, 3)), np.zeros(3)
    for T, observed in zip(cameras, observations, strict=True):
        x, y = observed.xy[observed.ids == identity][0]
        f = T[:3, :3] @ np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
        A += np.eye(3) - np.outer(f, f)
        b += (np.eye(3) - np.outer(f, f)) @ T[:3, 3]
    nearest.append(np.linalg.solve(A, b))
landmarks = np.array(nearest)

xy = np.array(
    [
        observed.xy[observed.ids == i][0]
        for i in common
        for observed in observations
    ]
)
Ts = np.array(cameras * len(common))
result = triangulate(
    np.arange(len(common)) * 5, Ts[:, :3, :3], Ts[:, :3, 3], xy
)
far = np.linalg.norm(landmarks - cameras[0][:3, 3], axis=1)
change = np.linalg.norm(result.points - landmarks, axis=1) / far
print(f"{len(common)} landmarks are observed in all five frames")
print(f"median depth {np.median(result.depth_m):.2f} m")
print(f"median parallax {np.degrees(np.median(result.parallax_rad)):.1f}°")
print(
    f"median change by the refinement {np.median(change):.1%} of the distance"
)
print(f"median reprojection error {model.fx * np.median(result.rms):.1f} px")

# %% [markdown]
# The reprojection errors are of several pixels, because the predicted poses are
# wrong. The features themselves are accurate to a fraction of a pixel. This
# contradiction is the information by which the poses are corrected.
#
# ## 8. Smoothing
#
# The smoother finds the states and landmarks that agree best with all
# measurements: with the prior of the first state, with the IMU between frames,
# and with the observations,
#
# $$\begin{split}
# \min_{x, \, l} \; |r_0|^2_{P_0} &+ \sum_k |r_{\text{imu}}(x_k, x_{k+1})|^2_{\Sigma_k} \\
# &+ \sum_{k, j} \rho\big(|r_{\text{cam}}(x_k, l_j)|^2_{\sigma}\big)
# \end{split}$$
#
# where each squared residual is weighted by the inverse of its covariance, and
# $\rho$ is a robust loss (Cauchy). A Gauss-Newton step solves the normal
# equations $H \, \delta = b$. The landmarks are many, but each is connected
# only to the frames that observe it, and not to other landmarks. They are
# eliminated by the Schur complement,
#
# $$\big(H_{xx} - H_{xl} H_{ll}^{-1} H_{lx}\big) \, \delta_x = b_x - H_{xl} H_{ll}^{-1} b_l ,$$
#
# which leaves 15 unknowns for each frame. The same operation marginalizes old
# frames: the inverse of the Schur complement is the covariance of what remains.
# The next cell verifies this property of
# `dronevio.estimator.optimization.linalg.schur_complement` with random numbers.

# %%
from dronevio.estimator.optimization.linalg import schur_complement

A = rng.standard_normal((30, 9))
H, b = A.T @ A, rng.standard_normal(9)
is_removed = np.arange(9) >= 5
H_x, b_x = schur_complement(H, b, is_removed)
print(
    "covariances agree:",
    np.allclose(np.linalg.inv(H_x), np.linalg.inv(H)[:5, :5]),
)
print(
    "solutions agree:  ",
    np.allclose(np.linalg.solve(H_x, b_x), np.linalg.solve(H, b)[:5]),
)

# %% [markdown]
# `dronevio.estimator.backend.smoother.KeyframeSmoother` adds one frame after
# another. Each begins at the prediction by the IMU from the smoothed state
# before.

# %%
smoother = smoother_at(start, observations[0])
smoothed = [start]
for k, part in enumerate(increments, start=1):
    propagation = ImuPropagation(
        noise, imu, smoother.state, smoother.gtsam_state
    )
    propagation.add(part)
    before_mm, _ = position_error_mm(propagation.state_at(int(t_ns[k])), k)
    update = smoother.add_keyframe(
        Keyframe(int(t_ns[k]), propagation.preintegrated, observations[k])
    )
    smoothed.append(smoother.state)
    after_mm, _ = position_error_mm(smoother.state, k)
    count, rejected = len(smoother.landmarks), len(update.rejected)
    print(f"frame {frames[k]}: {count:3d} landmarks, {rejected} rejected")
    print(
        f"  position error {before_mm:4.1f} mm before, {after_mm:4.1f} mm after"
    )

R_error = true_poses[-1, :3, :3].T @ smoother.state.T_world_imu[:3, :3]
print(f"orientation error {np.degrees(np.linalg.norm(log_so3(R_error))):.2f}°")
assert after_mm < 15.0, "the smoothed position is wrong"

# %% [markdown]
# In the second frame nothing changes: a landmark needs three observations and
# some parallax, and until then only the IMU constrains the state. From the
# third frame on, the camera corrects the tilt. It does not measure the tilt
# directly. But a wrong tilt predicts a wrong motion, with which the images
# disagree.
#
# ## 9. Covariance
#
# The covariance of the newest state is a block of the inverse of the reduced
# matrix. It states how accurate the estimate is, if all noise models are right.
# The normalized estimation error squared (NEES),
#
# $$\varepsilon = e^\top P^{-1} e ,$$
#
# with the error $e$ of the position, has the expectation 3. A much larger value
# means that the estimator is overconfident.

# %% jupyter={"source_hidden": true}
# Figure: errors and standard deviations of dead reckoning and of smoothing
figure, ax = plt.subplots(figsize=(7, 3.6), layout="constrained")
seconds = (t_ns - t_ns[0]) * 1e-9
for name, states, colour in (
    ("IMU alone", reckoned, "#0072b2"),
    ("IMU and camera", smoothed, "#d55e00"),
):
    errors_mm, sigmas_mm = np.transpose(
        [position_error_mm(s, k) for k, s in enumerate(states)]
    )
    ax.plot(
        seconds[1:],
        sigmas_mm[1:],
        color=colour,
        label=f"{name}: standard deviation",
    )
    ax.plot(
        seconds[1:], errors_mm[1:], "o", color=colour, label=f"{name}: error"
    )
ax.set(xlabel="time [s]", ylabel="position [mm]", yscale="log")
ax.grid(alpha=0.3, which="both")
ax.legend(fontsize="small")
plt.show()

# %%
for name, states in (("IMU alone", reckoned), ("IMU and camera", smoothed)):
    e, P = (
        states[-1].T_world_imu[:3, 3] - true_poses[-1, :3, 3],
        states[-1].covariance,
    )
    assert P is not None
    nees = e @ np.linalg.solve(P[3:6, 3:6], e)
    print(f"{name}: NEES of the last position {nees:.2f}")
assert nees < 16.3, "the estimator is overconfident"

# %% [markdown]
# Both are below 3, because the assumed standard deviation of the initial tilt,
# 5.7°, is larger than its error. A single value says little;
# `dronevio evaluate` computes the mean over a flight with its bounds.
#
# ## 10. The whole flight
#
# The complete estimator also decides which frames become keyframes, detects
# whether the drone is stationary, estimates the noise of the IMU and the
# calibration, and reports its health. It initializes itself.

# %%
run = dv.estimate(recording)
scores = dv.evaluate(recording, run).scores
print(f"{scores.n_poses} poses over {scores.path_m:.2f} m")
print(f"RMS error of the position {1e3 * scores.ate_m.rmse:.1f} mm")

# %% [markdown]
# ## Exercises
#
# **1. Less information.** In section 8, give the smoother only every fourth
# feature: `observations[k]` becomes `observations[k].without(ids)`, where `ids`
# are the others. How do error and standard deviation change?
#
# <details markdown="1"><summary>Hint</summary>
#
# Replace `observations[k]` by `observations[k].without(ids[ids % 4 != 0])` with
# `ids = observations[k].ids`. Of 119 landmarks, 30 remain. The error of the
# last position is 4.6 mm instead of 0.7 mm, and the standard deviation 9.0 mm
# instead of 7.1 mm. With independent errors of the landmarks alone, it would be
# twice as large. A part of it is common to all landmarks: the bias of the
# accelerometer, which can hardly be distinguished from a tilt within 0.6 s.
#
# </details>
#
# **2. A wrong prediction.** The drone hardly rotates here, so that the
# gyroscope is not needed. In section 5, rotate the prediction by an angle α
# about the y axis of the camera:
# `predicted = model.project(f_first @ exp_so3([0.0, α, 0.0]).T)`. With which α
# does tracking fail? Compare with the range of Lucas-Kanade, about half a
# window times $2^3$, for three additional pyramid levels.
#
# <details markdown="1"><summary>Answer</summary>
#
# Half a window is 5.5 px, and times eight 44 px, or 5.5° with a focal length of
# 459 px. The inliers of section 6 decrease from 101 to 76 with 4°, 52 with 8°
# and 24 with 12°. A drone that turns at 80 °/s rotates by 12° between two of
# these frames.
#
# </details>
#
# **3. The tilt and its standard deviation.** Set `TILT_ERROR_DEG = 10.0`. Is it
# still corrected? And what happens if the assumed standard deviation is too
# small, `InitialSigmas(tilt_rad=0.005)`?
#
# <details markdown="1"><summary>Answer</summary>
#
# With 10°, almost twice the assumed standard deviation, the third frame is
# still wrong by 5 cm, because the linearization is inaccurate, and three
# correct landmarks are rejected; the last frame is wrong by 2 mm. With an
# assumed standard deviation of 0.005 rad (0.3°), an error of 3° is ten standard
# deviations. The smoother trusts the prior and corrects only 0.7° of it. An
# assumption that is too confident is worse than one that is too cautious.
#
# </details>
#
# ## What to change to see it break
#
# Each of these changes makes a check of the lesson fail with an
# `AssertionError`.
#
# **The calibration of the camera.** In section 1, rotate the camera by 5° in
# its mount. The error of the position grows to several centimetres, and the
# standard deviation does not show it: the covariance holds only if the model is
# right.
#
# ```python
# EXTRINSIC_ERROR_DEG = 5.0
# ```
#
# **The synchronization.** In section 1, give each time stamp the image of one
# frame earlier. The images then contradict the IMU by 50 ms.
#
# ```python
# IMAGE_DELAY = 1
# ```
#
# **The outlier threshold.** In section 6, accept matches up to 50 px from their
# epipolar plane. All wrong matches pass.
#
# ```python
# THRESHOLD_PX = 50.0
# ```
