"""ROS 2 without an installation of ROS: message types, and nodes through rclpy, Cyclone DDS or zenoh."""
