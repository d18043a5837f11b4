"""Plan a tour for a cell that does not exist yet, and see what it costs and how accurate it will be."""

import ftdrive

tool_mm = [(0, 60, 90), (60, 220, 120)]  # cylinders of sensor and gripper: from, to, diameter
wall_mm = [(0, 1, 0, -550)]  # everything stays where y >= -550 mm, in base axes

for poses in (6, 12, 24):
    plan = ftdrive.plan_tour("ur5e", tool_mm, poses, planes_mm=wall_mm, mass_kg=1.5)
    error_mN = 1e3 * plan.predicted["force_rms_N"]
    closest_mm = 1e3 * min(step.clearance_m for step in plan.steps)
    print(f"{poses:2} poses: {plan.motion_time_s:.0f} s, {closest_mm:.0f} mm clear, force error {error_mN:.0f} mN")

try:
    ftdrive.plan_tour("ur5e", [(0, 900, 120)])
except ftdrive.AcceptanceError as error:
    print("A tool of 900 mm:", str(error).partition(".")[0])
