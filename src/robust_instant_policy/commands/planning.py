"""The policy that several commands plan with."""

import argparse
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import method_settings
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.llm import check_server, connect
from robust_instant_policy.policies import KeypointPolicy, Neighbours, RobustInstantPolicy


@contextmanager
def fitted_policy(
    options: argparse.Namespace,
    demonstrations: Sequence[Demonstration],
    screen: StageConsole,
    workspace: FloatArray | None = None,
    method: str = "rip",
) -> Iterator[KeypointPolicy]:
    """The ``method``, "rip" or "neighbours", with its ``options`` (see `add_method`), fitted to ``demonstrations``.

    ``workspace (2, 3)``, metres, are the corners of what may be a keypoint. The language model is closed at the end.
    """
    settings = method_settings(options).changed(num_queries=options.queries, workspace=workspace)
    with ExitStack() as stack:
        policy: KeypointPolicy
        if method == "neighbours":
            policy = Neighbours(settings, progress=screen.done_so_far)
        else:
            with screen.stage(f"language model ({options.llm})"):
                check_server(options.llm)
                model = stack.enter_context(closing(connect(options.llm)))
            policy = RobustInstantPolicy(model, settings, deadline_s=options.deadline, progress=screen.done_so_far)
        with screen.stage("keypoints of the demonstrations"):
            policy.fit(demonstrations)
        yield policy
