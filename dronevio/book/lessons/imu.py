# %% [markdown]
# # IMU factors, and the drift that a camera stops
#
# This lesson follows section 7.4.1 of F. Dellaert and S. Hutchinson,
# *Introduction to Robotics and Perception*
# ([roboticsbook.org](https://www.roboticsbook.org)): the samples of an inertial
# measurement unit (IMU) become factors of a graph, and the solution of the
# graph is a trajectory. The motion is that of section 7.2. The lesson computes
# each quantity twice where that is possible: once in a few lines of NumPy, from
# the equation, and once with the function of dronevio that the estimator uses.
#
# | symbol | meaning | unit |
# | --- | --- | --- |
# | $R_k$, $p_k$, $v_k$ | orientation (body to world), position and velocity at time $t_k$ | –, m, m/s |
# | $\omega$, $a$ | angular velocity and specific force, measured in the body frame | rad/s, m/s² |
# | $b_g$, $b_a$ | biases of gyroscope and accelerometer | rad/s, m/s² |
# | $g$ | gravity in the world frame, $(0, 0, -9.8)$ | m/s² |
# | $\Delta t$ | sampling interval | s |
# | $\mathrm{Exp}$, $\mathrm{Log}$ | exponential map of a rotation vector, and its inverse | rad |
#
# The body frame has x forward, y to the left and z up; the z axis of the world
# points up.

# %%
import matplotlib.pyplot as plt
import numpy as np
from dronevio.models.rotation import exp_so3, log_so3

SEED = 0

# %% [markdown]
# ## 1. The motion
#
# The drone has the constant velocity $(v, 0, 0)$ and the constant angular
# velocity $(0, -\omega, 0)$ in its body frame (section 7.2): it flies forward
# while its nose rises. This constant twist is a motion on a vertical circle of
# radius $r = v / \omega$:
#
# $$\begin{split}
# p(t) &= r \, (\sin \omega t, \; 0, \; 1 - \cos \omega t) \\
# R(t) &= \mathrm{Exp}\big((0, -\omega t, 0)\big)
# \end{split}$$
#
# The class `dronevio.estimator.book.loop.LoopFlight` describes this motion, and
# its method `states` returns orientation, position and velocity at any time.
# The default values are those of the chapter: 2 m/s, 30 °/s, 3.5 s, an IMU of
# 10 Hz. The setting `counting` is explained in exercise 1.

# %%
from dronevio.estimator.book.loop import LoopFlight

flight = LoopFlight(counting="equal")
print(f"radius {flight.radius_m:.3f} m, arc {np.degrees(flight.arc_rad):.0f}°")
print(f"samples of the IMU factors: {flight.factor_samples}")

# %% [markdown]
# ## 2. What the IMU measures
#
# The gyroscope measures the angular velocity. The accelerometer measures the
# specific force, the acceleration minus gravity. Both have a bias and white
# noise $n$:
#
# $$\begin{split}
# \omega_\text{measured} &= \omega + b_g + n_g \\
# a_\text{measured} &= R^\top (\dot v - g) + b_a + n_a
# \end{split}$$
#
# The chapter gives a noise density $\sigma$ of 0.5 °/√h for the gyroscope and
# 0.1 m/s/√h for the accelerometer. A sample that covers $\Delta t$ has noise
# with the standard deviation $\sigma / \sqrt{\Delta t}$. The accelerometer has
# the bias $(0, 0.1, 0)$ m/s², which the estimator knows.
#
# `dronevio.estimator.book.imu.simulate_samples` returns the samples. Each one
# contains the values at the start of its interval, and is held until the next
# one.

# %%
from dronevio.estimator.book.imu import simulate_samples

samples = simulate_samples(flight, np.random.default_rng(SEED))

# %% jupyter={"source_hidden": true}
# Figure: the three axes of the gyroscope and of the accelerometer over 3.5 s
t_s = np.arange(len(samples.dt_s)) * flight.dt_s
figure, (gyro, accel) = plt.subplots(1, 2, figsize=(8, 3), layout="constrained")
for axis, name in enumerate("xyz"):
    gyro.plot(t_s, np.degrees(samples.gyro_rad_s[:, axis]), ".-", label=name)
    accel.plot(t_s, samples.accel_m_s2[:, axis], ".-", label=name)
