"""The brokers of ``tests/outputs`` serve here too."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "mqtt"))
