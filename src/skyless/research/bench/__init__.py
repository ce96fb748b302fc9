"""Speed of the program on this machine."""
