"""Pictures of little contrast, which are dark or were taken in fog."""

import numpy as np


def stretch(values: np.ndarray, little: tuple[float, float], usual: float) -> tuple[float, float] | None:
    """The level to take away, and then the factor, that give brightnesses the `usual` contrast; None where it stays.

    Contrast lies between the darkest and the brightest hundredth. From the first number of `little` up to the second,
    it is too little; below, only noise would become larger.
    """
    low, high = np.percentile(values, (1, 99)) if values.size else (0.0, 0.0)
    least, most = little
    return (low, usual / (high - low)) if least <= high - low < most else None
