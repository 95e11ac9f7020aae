"""Types of arrays by their elements; each docstring states shape, unit and frame."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Float32Array = NDArray[np.float32]
Floats = NDArray[np.floating[Any]]  # single or double precision
Complexes = NDArray[np.complexfloating[Any, Any]]
Ints = NDArray[np.intp]  # indices
IntArray = NDArray[np.int64]
Int32Array = NDArray[np.int32]
Bools = NDArray[np.bool_]
Image = NDArray[np.uint8]  # (h, w) grey, or (h, w, 3) BGR
FloatImage = NDArray[np.float32]  # (h, w), or (h, w, 3)
