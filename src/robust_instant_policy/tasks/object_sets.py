"""Sets of objects: the ones that demonstrations are made with, and others that they never show."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

OBJECTS_A_SET = 8

T = TypeVar("T")


def draw_object(
    families: Mapping[str, Callable[[int, np.random.Generator], T]], objects: str, rng: np.random.Generator
) -> T:
    """One of the `OBJECTS_A_SET` objects of the set ``objects``, which are the same ones in every episode.

    ``families[objects](number, rng)`` makes the object of that number; its random numbers are always the same.
    """
    number = int(rng.integers(OBJECTS_A_SET))
    return families[objects](number, np.random.default_rng([number, *objects.encode()]))
