"""Robotous RFT force/torque sensors: one driver, two wires."""