gyro.set(title="gyroscope", xlabel="time [s]", ylabel="angular velocity [°/s]")
accel.set(
    title="accelerometer", xlabel="time [s]", ylabel="specific force [m/s²]"
)
for axes in (gyro, accel):
    axes.grid(alpha=0.3)
    axes.legend()
plt.show()

# %% [markdown]
# The gyroscope shows −30 °/s about the y axis. The specific force begins near
# $g + v\omega$ = 9.8 + 1.05 m/s² upward, and moves from the z axis to the x
# axis while the nose rises: a drone that points straight up feels gravity along
# x. The y axis shows the bias.
#
# ## 3. Preintegration
#
# A factor between two states summarizes all samples between them. The sums
# below do not depend on the states, only on the samples and on the biases that
# are subtracted, so that they are computed once (Forster et al., "On-manifold
# preintegration for real-time visual-inertial odometry", T-RO 2017). With the
# corrected samples $\tilde\omega_k = \omega_k - b_g$ and
# $\tilde a_k = a_k - b_a$:
#
# $$\begin{split}
# \Delta R &\leftarrow \Delta R \, \mathrm{Exp}(\tilde\omega_k \Delta t) \\
# \Delta v &\leftarrow \Delta v + \Delta R \, \tilde a_k \, \Delta t \\
# \Delta p &\leftarrow \Delta p + \Delta v \, \Delta t + \tfrac12 \Delta R \, \tilde a_k \, \Delta t^2
# \end{split}$$
#
# The right-hand sides use the values before the step. The three sums describe
# the motion in the frame of the first state, as if there were no gravity and no
# initial velocity. Both are added when the sums are applied to a state:
#
# $$\begin{split}
# R_j &= R_i \, \Delta R \\
# v_j &= v_i + g \, T + R_i \, \Delta v \\
# p_j &= p_i + v_i \, T + \tfrac12 g \, T^2 + R_i \, \Delta p
# \end{split}$$
#
# where $T$ is the sum of the sampling intervals. The next cell contains both.

# %%
GRAVITY = np.array([0.0, 0.0, -9.8])
ACCEL_BIAS = np.array([0.0, 0.1, 0.0])
GYRO_BIAS = np.array([0.0, 0.0, 0.0])


def preintegrate(gyro_rad_s, accel_m_s2, dt_s):
    """Return rotation, velocity, position and time that samples add up to."""
    dR, dv, dp = np.eye(3), np.zeros(3), np.zeros(3)
    for gyro, accel in zip(
        gyro_rad_s - GYRO_BIAS, accel_m_s2 - ACCEL_BIAS, strict=True
    ):
        dp = dp + dv * dt_s + 0.5 * dR @ accel * dt_s**2
        dv = dv + dR @ accel * dt_s
        dR = dR @ exp_so3(gyro * dt_s)
    return dR, dv, dp, len(gyro_rad_s) * dt_s


def predict(state, preintegrated):
    """Return the state after the interval that the sums belong to."""
    (R, p, v), (dR, dv, dp, T) = state, preintegrated
    return (
        R @ dR,
        p + v * T + 0.5 * GRAVITY * T**2 + R @ dp,
        v + GRAVITY * T + R @ dv,
    )


# %% [markdown]
# Applied to one factor after another, from the true first state, these
# equations are dead reckoning.

# %%
truth = flight.states(flight.t_s)
factors, first = [], 0
for count in flight.factor_samples:
    rows = slice(first, first + count)
    factors.append(
        preintegrate(
            samples.gyro_rad_s[rows], samples.accel_m_s2[rows], flight.dt_s
        )
    )
    first += count

states = [(truth.R_world_imu[0], truth.p_world_imu[0], truth.velocity_m_s[0])]
for factor in factors:
    states.append(predict(states[-1], factor))
by_hand_m = np.array([p for _, p, _ in states])

for t, p, true_p in zip(flight.t_s, by_hand_m, truth.p_world_imu, strict=True):
    error_m = np.linalg.norm(p - true_p)
    x, y, z = p
    print(f"{t:.1f} s: ({x:.3f}, {y:.3f}, {z:.3f}) m, off by {error_m:.3f} m")

# %% [markdown]
# In the estimator, the class
# `dronevio.estimator.imu.preintegration.Preintegration` computes these sums
# with GTSAM, which also propagates their covariance, and their derivatives with
# respect to the biases. The experiment of the next section uses GTSAM in the
# same way, and its positions are those by hand.

