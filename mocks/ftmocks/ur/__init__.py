"""An emulated UR controller: RTDE, primary interface, dashboard server, Robot API and script ports, and the arm."""
