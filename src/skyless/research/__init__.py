"""Studies, figures of the paper, replays of recordings, benchmarks."""
