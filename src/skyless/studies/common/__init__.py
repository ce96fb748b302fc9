"""What studies share: their plan and rows, simulated worlds, the runner, summaries, pictures.

Public: picture, plan, runner, sides, summary, worlds.
"""
