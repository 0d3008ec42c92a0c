"""ROS 1 and ROS 2 bags: reading and writing of messages, decoding of images."""
