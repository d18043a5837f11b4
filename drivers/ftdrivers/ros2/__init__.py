"""Sensors and arms of any make that publish on ROS 2 topics, and access to rclpy."""
