"""`rip new-task`: write the template of a user's task, or check a task."""

import argparse
from contextlib import closing
from importlib.resources import files
from pathlib import Path

from robust_instant_policy.commands.options import positive
from robust_instant_policy.errors import UsageError
from robust_instant_policy.files import file_stem, write_whole
from robust_instant_policy.sanity import errors
from robust_instant_policy.tasks import check_task, make_task
from robust_instant_policy.tasks.task import OPTIONAL_METHODS, offers
from robust_instant_policy.tasks.task_checks import NUM_SCENES

TEMPLATE_CLASS = "PlaceBlock"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, nargs="?", metavar="FILE", help="file to write, such as my_task.py")
    parser.add_argument("--check", metavar="TASK", help="task to check: module:Class, or any other name of a task")
    parser.add_argument("--scenes", type=positive, default=NUM_SCENES, metavar="N", help="scenes to check it in")


def run(options: argparse.Namespace) -> int:
    if (options.file is None) == (options.check is None):
        raise UsageError("give the FILE to write, or --check module:Class")
    return _write(options.file) if options.check is None else _check(options.check, options.scenes)


def _write(path: Path) -> int:
    if path.exists():
        raise UsageError(f"{path} exists; choose another file")
    if path.suffix != ".py" or not path.stem.isidentifier():
        raise UsageError(f"{path} cannot be imported; its name must be a Python name and end with .py")
    write_whole(path, files("robust_instant_policy.tasks").joinpath("template.py").read_bytes())
    task = f"{path.stem}:{TEMPLATE_CLASS}"
    where = "" if path.resolve().parent == Path.cwd() else f"cd {path.resolve().parent} && "
    print(f"{path}: a task that runs; change it, then:")
    print(f"    {where}rip new-task --check {task}")
    print(f"    {where}rip record --task {task} --out data/{file_stem(task)}")
    print(f"    {where}rip eval --tasks {task} --methods neighbours gp --out runs/{path.stem}")
    return 0


def _check(name: str, num_scenes: int) -> int:
    """Prints one line for each finding; 1 if one is an error."""
    with closing(make_task(name)) as task:
        findings = check_task(task, num_scenes)
        lacking = [method for method in OPTIONAL_METHODS if not offers(task, method)]
    for finding in findings:
        print(finding)
    for method in lacking:
        print(f"unchecked: no {method}(), which is needed {OPTIONAL_METHODS[method]}")
    wrong = len(errors(findings))
    print(f"{name}: {wrong} errors, {len(findings) - wrong} other findings in {num_scenes} scenes")
    return 1 if wrong else 0
