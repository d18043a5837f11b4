"""Robotiq FT 300 and FT 300-S force/torque sensors."""
