"""`rip demos`: delete, split, merge or restore demonstrations; a new folder is written each time."""

import argparse
from pathlib import Path

from robust_instant_policy.commands.options import natural, positive
from robust_instant_policy.datasets import editing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    actions = parser.add_subparsers(title="actions", required=True, metavar="ACTION")
    delete = actions.add_parser("delete", help="leave out some episodes")
    delete.add_argument("demos", type=Path, metavar="DIR")
    delete.add_argument("--episodes", type=natural, nargs="+", required=True, metavar="N", help="counted from 0")
    split = actions.add_parser("split", help="divide a folder into parts")
    split.add_argument("demos", type=Path, metavar="DIR")
    split.add_argument("--sizes", type=positive, nargs="+", required=True, metavar="N", help="episodes of each part")
    merge = actions.add_parser("merge", help="put the episodes of several folders of one task into one")
    merge.add_argument("demos", type=Path, nargs="+", metavar="DIR")
    restore = actions.add_parser("restore", help="complete a folder that lerobot-edit-dataset has written")
    restore.add_argument("demos", type=Path, metavar="DIR")
    restore.add_argument(
        "--from", dest="originals", type=Path, nargs="+", required=True, metavar="DIR", help="what was edited"
    )
    for action, name in ((delete, "delete"), (split, "split"), (merge, "merge"), (restore, "restore")):
        several = "+" if action is split else None
        action.add_argument("--out", type=Path, nargs=several, required=True, metavar="DIR", help="new folder")
        action.set_defaults(action=name)


def run(options: argparse.Namespace) -> int:
    if options.action == "split":
        editing.split(options.demos, options.sizes, options.out)
        for out, size in zip(options.out, options.sizes, strict=True):
            print(f"{out}: {size} demonstrations")
        return 0
    if options.action == "delete":
        count = editing.delete(options.demos, options.episodes, options.out)
    elif options.action == "merge":
        count = editing.merge(options.demos, options.out)
    else:
        count = editing.restore(options.demos, options.originals, options.out)
    print(f"{options.out}: {count} demonstrations")
    return 0
