"""The policy that several commands plan with."""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import method_settings
from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.llm import check_server, connect
from robust_instant_policy.policies import RobustInstantPolicy


@contextmanager
def fitted_policy(
    options: argparse.Namespace,
    demonstrations: Sequence[Demonstration],
    screen: StageConsole,
    workspace: FloatArray | None = None,
) -> Iterator[RobustInstantPolicy]:
    """The policy of ``options`` (`add_method`, ``--llm``, ``--queries``), fitted to ``demonstrations``.

    ``workspace (2, 3)``, metres, are the corners of what may be a keypoint. The language model is closed at the end.
    """
    with screen.stage(f"language model ({options.llm})"):
        check_server(options.llm)
        model = connect(options.llm)
    with closing(model):
        policy = RobustInstantPolicy(
            model,
            method_settings(options),
            num_queries=options.queries,
            deadline_s=options.deadline,
            progress=screen.done_so_far,
            workspace=workspace,
        )
        with screen.stage("keypoints of the demonstrations"):
            policy.fit(demonstrations)
        yield policy
