"""Files that run unchanged on a board under MicroPython and here; they import nothing of Skyless."""
