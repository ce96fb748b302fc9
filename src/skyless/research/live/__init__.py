"""Tags on radios of other makers."""
