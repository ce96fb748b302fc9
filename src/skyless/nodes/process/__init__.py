"""What every program of a running site needs of its process."""
