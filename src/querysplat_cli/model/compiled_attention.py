"""The equations of local_attention.py and their derivatives, compiled, on every core."""

# mypy: disallow-untyped-defs=False, disallow-untyped-calls=False
import numba as nb
import numpy as np

REORDERED_SUMS = {"reassoc", "contract", "nsz"}
"""Sums may be vectorised; NaN and infinities stay what they are."""


@nb.njit(cache=True, error_model="numpy", fastmath=REORDERED_SUMS, parallel=True)
def attend_forward(query, keys, values, index, bias, attended, weights):
    """Fill attended [queries, heads, channels] and weights [queries, heads, near]."""
    queries, heads, channels = query.shape
    near = index.shape[1]
    zero = query.dtype.type(0)
    scale = query.dtype.type(1 / np.sqrt(channels))
    for i in nb.prange(queries):
        for h in range(heads):
            q, w, result = query[i, h], weights[i, h], attended[i, h]
            top = query.dtype.type(-np.inf)
            for p in range(near):
                k = keys[index[i, p], h]
                dot = zero
                for c in range(channels):
                    dot += q[c] * k[c]
                w[p] = dot * scale + bias[i, p]
                top = max(top, w[p])
            total = zero
            for p in range(near):
                w[p] = np.exp(w[p] - top)
                total += w[p]
            for c in range(channels):
                result[c] = zero
            for p in range(near):
                w[p] /= total
                share, v = w[p], values[index[i, p], h]
                for c in range(channels):
                    result[c] += share * v[c]


@nb.njit(cache=True, error_model="numpy", fastmath=REORDERED_SUMS, parallel=True)
def backward_to_queries(query, keys, values, index, weights, given, by_query, by_logit):
    """Fill by_query, and by_logit with ∂s/√channels."""
    queries, heads, channels = query.shape
    near = index.shape[1]
    zero = query.dtype.type(0)
    scale = query.dtype.type(1 / np.sqrt(channels))
    for i in nb.prange(queries):
        for h in range(heads):
            g, w, slope, result = given[i, h], weights[i, h], by_logit[i, h], by_query[i, h]
            mean = zero
            for p in range(near):
                v = values[index[i, p], h]
                dot = zero
                for c in range(channels):
                    dot += g[c] * v[c]
                slope[p] = dot
                mean += w[p] * dot
            for c in range(channels):
                result[c] = zero
            for p in range(near):
                slope[p] = w[p] * (slope[p] - mean) * scale
                change, k = slope[p], keys[index[i, p], h]
                for c in range(channels):
                    result[c] += change * k[c]


@nb.njit(cache=True, error_model="numpy", fastmath=REORDERED_SUMS, parallel=True)
def backward_to_memory(query, index, weights, by_logit, given, by_key, by_value):
    """Fill by_key and by_value, each row by one thread and in the order of the queries."""
    heads, channels = query.shape[1:]
    near = index.shape[1]
    zero = query.dtype.type(0)
    start, visits = _visits(index, len(by_key))
    for row in nb.prange(len(by_key)):
        for h in range(heads):
            k, v = by_key[row, h], by_value[row, h]
            for c in range(channels):
                k[c], v[c] = zero, zero
            for visit in visits[start[row] : start[row + 1]]:
                i, p = visit // near, visit % near
                q, g = query[i, h], given[i, h]
                change, share = by_logit[i, h, p], weights[i, h, p]
                for c in range(channels):
                    k[c] += change * q[c]
                    v[c] += share * g[c]


@nb.njit(cache=True)
def _visits(index, rows):
    """Which entries of `index` name each row: visits[start[row] : start[row + 1]], in ascending order."""
    named = index.ravel()
    start = np.zeros(rows + 1, np.int64)
    for row in named:
        start[row + 1] += 1
    start = np.cumsum(start)
    free = start.copy()
    visits = np.empty(len(named), np.int64)
    for entry in range(len(named)):
        visits[free[named[entry]]] = entry
        free[named[entry]] += 1
    return start, visits
