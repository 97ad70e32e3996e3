"""How well can a family of `relations.py` be done at best, with the noise of its keypoints?

    python benchmarks/relations_bound.py --noise 4 --families spacing two-arms

The bound knows what a policy has to infer: the family's program with its constants, which keypoints belong to which
thing, and which way applies. It estimates what is left by least squares, weighted by the true noise: from the
demonstrations the `Kit` (shapes, grasps, places, points), together with the layout of each; then from the new scene's
keypoints its layout. ``--exact`` also gives it the kit. Its plan is judged like all others.
"""

from __future__ import annotations

import argparse
import copy

import numpy as np
from pick_and_place import HAND_NOISE_M, HAND_NOISE_RAD, WITHIN_M
from relation_families import FAMILIES, USUAL, Drawn, Family, Hand, Kit, Layout, down, travelled, turned
from relations import FIRST_NEW, Set, key_error
from scipy.optimize import least_squares

from robust_instant_policy.geometry import FloatArray

ROUNDS = 4  # of the Gauss-Newton method, from the truth
STEP = 1e-6  # of a numerical derivative, metres and radians
KIT_STD = 0.05  # a priori, metres, of what a kit is made of: all of it lies on things of 8 cm
FREE = 1.0  # the same of angles and shares
KNOWN = [name for name in FAMILIES if name not in ("flip", "larger")]  # these draw numbers again until they are clear


class Known(Layout):
    """A layout that is given by its ``numbers``; without them it is drawn, and these are recorded."""

    def __init__(self, rng: np.random.Generator | None, numbers: FloatArray | None = None):
        super().__init__(rng or np.random.default_rng(0))
        self.given = None if numbers is None else list(numbers)
        self.numbers: list[float] = []

    def things(self, count, fits=lambda places: True):
        if self.given is None:
            poses = super().things(count, fits)
            for pose in poses:
                self.numbers += [pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0])]
            return poses
        rows = [[self.given.pop(0) for _ in range(3)] for _ in range(count)]
        return [turned([x, y], angle) for x, y, angle in rows]

    def number(self, low, high):
        if self.given is not None:
            return self.given.pop(0)
        self.numbers.append(super().number(low, high))
        return self.numbers[-1]


class Noted(Hand):
    """A hand that notes its poses."""

    def __init__(self, rng: np.random.Generator | None):
        super().__init__(rng)
        self.poses: list[FloatArray] = []

    def __call__(self, pose: FloatArray) -> FloatArray:
        self.poses.append(super().__call__(pose))
        return self.poses[-1]


def numbers_of(kit: Kit) -> FloatArray:
    """``(128,)``: 3 shapes of 10 points (90), 6 poses as x, y, z, angle (24), 3 points as x, y (6), 8 shares."""
    poses = [[*pose[:3, 3], np.arctan2(pose[1, 0], pose[0, 0])] for pose in (*kit.grasps, *kit.places)]
    return np.concatenate([kit.shapes.ravel(), np.ravel(poses), kit.points[:, :2].ravel(), kit.shares[2:]])


def kit_of(numbers: FloatArray, known: Kit) -> Kit:
    """The kit of `numbers_of`; what these do not hold is that of the ``known`` one."""
    kit = copy.copy(known)
    shapes, poses, points, shares = np.split(numbers, [90, 114, 120])
    kit.shapes = shapes.reshape(3, 10, 3)
    downs = [down([x, y], z, angle) for x, y, z, angle in poses.reshape(6, 4)]
    kit.grasps, kit.places = downs[:3], downs[3:]
    kit.points = np.column_stack([points.reshape(3, 2), np.zeros(3)])
    kit.shares = np.concatenate([known.shares[:2], shares])
    return kit


def drawn(family: Family, kit: Kit, layout: FloatArray) -> tuple[Drawn, list[FloatArray]]:
    """The scene of a ``layout``, and the poses ``(4, 4)`` at which the hand aims in it."""
    hand = Noted(None)
    return family.draw(kit, Known(None, layout), hand), hand.poses


