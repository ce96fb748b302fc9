"""Foreign recordings: what other people's tags wrote down, as a stream of packets or of time differences."""
