"""The UR controller: RTDE, dashboard and script ports, and the arm behind them."""
