"""The compensated wrench as topics of ROS 2."""
