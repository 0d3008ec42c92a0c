"""ROS bags into the survey: topics, clocks, frames, photographs."""
