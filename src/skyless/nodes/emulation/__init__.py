"""Programs that stand in for hardware: the emulated air, emulated boards."""
