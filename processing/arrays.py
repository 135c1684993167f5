"""Types of arrays, under one name each."""

import numpy as np
from numpy.typing import NDArray

#: float64, what all formulas compute in.
Array = NDArray[np.float64]
#: float32, images.
Image = NDArray[np.float32]
#: Any real floating type, for functions that take both.
RealArray = NDArray[np.floating]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
