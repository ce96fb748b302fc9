"""The site file: read, checked, written, and advice about it."""
