"""Smooth joins where the frame of a trajectory changes.

Two frames predict neighbouring steps independently: between them the gripper may jump or turn on the spot by far more
than any demonstration does. A smooth motion needs corrections d_t, of points and turns alike. Steps between things are
predicted with larger errors than those at things and are corrected more: the corrections minimise

    Σ_t |d_t|² / e_t² + Σ_t |d_{t+1} - d_t + j_t|² / `STEP_M`²

with e_t the error with which demonstrations predict step t from each other (a part of it at key steps, which must be
met), and j_t the jump at a change of frame: by how much the motion between the two frames differs from that at the
nearest steps without a change, less what demonstrations show there; 0 elsewhere.
"""

from collections.abc import Collection

import numpy as np
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from robust_instant_policy.context.candidates import NOISE_M
from robust_instant_policy.geometry import FloatArray, fit_rigid, interpolate

STEP_M = 0.01  # by how much a corrected step may differ from a predicted one
KEY_SHARE = 0.01  # of the error of key steps


def joined(
    hands: FloatArray,
    errors: FloatArray,
    key_steps: Collection[int],
    changes: Collection[int],
    demonstrated: FloatArray,
) -> FloatArray:
    """``hands (T, 3, 3)``, the gripper's three points at each step, without jumps before the steps ``changes``.

    ``errors (T,)`` of their prediction, metres, NaN unknown; ``demonstrated (T - 1, 2)``: jumps, see `shown_jumps`.
    """
    motions = hand_motions(hands)
    jumps = np.zeros_like(motions)
    before = np.array(sorted(changes), dtype=int) - 1
    usual = np.setdiff1d(np.arange(len(motions)), before)
    if len(usual):
        jumps[before] = motions[before] - interpolate(before, usual, motions[usual])
    for part, allowed in zip((slice(0, 3), slice(3, 6)), demonstrated.T, strict=True):
        size = np.linalg.norm(jumps[:, part], axis=1)
        jumps[:, part] *= np.maximum(1 - allowed / np.maximum(size, 1e-9), 0.0)[:, None]
    share = np.ones(len(hands))
    share[list(key_steps)] = KEY_SHARE
    stiff = (NOISE_M / STEP_M) ** 2
    errors = np.where(np.isnan(errors), STEP_M, np.fmax(errors, NOISE_M))
    diagonal = (NOISE_M / (share * errors)) ** 2 + 2 * stiff
    diagonal[[0, -1]] -= stiff
    right = np.zeros((len(hands), 6))
    right[:-1] += stiff * jumps
    right[1:] -= stiff * jumps
    moved = solveh_banded(np.stack([np.full(len(hands), -stiff), diagonal]), right)
    centre = hands.mean(axis=1, keepdims=True)
    turned = Rotation.from_rotvec(moved[:, 3:]).as_matrix()
    return centre + moved[:, None, :3] + (hands - centre) @ np.swapaxes(turned, -1, -2)


def shown_jumps(hands: FloatArray) -> FloatArray:
    """``(T - 1, 2)``: by how much steps of demonstrated ``hands (I, T, 3, 3)`` differ from their neighbours at most, in
    metres and in rad."""
    unlike = np.stack([_unlike_neighbours(hand_motions(own)) for own in hands]).reshape(len(hands), -1, 2, 3)
    return np.linalg.norm(unlike, axis=-1).max(axis=0)


def hand_motions(hands: FloatArray) -> FloatArray:
    """From each of the ``hands (T, 3, 3)`` to the next: motion of the centre, metres, and rotation vector ``(T - 1,
    6)``, in the world."""
    centre = hands.mean(axis=1)
    shape = hands - centre[:, None]
    turns = Rotation.from_matrix(fit_rigid(shape[:-1], shape[1:])[:, :3, :3]).as_rotvec()
    return np.concatenate([np.diff(centre, axis=0), turns], axis=1)


def _unlike_neighbours(motions: FloatArray) -> FloatArray:
    """``motions (T, D)`` less the mean of those before and after, at the ends less the only one."""
    if len(motions) < 2:
        return np.zeros_like(motions)
    padded = np.concatenate([motions[1:2], motions, motions[-2:-1]])
    return motions - (padded[:-2] + padded[2:]) / 2
