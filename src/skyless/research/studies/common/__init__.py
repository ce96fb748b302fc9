"""What all studies use."""
