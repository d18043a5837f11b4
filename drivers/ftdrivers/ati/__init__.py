"""ATI force/torque sensors: one codec and one calibration model, two wires."""
