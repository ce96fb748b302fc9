"""Types of arrays. Docstrings say the shape; a name that says it, too, is used where it helps."""

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
"""Indices that cannot count from an array's end, for which kernels would have to look at each."""

Mask = NDArray[np.bool_]

Records = NDArray[np.void]
"""Of a structured type."""
