"""What is on the air: beacons and their bytes, the almanac's pages, and what a radio reports of a frame."""
