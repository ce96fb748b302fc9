"""Fixes of a Skyless site in ROS 2: the program ``node``, its ``messages``, and the estimator ``map_odom``."""
