"""Few values that stand for many: a table of 256 numbers, and a palette of vectors."""

from __future__ import annotations

import heapq

import numpy as np

_ROUNDS = 12
_ODD = np.uint64(0x9E3779B97F4A7C15)  # 2^64 / the golden ratio, as Fibonacci hashing takes

_NOTHING = 1e-12
"""Below which a vector's value is 0: turned harmonics leave such for what was 0, and their squares would be, too."""


def codebook(values: np.ndarray) -> np.ndarray:
    """float32 `[256]`, ascending: the numbers that stand for float32 `values` of any shape with little squared error (Lloyd 1982).

    Every value is its own entry where there are few enough.
    """
    ordered = np.sort(values.ravel().astype(np.float64))
    distinct = np.unique(ordered)
    if len(distinct) <= 256:
        return np.pad(distinct, (0, 256 - len(distinct)), mode="edge" if len(distinct) else "constant").astype(np.float32)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    # half by rank, half by range: quantiles alone leave the tails, which are large errors, to one entry
    table = np.sort(np.concatenate([np.quantile(distinct, np.linspace(0, 1, 128)), np.linspace(distinct[0], distinct[-1], 128)]))
    for _ in range(_ROUNDS):
        cuts = np.concatenate([[0], np.searchsorted(ordered, (table[1:] + table[:-1]) / 2), [len(ordered)]])
        counts = np.diff(cuts)
        table = np.sort(np.where(counts > 0, (sums[cuts[1:]] - sums[cuts[:-1]]) / np.maximum(counts, 1), table))
    return table.astype(np.float32)


def nearest(table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """uint8, of the shape of `values`: the nearest entry of an ascending table of up to 256."""
    return np.searchsorted((table[1:].astype(np.float64) + table[:-1]) / 2, values).astype(np.uint8)


def palette(vectors: np.ndarray, largest: int) -> tuple[np.ndarray, np.ndarray]:
    """Up to `largest` vectors `[m, d]` that stand for `[n, d]`, and which stands for which `[n]`.

    Each vector stands for itself where few enough differ; otherwise the part with the largest squared error is split at the mean of its
    widest axis until there are `largest` parts, and each part's mean stands for it (Wan, Wong and Prusinkiewicz 1988): about
    n d log(n) steps, where k-means takes n d times the number of parts, again and again.
    """
    vectors, n = np.where(np.abs(vectors) < _NOTHING, 0, vectors), len(vectors)
    keys = np.zeros(n, np.uint64)
    for column in np.ascontiguousarray(vectors, np.float32).view(np.uint32).T:  # alike vectors have alike sums, wrapping around
        keys = (keys ^ keys >> np.uint64(29)) * _ODD + column
    _, first, labels = np.unique(keys, return_index=True, return_inverse=True)
    if len(first) <= largest:
        return vectors[first], labels
    heap = [_part(vectors, np.arange(n), 0)]
    while len(heap) < largest and heap[0][0] < 0:  # the others are alike, each in itself
        _, born, part, axis = heapq.heappop(heap)
        values = vectors[part, axis]
        above = values > values.mean(dtype=np.float64)
        heapq.heappush(heap, _part(vectors, part[above], 2 * born + 1))
        heapq.heappush(heap, _part(vectors, part[~above], 2 * born + 2))
    for label, (_, _, part, _) in enumerate(heap):
        labels[part] = label
    return np.stack([vectors[part].mean(0, dtype=np.float64) for _, _, part, _ in heap]).astype(np.float32), labels


def _part(vectors: np.ndarray, part: np.ndarray, born: int) -> tuple[float, int, np.ndarray, int]:
    """Minus the squared error of the vectors at indices `part` about their mean, the part's own number, they, their widest axis."""
    spread = vectors[part].var(0)
    return -float(spread.sum()) * len(part), born, part, int(spread.argmax())
