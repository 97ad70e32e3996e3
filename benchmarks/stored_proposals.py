"""Proposals of a language model in the scenes of a run of `rip eval`, from its stored samples."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm

import robust_instant_policy as rip
from robust_instant_policy.evaluation.scenes import SPLITS
from robust_instant_policy.evaluation.suites import SIMULATION_TASKS
from robust_instant_policy.llm import ReplayedModel, SampleStore, model_name
from robust_instant_policy.policies import (
    Context,
    LocatedScene,
    Proposal,
    Settings,
    build_context,
    locate,
    propose,
    sample,
)
from robust_instant_policy.tasks import make_task

NUM_DEMOS, NUM_QUERIES = 10, 5


def proposals(
    task_name: str, data: Path, samples: Path, llm: str, scenes: int
) -> Iterator[tuple[int, Context, LocatedScene, Proposal]]:
    """For each scene: seed, context of the demonstrations, located keypoints, and proposal."""
    task = make_task(task_name)
    demonstrations = rip.load_demonstrations(data / task_name, task=task_name, limit=NUM_DEMOS)
    model = ReplayedModel(SampleStore(samples), model_name(llm))
    settings = Settings(num_queries=NUM_QUERIES).changed(workspace=task.workspace)
    context = build_context(demonstrations, settings)
    for seed in tqdm(range(SPLITS["tune"], SPLITS["tune"] + scenes), desc=task_name):
        scene = locate(context, task.reset(seed))
        drawn = sample(context, scene, model, settings, NUM_QUERIES)
        yield seed, context, scene, propose(context, scene, drawn, NUM_QUERIES)
    task.close()


def arguments(doc: str | None) -> argparse.ArgumentParser:
    """Arguments of all benchmarks on stored samples, except the samples."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the demonstrations")
    parser.add_argument("--tasks", nargs="+", default=SIMULATION_TASKS)
    parser.add_argument("--llm", default="embedded", help="the model of that run")
    parser.add_argument("--out", type=Path, required=True, help="the table")
    return parser
