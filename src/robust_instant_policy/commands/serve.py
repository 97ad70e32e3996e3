"""`rip serve`: plan for robots that ask over openpi's websocket protocol, or over HTTP."""

from __future__ import annotations

import argparse
import os

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import add_method, method_settings, natural, positive
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.errors import MissingExtraError
from robust_instant_policy.llm import check_server, connect
from robust_instant_policy.network import listen
from robust_instant_policy.policies import KeypointPolicy, Neighbours, RobustInstantPolicy
from robust_instant_policy.serving.address import KEY_VARIABLE, checked_key


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--demos", required=True, metavar="DIR", help="folder of demonstrations")
    parser.add_argument("--method", choices=("rip", "neighbours"), default="rip", help="(default: %(default)s)")
    parser.add_argument("--llm", default="embedded", help="language model (default: %(default)s)")
    parser.add_argument("--queries", type=positive, default=5, metavar="Q", help="samples (default: %(default)s)")
    parser.add_argument(
        "--min-confidence",
        type=probability,
        default=0.5,
        metavar="P",
        help="plans with a lower confidence are refused (default: %(default)s)",
    )
    parser.add_argument(
        "--host",
        default="127.0.0.1",
        help=f"address; one that others can reach needs a key in {KEY_VARIABLE} (default: %(default)s)",
    )
    parser.add_argument("--port", type=natural, default=8000, help="0: any free one (default: %(default)s)")
    add_method(parser)


def probability(text: str) -> float:
    """A number from 0 to 1."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value <= 1:
        raise argparse.ArgumentTypeError(f"must be a number from 0 to 1, not {text!r}")
    return value


def run(options: argparse.Namespace) -> int:
    try:
        from robust_instant_policy.serving.planner import Planner
        from robust_instant_policy.serving.server import serve
    except ModuleNotFoundError as error:
        if error.name and error.name.startswith("robust_instant_policy"):
            raise
        raise MissingExtraError(error.name or "fastapi", "serve") from error
    screen = StageConsole()
    key = checked_key(options.host, os.environ.get(KEY_VARIABLE))
    listener = listen(options.host, options.port)
    demonstrations = load_demonstrations(options.demos)
    settings = method_settings(options)
    model = None
    policy: KeypointPolicy = Neighbours(settings, num_queries=options.queries)
    if options.method == "rip":
        with screen.stage(f"language model ({options.llm})"):
            check_server(options.llm)
            model = connect(options.llm)
        policy = RobustInstantPolicy(model, settings, num_queries=options.queries, deadline_s=options.deadline)
    try:
        with screen.stage("keypoints of the demonstrations"):
            planner = Planner(policy.fit(demonstrations), options.min_confidence)
        host, port = listener.getsockname()[:2]
        address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        screen.say(f"serving {demonstrations[0].task or options.demos}; Ctrl-C ends it")
        screen.say(f"  openpi: ws://{address}    HTTP: http://{address}/docs")
        serve(planner, listener, key, getattr(options, "debug", False))
    except KeyboardInterrupt:  # the usual end
        screen.say("stopped")
    finally:
        if model is not None:
            model.close()
    return 0
