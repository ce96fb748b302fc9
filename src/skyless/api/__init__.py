"""What programs and notebooks call: the commands simulate, replay, plan, calibrate and study as plain functions.

Each function takes keyword arguments with the defaults of its command, computes with the same code, prints nothing, and
returns a frozen result: figures, NumPy arrays, a table for pandas, a picture.

Public: calibrate, plan, replay, simulate, study.
Within the package: fixes, floor_result, inputs, result, slot_plan.
"""
