"""The simulated radio world, and fleets of tags in it."""
