"""Sensors and arms of any make by ROS 2 topics, and the way to rclpy."""
