"""ROS 2: fixes as its messages, and a target that publishes them by DDS without ROS being installed."""
