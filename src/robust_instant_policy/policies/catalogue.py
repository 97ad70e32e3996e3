"""The methods by name, as the command line and the tables call them."""

from __future__ import annotations

import math
from collections.abc import Callable

from robust_instant_policy.errors import UnknownNameError
from robust_instant_policy.policies.instant import InstantPolicy
from robust_instant_policy.policies.kat import KeypointActionTokens
from robust_instant_policy.policies.neighbours import Neighbours
from robust_instant_policy.policies.policy import ClosedLoopPolicy, Policy
from robust_instant_policy.policies.rip import DOF, RobustInstantPolicy

MOST_QUERIES = 10  # limit of the adaptive method, unless more are asked for

_METHODS: dict[str, Callable[[InstantPolicy, int, float], Policy | ClosedLoopPolicy]] = {
    "rip": lambda instant, queries, dof: RobustInstantPolicy(instant, num_queries=queries, dof=dof),
    "rip-gauss": lambda instant, queries, _: RobustInstantPolicy(instant, num_queries=queries, dof=math.inf),
    "rip-adaptive": lambda instant, queries, dof: RobustInstantPolicy(
        instant, num_queries=max(queries, MOST_QUERIES), dof=dof, adaptive=True
    ),
    "kat": lambda instant, queries, _: KeypointActionTokens(instant, num_queries=queries),
    "neighbours": lambda instant, queries, _: Neighbours(instant.context, num_queries=queries),
}
METHOD_NAMES = tuple(_METHODS)
ASKING_METHODS = ("rip", "rip-gauss", "rip-adaptive", "kat")  # those that ask the language model
REGRESSING_METHODS = ("rip", "rip-gauss", "rip-adaptive")  # those that have a ν


def make_policy(name: str, instant: InstantPolicy, num_queries: int = 5, dof: float = DOF) -> Policy | ClosedLoopPolicy:
    """The method ``name`` over ``instant``, which several methods may share; raises `UnknownNameError`.

    Call its ``fit(demonstrations)`` before anything else: what methods share is done only once.
    """
    if name not in _METHODS:
        raise UnknownNameError("method", name, METHOD_NAMES)
    return _METHODS[name](instant, num_queries, dof)
