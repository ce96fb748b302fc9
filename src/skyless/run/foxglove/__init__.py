"""Messages for Foxglove."""
