"""MAVLink, for autopilots: positions of a tag as ArduPilot, PX4 and GPS drivers accept them."""
