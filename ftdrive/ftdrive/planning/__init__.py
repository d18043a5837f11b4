"""Planning of the motion through the poses: reachable poses, moves proven clear, durations and predicted accuracy."""
