"""Types of arrays. Docstrings state the shape; some names state it too."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""An array of any shape."""

Vector = NDArray[np.float64]
"""An array with one dimension."""

Matrix = NDArray[np.float64]
"""An array with two dimensions."""

Integers = NDArray[np.int64]

Indices = NDArray[np.uint32]
"""Indices that cannot be negative."""

Mask = NDArray[np.bool_]

Records = NDArray[np.void]
"""An array of a structured type."""
