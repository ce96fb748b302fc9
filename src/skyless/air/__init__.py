"""What flies: beacon frames and their bytes, the almanac, the schedule, and what a radio reports of a frame."""
