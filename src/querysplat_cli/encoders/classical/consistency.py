"""What the views say about each other's depth: confirmation, and free space."""

import cv2
import numba as nb
import numpy as np

AGREEMENT = (0.02, 0.1)
"""Two views confirm each other up to one pixel of disparity, but within these relative depth differences."""
FORGIVEN = 0.3
"""Matching cost that takes nothing from the confidence."""
SPECK = 24
"""A confirmed patch of fewer pixels is an accident."""
SPECK_STEP = 0.03
"""Relative change of depth between neighbours of one patch."""
GUESS = 0.25
"""Confidence below which a depth is a guess."""
MEASURED = 0.5
"""Confidence from which a depth says that the space before it is empty."""
IN_FRONT = 0.05
"""A guess may stand before a measured surface by this fraction of its depth."""
IN_FRONT_OF_GUESS = 0.1
"""The same before another guess; up to `IN_FRONT` the two support each other."""
OTHER_COLOUR, SAME_COLOUR = 0.05, 0.1
"""Colour difference above which a guess cannot be what another view sees, and below which it can."""
COLOUR_WINDOW = 7
"""Colours are compared as means over so many pixels a side."""
PUSH = 0.9
"""A guess's inverse depth is lowered by this factor until it hides nothing."""


def confirm(
    inverse: np.ndarray, match: np.ndarray, K: np.ndarray, w2c: np.ndarray, sources: list[list[int]]
) -> np.ndarray:
    """Confidence [views, height, width] in [0, 1]: how many of its sources put a surface where a view saw one.

    `inverse` depths and `match` (0 perfect, 1 none) are [views, height, width]; cameras in float64.
    """
    confidence = np.zeros(inverse.shape, np.float32)
    for v, others in enumerate(sources):
        if not others:
            continue
        views, leads, shifts = _projections(v, others, K, w2c)
        baselines = np.array([np.linalg.norm((w2c[s] @ np.linalg.inv(w2c[v]))[:3, 3]) * K[s, 0, 0] for s in others])
        votes = np.zeros(inverse.shape[1:], np.float32)
        _vote(votes, inverse, inverse[v], views, leads, shifts, baselines)
        confidence[v] = np.minimum(votes / min(2, len(others)), 1) * np.clip(1 + FORGIVEN - match[v], 0, 1)
        confidence[v] *= _patches(inverse[v], confidence[v] >= GUESS)
    return confidence


def carve(
    inverse: np.ndarray,
    confidence: np.ndarray,
    pictures: np.ndarray,
    K: np.ndarray,
    w2c: np.ndarray,
    others: list[list[int]],
    least: list[float],
) -> np.ndarray:
    """Inverse depth [views, height, width] with guesses pushed back along their rays out of free space.

    A guess must not hide what another view measured. It must not hide other guesses of another colour either,
    unless as many views agree with it in depth and colour. `pictures` are [views, height, width, 3] in [0, 1],
    `others` are the views to ask for each view, `least` is the smallest inverse depth of each view.
    """
    carved = inverse.copy()
    blurred = np.stack([cv2.blur(picture, (COLOUR_WINDOW, COLOUR_WINDOW)) for picture in pictures])
    for v, asked in enumerate(others):
        guess = confidence[v] < GUESS
        if not asked or not guess.any():
            continue
        known = inverse, confidence, blurred
        _carve_view(carved[v], guess, blurred[v], *known, *_projections(v, asked, K, w2c), least[v])
        carved[v][guess] = cv2.medianBlur(carved[v], 5)[guess]
    return carved


def _projections(
    view: int, others: list[int], K: np.ndarray, w2c: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Numbers of the other views, and A, b so that a pixel p of inverse depth q falls on A·p + q·b in them."""
    back, to_rays = np.linalg.inv(w2c[view]), np.linalg.inv(K[view])
    relative = [w2c[s] @ back for s in others]
    leads = np.stack([K[s] @ T[:3, :3] @ to_rays for s, T in zip(others, relative, strict=True)])
    shifts = np.stack([K[s] @ T[:3, 3] for s, T in zip(others, relative, strict=True)])
    return np.array(others), leads, shifts


def _patches(inverse: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """False on sure pixels that form a small island of their own."""
    nothing = -30000
    levels = np.clip(np.log(inverse) / SPECK_STEP * 16, -20000, 20000).astype(np.int16)
    levels[~sure] = nothing
    cv2.filterSpeckles(levels, nothing, SPECK, 16)
    return (levels != nothing) | ~sure


@nb.njit(cache=True, error_model="numpy")
def _surface(x, y, inverse_here, inverse, view, lead, shift):
    """Depth of the point in `view` over the depth measured there, and where; 0 outside the picture."""
    height, width = inverse.shape[1:]
    z = lead[2, 0] * x + lead[2, 1] * y + lead[2, 2] + inverse_here * shift[2]
    if z <= 1e-6:
        return 0.0, 0, 0
    u = (lead[0, 0] * x + lead[0, 1] * y + lead[0, 2] + inverse_here * shift[0]) / z
    v = (lead[1, 0] * x + lead[1, 1] * y + lead[1, 2] + inverse_here * shift[1]) / z
    if not (0 <= u < width and 0 <= v < height):
        return 0.0, 0, 0
    return z / inverse_here * inverse[view, int(v), int(u)], int(u), int(v)


@nb.njit(cache=True, error_model="numpy", parallel=True)
def _vote(votes, inverse, own, views, leads, shifts, baselines):
    height, width = votes.shape
    for y in nb.prange(height):
        for x in range(width):
            here = float(own[y, x])
            for n in range(len(views)):
                ratio, _, _ = _surface(x + 0.5, y + 0.5, here, inverse, views[n], leads[n], shifts[n])
                tolerance = min(max(1 / (baselines[n] * here), AGREEMENT[0]), AGREEMENT[1])
                if ratio > 0 and abs(ratio - 1) < tolerance:
                    votes[y, x] += 1


@nb.njit(cache=True, error_model="numpy", parallel=True)
def _carve_view(carved, guess, colour, inverse, confidence, blurred, views, leads, shifts, least):
    height, width = carved.shape
    for y in nb.prange(height):
        for x in range(width):
            if not guess[y, x]:
                continue
            here = float(carved[y, x])
            known = inverse, confidence, blurred
            while here > least and _hides(x + 0.5, y + 0.5, here, colour[y, x], *known, views, leads, shifts):
                here *= PUSH
            carved[y, x] = max(here, least)


@nb.njit(cache=True, error_model="numpy")
def _hides(x, y, here, colour, inverse, confidence, blurred, views, leads, shifts):
    balance = 0
    for n in range(len(views)):
        ratio, column, row = _surface(x, y, here, inverse, views[n], leads[n], shifts[n])
        if ratio <= 0:
            continue
        if ratio < 1 - IN_FRONT and confidence[views[n], row, column] >= MEASURED:
            return True
        strange = _difference(colour, blurred[views[n], row, column])
        if ratio < 1 - IN_FRONT_OF_GUESS and strange > OTHER_COLOUR:
            balance += 1
        elif abs(ratio - 1) < IN_FRONT and strange < SAME_COLOUR:
            balance -= 1
    return balance > 0


@nb.njit(cache=True, error_model="numpy")
def _difference(one, other):
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]), abs(one[2] - other[2]))
