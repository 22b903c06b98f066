"""Codebooks and palettes: a few values that stand for many."""

import numpy as np

ROUNDS = 12
"""Of Lloyd's iteration for a codebook; it hardly changes any more after that."""
PALETTE_ROUNDS = 2
MOST_PRODUCTS = 2e10
"""A palette is refined where its distances take no more products than this, which is about a second."""
ROWS_AT_ONCE = 512
CODES = 256
"""Entries of a codebook: what a byte can count."""


def codebook(values: np.ndarray) -> np.ndarray:
    """At most `CODES` ascending float32 numbers for the values of any shape: one-dimensional k-means."""
    flat = np.sort(values.astype(np.float64), axis=None)
    if len(np.unique(flat)) <= CODES:
        return np.unique(flat.astype(np.float32))
    sums = np.concatenate([[0.0], np.cumsum(flat)])
    # Half of the entries are spread over the range, half over the values, so that outliers get their share.
    even = np.linspace(flat[0], flat[-1], CODES // 2)
    centres = np.unique(np.concatenate([even, np.quantile(flat, np.linspace(0, 1, CODES // 2))]))
    for _ in range(ROUNDS):
        ends = np.searchsorted(flat, (centres[1:] + centres[:-1]) / 2)
        edges = np.concatenate([[0], ends, [len(flat)]])
        counts = np.diff(edges)
        means = np.diff(sums[edges]) / np.maximum(counts, 1)
        centres = np.sort(np.where(counts > 0, means, centres))
    return centres.astype(np.float32)


def nearest(values: np.ndarray, book: np.ndarray) -> np.ndarray:
    """The rows of an ascending codebook that are nearest to the values, of the same shape."""
    return np.searchsorted((book[1:] + book[:-1]) / 2, values)


def palette(rows: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """At most `size` rows that stand for the rows [n, d], and for each of these the number of the one that does.

    The rows are split at the median of their widest column, again and again, and the means of the parts refined by
    k-means.
    """
    parts = [np.arange(len(rows))]
    while len(parts) < size:
        halves = [half for part in parts for half in _halves(rows, part)]
        if len(halves) == len(parts) or len(halves) > size:
            break
        parts = halves
    labels = np.empty(len(rows), np.int64)
    for number, part in enumerate(parts):
        labels[part] = number
    centres = np.stack([rows[part].mean(0) for part in parts])
    rounds = PALETTE_ROUNDS if rows.size * len(centres) <= MOST_PRODUCTS else 0
    for _ in range(rounds):
        labels = _nearest_rows(rows, centres)
        counts = np.bincount(labels, minlength=len(centres))[:, None]
        sums = np.stack([np.bincount(labels, column, len(centres)) for column in rows.T], 1)
        centres = np.where(counts > 0, sums / np.maximum(counts, 1), centres)
    return centres.astype(np.float32), labels


def _halves(rows: np.ndarray, part: np.ndarray) -> list[np.ndarray]:
    if len(part) < 2:
        return [part]
    column = rows[part, np.ptp(rows[part], axis=0).argmax()]
    if np.ptp(column) == 0:
        return [part]
    order = np.argsort(column, kind="stable")
    return [part[order[: len(part) // 2]], part[order[len(part) // 2 :]]]


def _nearest_rows(rows: np.ndarray, centres: np.ndarray) -> np.ndarray:
    half = (centres**2).sum(1) / 2
    chunks = range(0, len(rows), ROWS_AT_ONCE)
    return np.concatenate([(half - rows[i : i + ROWS_AT_ONCE] @ centres.T).argmin(1) for i in chunks])
