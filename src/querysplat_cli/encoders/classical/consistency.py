"""Comparing the depths of all views: which ones others confirm, and which guesses stand in free space."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numba as nb
import numpy as np

from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.patchmatch import Source, projections

# Plain numbers, since a compiled kernel cannot read a dataclass.
_LEAST_AGREEMENT, _MOST_AGREEMENT = DEPTH_POLICY.agreement
_MEASURED_CONFIDENCE = DEPTH_POLICY.measured_confidence
_IN_FRONT = DEPTH_POLICY.in_front
_IN_FRONT_OF_GUESS = DEPTH_POLICY.in_front_of_guess
_OTHER_COLOUR, _SAME_COLOUR = DEPTH_POLICY.other_colour, DEPTH_POLICY.same_colour
_PUSH_BACK = DEPTH_POLICY.push_back


@dataclass(frozen=True)
class DepthMaps:
    """What is known of all views, [views, height, width].

    `inverse` depth is positive everywhere, and means nothing where `masks` are False. `confidence` is in [0, 1], and
    `colours` [views, height, width, 3] are pictures that `blurred` made.
    """

    inverse: np.ndarray
    confidence: np.ndarray
    colours: np.ndarray
    masks: np.ndarray


def confirm(
    inverse: np.ndarray, masks: np.ndarray, match: np.ndarray, photos: Sequence[Source], sources: Sequence[list[int]]
) -> np.ndarray:
    """Confidence [views, height, width] in [0, 1] of depths that the views' sources confirm.

    It is 1 where two sources find the same surface, 1/2 where one of several does, and less where the match is poor.
    `inverse` depth, `masks` and matching cost `match` (0 perfect, 1 none) are [views, height, width]; no depth outside
    the masks confirms another. Of `photos`, the cameras are read. `sources` are the views that each view was measured
    against.
    """
    policy = DEPTH_POLICY
    shown = np.where(masks, inverse, 0)
    confidence = np.zeros(inverse.shape, np.float32)
    for v, others in enumerate(sources):
        if not others:
            continue
        leads, shifts = projections(photos[v], [photos[s] for s in others])
        baselines = np.array([photos[s].baseline(photos[v]) for s in others])
        votes = np.zeros(inverse.shape[1:], np.float32)
        _vote(votes, shown, inverse[v], np.array(others), leads, shifts, baselines)
        confidence[v] = np.minimum(votes / min(2, len(others)), 1) * np.clip(1 + policy.forgiven_cost - match[v], 0, 1)
        confidence[v] *= _outside_specks(inverse[v], confidence[v] >= policy.guess_confidence)
    return confidence * masks


def lent(maps: DepthMaps, photos: Sequence[Source], others: list[list[int]]) -> np.ndarray:
    """Inverse depth [views, height, width] that the other views measured, seen from each view; 0 where there is none.

    A measurement counts where its colour is that of the pixel. Of several on one pixel, the nearest counts.
    """
    inverse, confidence, colours = maps.inverse, maps.confidence, maps.colours
    seeds = np.zeros_like(inverse)
    for v, compared in enumerate(others):
        for s in compared:
            leads, shifts = projections(photos[s], [photos[v]])
            _lend(seeds[v], colours[v], inverse[s], confidence[s], colours[s], leads[0], shifts[0])
    return seeds


def carve(maps: DepthMaps, photos: Sequence[Source], others: list[list[int]], least: list[float]) -> np.ndarray:
    """Inverse depth [views, height, width] in which no guess stands in free space: guesses move back along their rays.

    A guess must not hide a surface that another view measured. It must not hide guesses of another colour either,
    unless as many views agree with it in depth and colour. Where a view has no picture, it says nothing.
    For each view, `others` are the views to compare with, and `least` is the smallest inverse depth.
    """
    carved, shown = maps.inverse.copy(), np.where(maps.masks, maps.inverse, 0)
    for v, compared in enumerate(others):
        guess = (maps.confidence[v] < DEPTH_POLICY.guess_confidence) & maps.masks[v]
        if not compared or not guess.any():
            continue
        known = shown, maps.confidence, maps.colours
        there = np.array(compared), *projections(photos[v], [photos[s] for s in compared])
        _carve_view(carved[v], guess, maps.colours[v], *known, *there, least[v])
        carved[v][guess] = cv2.medianBlur(carved[v], 5)[guess]
    return carved


def blurred(pictures: np.ndarray) -> np.ndarray:
    """Pictures [views, height, width, 3] whose colours are compared, as means over small squares."""
    window = DEPTH_POLICY.colour_window
    return np.stack([cv2.blur(picture, (window, window)) for picture in pictures])


def _outside_specks(inverse: np.ndarray, sure: np.ndarray) -> np.ndarray:
    """False on `sure` pixels that form a small patch of their own; True elsewhere."""
    nothing = -30000
    levels = np.clip(np.log(inverse) / DEPTH_POLICY.speck_step * 16, -20000, 20000).astype(np.int16)
    levels[~sure] = nothing
    cv2.filterSpeckles(levels, nothing, DEPTH_POLICY.speck_pixels, 16)
    return (levels != nothing) | ~sure


@nb.njit(cache=True, error_model="numpy")
def _pixel(x, y, inverse_here, width, height, lead, shift):
    """Where a pixel's surface lies in another view: z over that of the pixel, column and row; z is 0 outside."""
    z = lead[2, 0] * x + lead[2, 1] * y + lead[2, 2] + inverse_here * shift[2]
    if z <= 1e-6:
        return 0.0, 0, 0
    u = (lead[0, 0] * x + lead[0, 1] * y + lead[0, 2] + inverse_here * shift[0]) / z
    v = (lead[1, 0] * x + lead[1, 1] * y + lead[1, 2] + inverse_here * shift[1]) / z
    if not (0 <= u < width and 0 <= v < height):
        return 0.0, 0, 0
    return z, int(u), int(v)


