"""ftdrive: calibrate a wrist force/torque sensor on a Universal Robots arm, and see the true contact force."""

__version__ = "0.1.0"
