"""ATI force/torque sensors on CAN, RS-485 and Ethernet."""
