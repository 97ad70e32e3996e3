"""Which candidates go the same way, and where the ways with the most candidates tie."""

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial.distance import squareform

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.regression.candidates import Candidates
from robust_instant_policy.regression.likelihood import PAIRWISE_LIMIT, squared_scale_floor

SAME_MODE = 2.3  # mean squared distance, in that of nearest neighbours, up to which candidates go the same way
WORST_STEP = 25.0  # that one step may add to it at most: a wrong digit does not make a mode of its own
SAME_WAY_SHARE = 0.2  # of the pairs, at least, that go the same way: their distance is noise
POOLED_SHARE = 0.5  # of all steps' noise in the noise that a step's distances are measured in


def step_distances(blocks: FloatArray, groups: FloatArray) -> FloatArray:
    """Squared distances ``(Q, Q, K)`` of candidates on common times ``(Q, K, D)``, in those of nearest neighbours."""
    count = len(blocks)
    median = np.median(blocks, axis=0)
    squares = (blocks[:, None] - blocks[None]) ** 2
    pairs = squares[np.triu_indices(count, 1)]
    unit = np.sqrt(groups @ (np.quantile(pairs, SAME_WAY_SHARE, axis=0).mean(axis=0) + squared_scale_floor(median)))
    gaps = (squares / unit**2).mean(axis=-1)
    neighbour = (gaps.mean(axis=-1) + np.diag(np.full(count, np.inf))).argmin(axis=1)
    noise = np.median(gaps[np.arange(count), neighbour], axis=0) + np.finfo(float).tiny
    if len(median) > 2:  # candidates sampled at other times cut a corner by up to a quarter of its second difference
        noise[1:-1] += ((np.diff(median, 2, axis=0) / unit / 4) ** 2).mean(axis=-1)
    return gaps / ((1 - POOLED_SHARE) * noise + POOLED_SHARE * noise.mean())


def partition(steps: FloatArray) -> np.ndarray:
    """Labels ``(Q,)`` from `step_distances` ``(Q, Q, K)``: 0 is the largest group, -1 is a candidate that is alone.

    Candidates are merged by average linkage up to `SAME_MODE`, a distance that noise keeps near 1.
    """
    count = len(steps)
    distance = np.minimum(steps, WORST_STEP).mean(axis=-1)
    np.fill_diagonal(distance, 0.0)
    if distance.max() <= SAME_MODE:
        return np.zeros(count, dtype=np.intp)
    clusters = fcluster(linkage(squareform(distance, checks=False), "average"), SAME_MODE, "distance")
    members = [clusters == cluster for cluster in np.unique(clusters)]
    # of two groups of one size, the one that agrees better leads, whatever the order of the candidates
    members.sort(key=lambda group: (-group.sum(), distance[np.ix_(group, group)].sum()))
    labels = np.full(count, -1, dtype=np.intp)
    for mode, group in enumerate(members):
        if group.sum() > 1:
            labels[group] = mode
    return labels if labels.max() >= 0 else np.zeros(count, dtype=np.intp)


def share_at_ties(data: Candidates, groups: FloatArray, at: FloatArray) -> FloatArray:
    """Share of the candidates in the leading mode ``(T,)`` where it ties with another at times ``at (T,)``; else 1.

    A tie is two modes with equally many candidates, at the steps where they are apart. Which of them is right cannot be
    known, and the likelihood may be highest between them. Two candidates alone show no noise and no tie.
    """
    count = len(data)
    blocks = data.at(at)
    stride = 1 + blocks.size * count // PAIRWISE_LIMIT
    if count > 2:
        steps = step_distances(blocks[:, ::stride], groups)
        labels = partition(steps)
        sizes = np.bincount(labels[labels >= 0])
        rivals = np.isin(labels, np.flatnonzero(sizes == sizes[0])[1:])
        if rivals.any():
            apart = steps[labels == 0][:, rivals].mean(axis=(0, 1)) > SAME_MODE
            return np.interp(at, at[::stride], np.where(apart, sizes[0] / count, 1.0))
    return np.ones(len(at))
