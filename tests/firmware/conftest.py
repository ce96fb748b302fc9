"""Tests of the firmware find the emulator, and the stages of chips and radios."""

import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "firmware"))
sys.path.append(str(ROOT / "tests" / "radios"))
