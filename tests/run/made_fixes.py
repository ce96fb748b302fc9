"""Fixes whose serial number can be found in a history."""

from itertools import chain

import numpy as np
from pyarrow import parquet

from skyless.run.fix_batch import RECORD
from skyless.run.history.layout import current_files
from support.site_messages import a_fix, diagonal

DAY_S = 86_400.0
NOON_S = 1_795_176_000.0
"""A noon, UTC."""


def records(serials, tag=1, unix_s=None):
    """Records whose ``x_mm`` are the serials, one a millisecond unless a time is given."""
    rows = np.zeros(len(serials), RECORD)
    rows["tag"], rows["std_z_mm"], rows["hpl_cm"] = tag, 65535, 65535
    rows["position_mm"][:, 0] = serials
    rows["unix_us"] = [1000 * serial for serial in serials] if unix_s is None else round(1e6 * unix_s)
    return rows


def fix(tag="tag1", serial=1, unix_s=NOON_S, position_m=(1.0, 2.0, 3.0), variances=(4e-4, 9e-4, 1e-4), **more):
    """A message."""
    given = {"serial": serial, "unix_s": unix_s, "position_m": position_m, "std_m": sum(variances) ** 0.5}
    return a_fix(tag, **given | {"covariance_m2": diagonal(*variances), "height_known": False} | more)


def in_files(folder, site=1):
    """The serials in the current files, in the order of their numbers where each file is sorted by them."""
    tables = (parquet.read_table(file, partitioning=None) for file in current_files(folder, site))
    return list(chain.from_iterable(table["x_mm"].to_pylist() for table in tables))