# %%
from dronevio.estimator.book.imu import run_imu_experiment

experiment = run_imu_experiment(np.random.default_rng(SEED), flight)
difference_m = np.abs(experiment.Ts_world_imu[:, :3, 3] - by_hand_m).max()
print(
    f"positions by hand and those of the graph differ by {difference_m:.1e} m"
)
assert difference_m < 1e-3, (
    "the positions by hand differ from those of the graph"
)

# %% [markdown]
# ## 4. The factor graph and its solution
#
# `dronevio.estimator.book.imu.run_imu_experiment` builds the graph of the
# chapter and solves it. The unknowns are a pose $x_k$ and a velocity $v_k$ for
# each state and one bias $b_0$. An IMU factor connects two states and the bias;
# its residual is the difference between the states and the sums of section 3:
#
# $$\begin{split}
# r_R &= \mathrm{Log}\big(\Delta R^\top R_i^\top R_j\big) \\
# r_p &= R_i^\top \big(p_j - p_i - v_i T - \tfrac12 g T^2\big) - \Delta p \\
# r_v &= R_i^\top \big(v_j - v_i - g T\big) - \Delta v
# \end{split}$$
#
# The priors on $x_0$, $v_0$ and $b_0$ have σ = 0.1. The error of the graph is
# half the sum of all squared residuals, each divided by its standard deviation.
# Without further measurements, the number of residuals is that of unknowns.

# %%
# Figure: the factor graph of eight poses, eight velocities and one bias
from dronevio.book.imu_plots import draw_factor_graph

draw_factor_graph(experiment.factors)

# %% [markdown]
# The initial values are the true states with errors of 0.1 rad, 0.1 m and 0.1
# m/s, as in the chapter. The Levenberg-Marquardt method
# (`dronevio.estimator.book.optimization.solve_batch`) reaches an error of zero,
# except for rounding. The incremental method iSAM2
# (`dronevio.estimator.book.optimization.solve_incrementally`), which adds one
# state after another, has the same solution.

# %%
print(f"error before {experiment.initial_error:.3g}")
print(f"error after {experiment.final_error:.1e}")
print(f"iterations {experiment.iterations}")
print(
    f"difference of iSAM2 {experiment.incremental_difference:.1e} (rad, m, m/s)"
)
print(f"last position is {experiment.drift_m:.3f} m from the true one")

# %% [markdown]
# Why is the error zero and the position wrong by 15 cm? The error of a graph
# compares the states with the measurements, not with the truth. The next cell
# computes the residuals of the first factor at the true states and at the
# solution.


# %%
def residual(i, state_i, state_j):
    """Return the residual (9,) of factor i: rotation, position, velocity."""
    (Ri, pi, vi), (Rj, pj, vj), (dR, dv, dp, T) = state_i, state_j, factors[i]
    r_R = log_so3(dR.T @ Ri.T @ Rj)
    r_p = Ri.T @ (pj - pi - vi * T - 0.5 * GRAVITY * T**2) - dp
    r_v = Ri.T @ (vj - vi - GRAVITY * T) - dv
    return np.concatenate([r_R, r_p, r_v])


true_states = list(
    zip(truth.R_world_imu, truth.p_world_imu, truth.velocity_m_s, strict=True)
)
solution = [
    (pose[:3, :3], pose[:3, 3], v)
    for pose, v in zip(
        experiment.Ts_world_imu, experiment.velocity_m_s, strict=True
    )
]
for name, pair in (("truth", true_states), ("solution", solution)):
    r = np.asarray(1e3 * residual(0, pair[0], pair[1])).round(2) + 0.0
    print(f"residual at the {name}: {r[:3]} mrad, {r[3:6]} mm, {r[6:]} mm/s")

# %% [markdown]
# At the truth, the residual of the position is a few millimetres in each
# factor, from noise and, mostly, from the sampling: at 30 °/s, the specific
# force turns by 3° until the next sample, and the sample is held. The solution
# has no residual because it takes the wrong measurements for right. It is dead
# reckoning, written as an optimization. What the graph adds is the covariance,
# and the possibility to add other measurements.
#
# ## 5. The covariance of the path
#
# With the whitened Jacobian $A$ at the solution, the covariance of all unknowns
# is $(A^\top A)^{-1}$; `dronevio.estimator.book.optimization.LinearizedGraph`
# computes it by QR factorization, because the normal equations $A^\top A$
# square the condition number.