@nb.njit(cache=True, error_model="numpy")
def _surface(x, y, inverse_here, inverse, view, lead, shift):
    """Depth of the point in `view` over the view's own depth there, and that pixel; 0 outside the picture."""
    z, column, row = _pixel(x, y, inverse_here, inverse.shape[2], inverse.shape[1], lead, shift)
    if z <= 0:
        return 0.0, 0, 0
    return z / inverse_here * inverse[view, row, column], column, row


@nb.njit(cache=True, error_model="numpy", parallel=True)
def _vote(votes, inverse, own, views, leads, shifts, baselines):
    height, width = votes.shape
    for y in nb.prange(height):
        for x in range(width):
            here = float(own[y, x])
            for n in range(len(views)):
                ratio, _, _ = _surface(x + 0.5, y + 0.5, here, inverse, views[n], leads[n], shifts[n])
                tolerance = min(max(1 / (baselines[n] * here), _LEAST_AGREEMENT), _MOST_AGREEMENT)
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
            maps = inverse, confidence, blurred
            while here > least and _hides(x + 0.5, y + 0.5, here, colour[y, x], *maps, views, leads, shifts):
                here *= _PUSH_BACK
            carved[y, x] = max(here, least)


@nb.njit(cache=True, error_model="numpy")
def _hides(x, y, here, colour, inverse, confidence, blurred, views, leads, shifts):
    """Whether a guess of this inverse depth hides a measured surface, or more guesses than support it."""
    balance = 0
    for n in range(len(views)):
        ratio, column, row = _surface(x, y, here, inverse, views[n], leads[n], shifts[n])
        if ratio <= 0:
            continue
        if ratio < 1 - _IN_FRONT and confidence[views[n], row, column] >= _MEASURED_CONFIDENCE:
            return True
        difference = _difference(colour, blurred[views[n], row, column])
        if ratio < 1 - _IN_FRONT_OF_GUESS and difference > _OTHER_COLOUR:
            balance += 1
        elif abs(ratio - 1) < _IN_FRONT and difference < _SAME_COLOUR:
            balance -= 1
    return balance > 0


@nb.njit(cache=True, error_model="numpy")
def _lend(seeds, colour, inverse, confidence, blurred, lead, shift):
    """The larger inverse depths of another view's measurements of the same colour, on the pixels that they fall on."""
    height, width = seeds.shape
    for y in range(height):
        for x in range(width):
            here = float(inverse[y, x])
            if confidence[y, x] < _MEASURED_CONFIDENCE:
                continue
            z, column, row = _pixel(x + 0.5, y + 0.5, here, width, height, lead, shift)
            if z <= 0:
                continue
            if _difference(colour[row, column], blurred[y, x]) < _SAME_COLOUR:
                seeds[row, column] = max(seeds[row, column], here / z)


@nb.njit(cache=True, error_model="numpy")
def _difference(one, other):
    return max(abs(one[0] - other[0]), abs(one[1] - other[1]), abs(one[2] - other[2]))
