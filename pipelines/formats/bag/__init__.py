"""ROS 1 and ROS 2 bags: messages in and out, image decoding."""
