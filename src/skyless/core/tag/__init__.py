"""From received frames to fixes: receivers, the almanac that they keep, start and methods of positioning."""
