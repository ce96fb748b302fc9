"""The figures of the paper, made again."""