# %%
print(f"condition number of A: {experiment.condition:.1e}")
for source in experiment.sources:
    print(f"{source.name:<27} {source.sigma_m:7.3f} m")
print(f"{'root of the sum of squares':<27} {experiment.sigma_m[-1]:7.3f} m")

# %%
# Figure: the path from the side with ellipses of covariance
from dronevio.book.imu_plots import draw_imu_path

draw_imu_path(experiment)

# %% [markdown]
# The priors dominate. For a position, σ = 0.1 is 10 cm; for a tilt it is 5.7°,
# which lets gravity accelerate the estimate sideways, and for a gyroscope bias
# it is 5.7 °/s. With an exactly known first state and bias, the noise of this
# IMU makes the last position uncertain by 15 mm only.
#
# ## 6. The drift
#
# After 3.5 s the noise is hardly visible.
# `dronevio.estimator.book.drift.run_drift_study` repeats the flight for one
# minute with several IMUs, each with white noise and biases that walk from an
# exactly known start, and compares the spread of the positions with the
# prediction: the covariance propagated forward in time by
# `dronevio.estimator.imu.covariance.propagate_covariance`. For an IMU at rest,
# this covariance has the closed form
#
# $$\sigma_p^2 = \tfrac13 \sigma_a^2 t^3 + \tfrac1{20} \sigma_{ba}^2 t^5
#   + g^2 \big(\tfrac1{20} \sigma_g^2 t^5 + \tfrac1{252} \sigma_{bg}^2 t^7\big)$$
#
# for each horizontal axis, with the noise densities $\sigma_a$, $\sigma_g$ of
# the sensors and $\sigma_{ba}$, $\sigma_{bg}$ of the walks of their biases.

# %%
# Figure: the drift of five IMUs over one minute, measured and predicted
from dronevio.book.imu_plots import draw_drift
from dronevio.estimator.book.drift import run_drift_study
from dronevio.models.imu_presets import IMUS

DRIFT_FLIGHTS = 50
studies = {
    name: run_drift_study(
        imu, np.random.default_rng(SEED), runs=DRIFT_FLIGHTS, duration_s=60.0
    )
    for name, imu in IMUS.items()
}
draw_drift(studies)

# %% [markdown]
# Even the tactical IMU is wrong by metres after a minute. The prediction
# explains the measured spread; the remaining difference is about as large as
# one expects from 50 flights. The MPU-6050 drifts little only because its
# turn-on bias, 6.7 °/s, is known here; `studies["MPU-6050"].uncalibrated_rms_m`
# is the spread where it is not.
#
# ## 7. The same factors with a camera
#
# Now a camera observes landmarks on a sphere around the circle, each with an
# error of 1 px. Every observation of landmark $l$ at state $k$ is one more
# factor, with the residual
#
# $$r = \pi\big(T_\text{cam,imu} \, T_k^{-1} \, l\big) - z,$$
#
# where $\pi$ is the projection and $z$ the observed pixel.
# `dronevio.estimator.book.visual_inertial.run_camera_study` solves this graph
# every 2.5 s, each time with the measurements until then only.

# %%
# Figure: error over one minute with the IMU alone and with the camera
from dronevio.book.imu_plots import draw_camera
from dronevio.estimator.book.visual_inertial import run_camera_study

CAMERA_SECONDS = 60.0
study = run_camera_study(
    IMUS["euroc"],
    np.random.default_rng(SEED),
    runs=3,
    duration_s=CAMERA_SECONDS,
)
draw_camera(study, "euroc")

# %%
rms_m, sigma_m = study.rms_m, study.rms_sigma_m
print(
    f"RMS error and predicted standard deviation after {CAMERA_SECONDS:.0f} s:"
)
print(
    f"  IMU alone   {study.imu_rms_m[-1]:7.3f} m, {study.imu_sigma_m[-1]:7.3f} m"
)
print(f"  with camera {rms_m[-1]:7.3f} m, {sigma_m[-1]:7.3f} m")
worst = rms_m.argmax()
print(
    f"largest error with camera {rms_m[worst]:.3f} m, at {study.t_s[worst]:.1f} s"
)
assert rms_m[-1] < 0.5 * rms_m.max(), "the error still grows"

