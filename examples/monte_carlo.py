"""Is the stated uncertainty right? Draw many sessions of one planned tour, solve each, and look at the scatter."""

import numpy as np

import ftcalib
import ftdrive

plan = ftdrive.plan_tour("ur5e", [(0, 200, 100)], 12)
truth = ftcalib.Parameters(
    R_flange_sensor=np.eye(3),
    gravity_force_base_N=np.array([0.0, 0.0, -1.2 * 9.80665]),
    force_bias_N=np.array([5.0, -3.0, 8.0]),
    p_sensor_com_m=np.array([0.0, 0.01, 0.06]),
    torque_bias_Nm=np.zeros(3),
)
sigma = np.repeat([0.05, 0.003], 3)  # of the mean of one pose, N and N·m
rng = np.random.default_rng(0)

errors, stated = [], []
for _ in range(50):
    wrench = ftcalib.predict(truth, plan.R_base_flange) + rng.normal(0, sigma, (len(plan.steps), 6))
    dataset = ftdrive.CalibrationDataset.of(plan.R_base_flange, wrench, wrench_cov=np.diag(sigma**2), n_samples=500)
    result = ftdrive.solve(dataset)
    errors.append(result.force_bias_N - truth.force_bias_N)
    stated.append(result.sigma["force_bias_N"])

scatter_N, stated_N = np.std(errors, axis=0), np.array(stated)
inside = np.mean(np.abs(errors) < 1.96 * stated_N)
print(f"{len(plan.steps)} poses, 50 sessions, force bias on three axes")
print(f"scatter      {scatter_N.round(3)} N")
print(f"stated sigma {stated_N.mean(axis=0).round(3)} N")
print(f"{inside:.0%} of the errors are within 1.96 sigma")
