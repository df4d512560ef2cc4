r"""Codebooks and bags: a target as the words that its patches use (Li et al. 2012, section 3.2.2).

Every patch of a target, a superpixel or a square, has a normalised histogram of its colours or its texture. Patches
that look alike form clusters, found by Mean-Shift: from every patch one climbs to a mode of the density of patches, by
steps to the mean of all patches within the bandwidth `h`,

.. math:: m \leftarrow \frac{1}{|N(m)|} \sum_{x \in N(m)} x, \qquad N(m) = \{x : \lVert x - m \rVert \le h\}.

The modes are the *words* of a *codebook*. How often each word is the nearest one to a patch of an image is that
image's *bag*, a histogram again, and two bags are compared by their intersection. A target changes its looks, so its
codebook follows with a *forget factor*.

The number of words is not chosen; the bandwidth is. Chapters 9 and 10 use this.
"""

from __future__ import annotations

import numpy as np

STEP = 1e-3
"""Climbing ends when a step is shorter than this share of the bandwidth."""


def _check(points, name: str) -> np.ndarray:
    points = np.asarray(points, dtype=float)
    if points.ndim != 2 or len(points) == 0 or not np.isfinite(points).all():
        raise ValueError(f"{name} must be a non-empty array (N, d) of finite numbers, got shape {points.shape}")
    return points


def squared_distances(points, centers) -> np.ndarray:
    """Squared Euclidean distance of each of many points from each of some centres.

    Parameters
    ----------
    points, centers : array_like, shapes (N, d) and (K, d)
        Features.

    Returns
    -------
    ndarray, shape (N, K)
        The squares, none negative.

    Raises
    ------
    ValueError
        If an array is empty, not finite, or their dimensions differ.

    Examples
    --------
    >>> print(squared_distances([[0.0, 0.0], [3.0, 4.0]], [[0.0, 0.0]]))
    [[ 0.]
     [25.]]
    """
    points, centers = _check(points, "points"), _check(centers, "centers")
    if points.shape[1] != centers.shape[1]:
        raise ValueError(f"points and centers must have one dimension, got {points.shape[1]} and {centers.shape[1]}")
    squares = (points**2).sum(axis=1)[:, None] + (centers**2).sum(axis=1) - 2 * points @ centers.T
    return np.maximum(squares, 0.0)


def mean_shift(points, bandwidth: float, max_steps: int = 300) -> np.ndarray:
    """Cluster points by Mean-Shift with a flat kernel, all of them climbing at once.

    Points in whose neighbourhoods the same points lie go on together, so that after a few steps few are left to move.

    Parameters
    ----------
    points : array_like, shape (N, d)
        Features, such as histograms.
    bandwidth : float
        Radius of the neighbourhood, in the unit of the features, above 0.
    max_steps : int
        Longest climb, in steps, at least 1.

    Returns
    -------
    ndarray, shape (K, d)
        The modes, that of the most populous neighbourhood first. No two lie within the bandwidth of each other: of two
        that did, the less populous one was dropped.

    Raises
    ------
    ValueError
        If there are no points, they are not finite, or `bandwidth` or `max_steps` is out of its range.

    Examples
    --------
    >>> rng = np.random.default_rng(0)
    >>> around = np.repeat([[0.0, 0.0], [5.0, 5.0]], [30, 20], axis=0)
    >>> mean_shift(around + rng.normal(0, 0.3, (50, 2)), bandwidth=2).round() + 0.0
    array([[0., 0.],
           [5., 5.]])
    """
    points = _check(points, "points")
    if not 0 < bandwidth < np.inf or max_steps < 1:
        raise ValueError(f"bandwidth must be positive and max_steps at least 1, got {bandwidth} and {max_steps}")
    climbing, modes, sizes = points, [], []
    for step in range(max_steps):
        near = squared_distances(climbing, points) <= bandwidth**2
        _, first, same = np.unique(np.packbits(near, axis=1), axis=0, return_index=True, return_inverse=True)
        n_near = near[first].sum(axis=1)
        means = near[first] @ points / n_near[:, None]
        moved = np.linalg.norm(means[same.ravel()] - climbing, axis=1)
        longest = np.zeros(len(first))  # of those that go on together, the one that came the longest way
        np.maximum.at(longest, same.ravel(), moved)
        there = longest <= STEP * bandwidth if step < max_steps - 1 else np.ones(len(first), dtype=bool)
        modes.append(means[there])
        sizes.append(n_near[there])
        climbing = means[~there]
        if len(climbing) == 0:
            break
    modes, sizes = np.concatenate(modes), np.concatenate(sizes)
    modes = modes[np.lexsort((*modes.T[::-1], sizes))[::-1]]
    kept = np.ones(len(modes), dtype=bool)
    for k, near in enumerate(squared_distances(modes, modes) <= bandwidth**2):
        if kept[k]:
            kept[k + 1 :] &= ~near[k + 1 :]
    return modes[kept]


