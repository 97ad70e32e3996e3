"""`rip serve`: plan for robots that ask over openpi's websocket protocol, or over HTTP."""

import argparse
import os

from robust_instant_policy.commands.console import StageConsole
from robust_instant_policy.commands.options import add_demos, add_method, natural, share
from robust_instant_policy.commands.planning import fitted_policy
from robust_instant_policy.datasets import load_demonstrations
from robust_instant_policy.errors import needs_extra
from robust_instant_policy.network import KEY_VARIABLE, checked_key, listen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_demos(parser)
    parser.add_argument("--method", choices=("rip", "neighbours"), default="rip", help="of planning")
    parser.add_argument(
        "--min-confidence", type=share(0), default=0.9, metavar="P", help="plans with a lower confidence are refused"
    )
    parser.add_argument(
        "--host", default="127.0.0.1", help=f"address; one that others can reach needs a key in {KEY_VARIABLE}"
    )
    parser.add_argument("--port", type=natural, default=8000, help="0: any free one")
    add_method(parser)


def run(options: argparse.Namespace) -> int:
    with needs_extra("serve"):
        from robust_instant_policy.serving.planner import Planner
        from robust_instant_policy.serving.server import serve
    screen = StageConsole()
    key = checked_key(options.host, os.environ.get(KEY_VARIABLE))
    listener = listen(options.host, options.port)
    demonstrations = load_demonstrations(options.demos)
    try:
        with fitted_policy(options, demonstrations, screen, method=options.method) as policy:
            host, port = listener.getsockname()[:2]
            address = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
            screen.say(f"serving {demonstrations[0].task or options.demos}; Ctrl-C ends it")
            screen.say(f"  openpi: ws://{address}    HTTP: http://{address}/docs")
            serve(Planner(policy, options.min_confidence), listener, key, getattr(options, "debug", False))
    except KeyboardInterrupt:  # the usual end
        screen.say("stopped")
    return 0