def residuals(family: Family, kit: Kit, layout: FloatArray, keypoints: FloatArray, poses, noise_m: float) -> FloatArray:
    """Of the keypoints, and of the hand's ``poses`` where these are known, in standard deviations."""
    own, aimed = drawn(family, kit, layout)
    parts = [(np.concatenate(own.things) - keypoints).ravel() / noise_m]
    for aim, pose in zip(aimed, poses, strict=False):
        turn = aim[:3, :3] @ pose[:3, :3].T
        angle = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        parts.append(np.append((aim - pose)[:3, 3] / HAND_NOISE_M, angle / HAND_NOISE_RAD))
    return np.concatenate(parts)


def fitted_kit(family: Family, kit: Kit, shown: list, noise_m: float) -> Kit:
    """The kit that explains the demonstrations ``shown`` (layout, keypoints, poses) best, together with its layouts."""
    start = numbers_of(kit)
    prior = np.full(len(start), KIT_STD)
    prior[93:114:4] = prior[120:] = FREE
    x, layouts = start.copy(), [np.array(layout) for layout, *_ in shown]
    shared, own = len(start), len(layouts[0])
    for _ in range(ROUNDS):
        size = shared + own * len(shown)
        normal, right = np.diag(np.full(size, 1e-9)), np.zeros(size)
        normal[:shared, :shared] += np.diag(prior**-2)
        right[:shared] -= (x - start) / prior**2
        for index, (_, keypoints, poses) in enumerate(shown):
            both = np.concatenate([x, layouts[index]])

            def off(both, keypoints=keypoints, poses=poses):
                return residuals(family, kit_of(both[:shared], kit), both[shared:], keypoints, poses, noise_m)

            here = off(both)
            slopes = np.stack([(off(both + STEP * unit) - here) / STEP for unit in np.eye(len(both))], axis=1)
            columns = np.r_[:shared, shared + own * index : shared + own * (index + 1)]
            normal[np.ix_(columns, columns)] += slopes.T @ slopes
            right[columns] -= slopes.T @ here
        moved = np.linalg.solve(normal, right)
        x = x + moved[:shared]
        layouts = [layout + moved[shared + own * index :][:own] for index, layout in enumerate(layouts)]
    return kit_of(x, kit)


def errors(family: Family, options: argparse.Namespace, number: int) -> list[float]:
    """Metres by which the bound's plans are off in the new scenes of set ``number``; see `key_error`."""
    noise_m = options.noise / 1000
    demos = Set(family, options.split, number, options.noise, options.demos)
    stream = family.stream(options.split, number)
    kit = Kit(np.random.default_rng(stream))

    def layout_of(index: int, hand_noise: bool) -> tuple[list[float], list[FloatArray]]:
        layout = Known(np.random.default_rng([*stream, index, 1]))
        hand = Noted(np.random.default_rng([*stream, index, 3]) if hand_noise else None)
        family.draw(kit, layout, hand)
        return layout.numbers, hand.poses

    found = kit
    if not options.exact:
        given = [layout_of(index, True) for index in range(options.demos)]
        shown = [(layout, points, poses) for (layout, poses), points in zip(given, demos.keypoints, strict=True)]
        found = fitted_kit(family, kit, shown, noise_m)
    off = []
    for index in range(options.scenes):
        scene = demos.scene(index, USUAL)
        start, _ = layout_of(FIRST_NEW + index, False)
        layout = least_squares(
            lambda x, scene=scene: residuals(family, found, x, scene.keypoints, (), noise_m), start, x_scale="jac"
        ).x
        path = travelled(drawn(family, found, layout)[0].legs, np.random.default_rng(0))
        off.append(key_error(path, scene.path))
    return off


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--families", nargs="+", choices=KNOWN, default=KNOWN)
    parser.add_argument("--noise", type=float, default=4.0, help="of the keypoints, mm")
    parser.add_argument("--demos", type=int, default=10)
    parser.add_argument("--sets", type=int, default=4)
    parser.add_argument("--scenes", type=int, default=5)
    parser.add_argument("--split", choices=("tune", "measure"), default="measure")
    parser.add_argument("--exact", action="store_true", help="shapes and grasps are known, too")
    options = parser.parse_args()
    for name in options.families:
        off = 1000 * np.array(
            [one for number in range(options.sets) for one in errors(FAMILIES[name], options, number)]
        )
        right = (off <= 1000 * WITHIN_M).mean()
        print(f"{name}: right {right:.0%} of {len(off)}, median {np.median(off):.1f} mm", flush=True)


if __name__ == "__main__":
    main()
