"""Bota Systems SensONE and Rokubi force/torque sensors on a serial port."""