# %% [markdown]
# In the first round, which takes 12 s, the error grows: each new landmark is
# located relative to those before it. From the second round on, the camera
# observes landmarks that are already in the graph, and the drift has stopped.
# This is the reason for combining both sensors; section 7.4.3 of the book
# describes it in words, and the lesson `odometry` carries it out step by step.
#
# ## Exercises
#
# **1. Count the samples.** The loop in the chapter creates a factor after the
# samples 5, 10, and so on, and counts from 0. How many factors result, and how
# many samples does each have? Set `counting="book"` in section 1, and compare.
# Which states belong to the initial values that the chapter computes at 0.5 s,
# 1.0 s, and so on?
#
# <details markdown="1"><summary>Answer</summary>
#
# Six factors: the first contains the samples 0 to 5, which are six, the others
# five each, and the last four samples are unused. A sample covers the interval
# after it, so that the first factor ends at 0.6 s, not at 0.5 s; every state is
# one sample later than the time of its initial value. The optimizer corrects
# this, because the initial values determine only where it starts.
#
# </details>
#
# **2. Remove the effect of the sampling.** Section 4 claims that the sampling
# causes most of the error of 15 cm. Create the flight with `imu_rate_hz=200.0`
# and `samples_per_factor=100`. What remains?
#
# <details markdown="1"><summary>Hint</summary>
#
# Compare `experiment.drift_m` with `experiment.noise_free_drift_m`, the
# distance without any noise. The error of holding a sample is proportional to
# the interval, so that it decreases by a factor of 20, to 8 mm. The noise of
# the integrated motion does not depend on the rate, because its density is
# given; it makes the total 17 mm with this seed.
#
# </details>
#
# **3. Verify the closed form.** For the IMU `euroc` and t = 60 s, evaluate the
# formula of section 6 with the fields `gyro_noise_density`, `gyro_random_walk`,
# `accel_noise_density` and `accel_random_walk` of `IMUS["euroc"]`. Which term
# is the largest? Compare with `studies["euroc"].sigma_m[-1]`.
#
# <details markdown="1"><summary>Answer</summary>
#
# The walks of the biases dominate: 20 m are due to that of the gyroscope, whose
# tilt error lets gravity accelerate the estimate, 19 m to that of the
# accelerometer, 10 m to the noise of the gyroscope, and 0.5 m to that of the
# accelerometer. The root of the sum of the squares is 29 m. The study has 31 m.
# It adds three axes of a drone that flies on a circle, whereas the formula
# holds for one horizontal axis of a drone at rest, so that only the order of
# magnitude has to agree; `studies["euroc"].source_sigma_m` contains its four
# parts.
#
# </details>
#
# **4. Ask for less.** How many flights are needed to distinguish a ratio of
# 1.05 from 1 with two standard deviations? See
# `dronevio.estimator.book.drift.DriftStudy.ratio_sigma`, and change
# `DRIFT_FLIGHTS`.
#
# <details markdown="1"><summary>Answer</summary>
#
# The standard deviation of the ratio decreases with the square root of the
# number of flights. It has to be 0.025; with 50 flights
# `studies["euroc"].ratio_sigma` is 0.07, so that 50 · (0.07 / 0.025)² ≈ 400
# flights are needed.
#
# </details>
#
# ## What to change to see it break
#
# Each of these changes makes a check of the lesson fail with an
# `AssertionError`. Explain the error before you look at the reason.
#
# **Gravity.** In section 3, use a gravity that is wrong by one percent. The
# position by hand is wrong by ½ · 0.1 · 3.5² = 0.6 m: an IMU cannot distinguish
# an error of gravity from an acceleration.
#
# ```python
# GRAVITY = np.array([0.0, 0.0, -9.7])
# ```
#
# **Bias.** In section 3, do not subtract the bias of the accelerometer. The
# path by hand drifts sideways, also by 0.6 m.
#
# ```python
# ACCEL_BIAS = np.array([0.0, 0.0, 0.0])
# ```
#
# **No return.** In section 7, end the flight before the drone returns to known
# landmarks. The error is still growing: the camera alone reduces the drift, and
# only landmarks that are observed again stop it.
#
# ```python
# CAMERA_SECONDS = 10.0
# ```