def nearest_words(points, codebook) -> np.ndarray:
    """Find the word that is nearest to each of many patches.

    Parameters
    ----------
    points : array_like, shape (N, d)
        Features of the patches.
    codebook : array_like, shape (K, d)
        The words.

    Returns
    -------
    ndarray of int, shape (N,)
        Number of the nearest word; of equally near ones, the first.

    Raises
    ------
    ValueError
        As :func:`squared_distances`.

    Examples
    --------
    >>> nearest_words([[0.1], [0.8], [0.4]], codebook=[[0.0], [1.0]])
    array([0, 1, 0])
    """
    return squared_distances(points, codebook).argmin(axis=1)


def bag_of_words(points, codebook) -> np.ndarray:
    """How often each word of a codebook occurs among the patches of an image.

    Parameters
    ----------
    points : array_like, shape (N, d)
        Features of the patches.
    codebook : array_like, shape (K, d)
        The words.

    Returns
    -------
    ndarray, shape (K,)
        Share of the patches whose nearest word it is; they sum to 1. (The paper counts; shares can be compared between
        images with different numbers of patches.)

    Raises
    ------
    ValueError
        As :func:`squared_distances`.

    Examples
    --------
    >>> bag_of_words([[0.1], [0.8], [0.4], [0.3]], codebook=[[0.0], [1.0]])
    array([0.75, 0.25])
    """
    words = nearest_words(points, codebook)
    return np.bincount(words, minlength=len(codebook)) / len(words)


def intersection(p, q) -> np.ndarray:
    r"""Histogram intersection :math:`\sum_k \min(p_k, q_k)` (Swain and Ballard 1991).

    Parameters
    ----------
    p, q : array_like, shape (..., K)
        Normalised histograms, such as bags; the last axes are compared.

    Returns
    -------
    ndarray, shape (...)
        Similarity from 0 (nothing in common) to 1 (identical).

    Examples
    --------
    >>> print(intersection([[0.5, 0.5], [0.0, 1.0]], [1.0, 0.0]))
    [0.5 0. ]
    """
    return np.minimum(p, q).sum(axis=-1)


def update_codebook(codebook, points, bandwidth: float, forget: float = 0.9, literal: bool = False) -> np.ndarray:
    """Let a codebook follow its target (Li et al. 2012, section 3.2.3).

    The equation is lost from the paper's text. Read to the letter, and as the code of its model, Bag of Features
    Tracking (Yang et al. 2010), does it: the *values* of the old words are multiplied by the forget factor and
    clustered together with the new patches. A histogram that has shrunk no longer sums to one, and a word that is not
    seen again drifts to the origin. So the default mixes instead: old words move towards the new words nearest to them,
    new words that are near to none join, and words that are not seen stay as they are.

    Parameters
    ----------
    codebook : array_like, shape (K, d)
        The old words.
    points : array_like, shape (N, d)
        Features of new patches.
    bandwidth : float
        As for :func:`mean_shift`; also how near is near.
    forget : float
        Share of the old in a word, from 0 (forget at once) to 1 (learn nothing of words that are known).
    literal : bool
        Whether to follow the letter.

    Returns
    -------
    ndarray, shape (K', d)
        The new words. Bags have to be made again with them.

    Raises
    ------
    ValueError
        As :func:`mean_shift`, or if `forget` is outside 0 to 1 or the dimensions differ.

    Examples
    --------
    >>> old, seen = [[0.0, 1.0], [1.0, 0.0]], [[0.2, 0.8], [0.2, 0.8]]
    >>> update_codebook(old, seen, bandwidth=0.5, forget=0.9)
    array([[0.02, 0.98],
           [1.  , 0.  ]])
    """
    if not 0 <= forget <= 1:
        raise ValueError(f"forget must lie between 0 and 1, got {forget}")
    codebook, points = _check(codebook, "codebook"), _check(points, "points")
    if literal:
        squared_distances(codebook, points)  # are they of one dimension?
        return mean_shift(np.concatenate([forget * codebook, points]), bandwidth)
    words = mean_shift(points, bandwidth)
    distances = squared_distances(words, codebook)
    nearest, known = distances.argmin(axis=1), distances.min(axis=1) <= bandwidth**2
    updated = codebook.copy()
    for k in np.unique(nearest[known]):
        updated[k] = forget * codebook[k] + (1 - forget) * words[known & (nearest == k)].mean(axis=0)
    return np.concatenate([updated, words[~known]])
