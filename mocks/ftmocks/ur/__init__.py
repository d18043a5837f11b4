"""The UR controller: RTDE, primary interface, dashboard, Robot API and script ports, and the arm behind them."""
