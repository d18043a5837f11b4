"""ftdrive: calibrate a wrist force/torque sensor on a Universal Robots arm, and see the true contact force."""
