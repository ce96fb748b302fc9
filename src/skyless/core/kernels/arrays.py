"""Types of arrays. Docstrings state the shape; a name that states it as well is used where it helps."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Of any shape."""

Vector = NDArray[np.float64]
"""With one dimension."""

Matrix = NDArray[np.float64]
"""With two dimensions."""

Integers = NDArray[np.int64]

Indices = NDArray[np.uint32]
"""Indices that cannot count from an array's end, which kernels would have to check for each."""

Mask = NDArray[np.bool_]

Records = NDArray[np.void]
"""Of a structured type."""
