"""Universal Robots arms, through ur_rtde."""
