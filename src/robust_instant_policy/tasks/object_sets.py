"""Two sets of objects: those of the demonstrations, and those that no demonstration shows."""

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np

OBJECTS_A_SET = 8

T = TypeVar("T")


def draw_object(
    families: Mapping[str, Callable[[int, np.random.Generator], T]], objects: str, rng: np.random.Generator
) -> T:
    """One of the `OBJECTS_A_SET` objects of the set ``objects``, which are the same in every episode.

    ``families[objects](number, rng)`` makes the object with that number; ``rng`` depends on the number only.
    """
    number = int(rng.integers(OBJECTS_A_SET))
    return families[objects](number, np.random.default_rng([number, *objects.encode()]))
