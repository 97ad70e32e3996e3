"""Training that can be stopped at any moment and resumed with the same result, to the bit."""

import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from diffusers.optimization import get_cosine_schedule_with_warmup
from diffusers.training_utils import EMAModel
from torch import Tensor

from robust_instant_policy.demonstration import Demonstration
from robust_instant_policy.errors import ModelError
from robust_instant_policy.files import file_stem
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.diffusion import checkpoint
from robust_instant_policy.policies.diffusion.denoiser import Denoiser
from robust_instant_policy.policies.training import Training

BETAS = (0.95, 0.999)  # of AdamW, and the two next (Chi et al. 2023, Table VIII)
WEIGHT_DECAY = 1e-6
EMA_POWER = 0.75
WARMUP_SHARE = 0.05  # of all steps
SAVE_EVERY_S = 60.0
UNTIMED_STEPS = 3  # the first steps of a process are slower


@dataclass(frozen=True)
class TrainingSettings:
    """What decides, with the data, the weights: ``steps`` of ``batch_size`` observations with ``noise_draws`` each.

    ``details`` says in words what else does.
    """

    method: str
    steps: int
    batch_size: int
    noise_draws: int
    learning_rate: float
    seed: int
    details: str = ""


class TrainingData(Protocol):
    """Observations and the actions that go with them."""

    def __len__(self) -> int: ...

    def draw(self, indices: Tensor, generator: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor]:
        """The observations of ``indices (B,)``, as the encoder takes them, and actions ``(B, T, D)`` in [-1, 1]."""
        ...


@dataclass(frozen=True, eq=False)
class Trained:
    """A model and the ``path`` of its checkpoint; ``losses (steps,)`` on the way, ``seconds`` of wall time it took."""

    path: Path
    model: Denoiser
    losses: np.ndarray
    seconds: float


@dataclass(frozen=True, eq=False)
class Rehearsal:
    """What a policy samples in the scene of a demonstration: ``samples (Q, T, D)`` beside the ``shown (T, D)``."""

    shown: FloatArray
    samples: FloatArray


class TrainedPolicy(Protocol):
    """A policy that was fitted by training, and can sample in the scenes of its demonstrations."""

    trained_: Trained

    def rehearse(self, count: int) -> list[Rehearsal]: ...


def obtain(
    make_model: Callable[[], Denoiser],
    make_data: Callable[[], TrainingData],
    settings: TrainingSettings,
    content: Iterable[np.ndarray],
    title: str,
    training: Training,
) -> Trained:
    """The model for some data: from its checkpoint in ``training.checkpoints``, or trained now.

    The checkpoint's name starts with ``title`` and carries a fingerprint of ``settings`` and of the arrays ``content``,
    which must tell these data from others.
    """
    device = torch.device(training.device or ("cuda" if torch.cuda.is_available() else "cpu"))
    name = f"{file_stem(title)}-{checkpoint.fingerprint(settings, content)}"
    finished = training.checkpoints / f"{name}.safetensors"
    with torch.random.fork_rng():
        torch.manual_seed(settings.seed)
        model = make_model()
    if not finished.exists():
        unfinished = training.checkpoints / f"{name}.unfinished.safetensors"
        trainer = Trainer(model, make_data(), settings, device)
        if unfinished.exists():
            trainer.restore(*checkpoint.load(unfinished))
        trainer.run(unfinished, training)
        trainer.save_averaged(finished)
        unfinished.unlink(missing_ok=True)
    tensors, facts = checkpoint.load(finished)
    losses = tensors.pop("losses")
    try:
        model.load_state_dict(tensors)
    except RuntimeError as error:
        raise ModelError(f"{finished} holds another model; remove it to train again ({error})") from None
    return Trained(finished, model.to(device).eval().requires_grad_(False), losses.numpy(), facts["seconds"])


def known_by(demonstrations: Sequence[Demonstration]) -> Iterator[np.ndarray]:
    """The arrays that tell ``demonstrations`` from others."""
    for demonstration in demonstrations:
        yield demonstration.trajectory.actions
        yield np.array(demonstration.rate_hz)
        yield demonstration.observation.rgb
        yield demonstration.observation.depth


class Trainer:
    """A training under way: AdamW with warm-up and cosine decay, and the exponential average of the weights.

    The networks run in bfloat16 on CUDA, and on processors that multiply it; weights and averages stay in float32.
    """

    def __init__(self, model: Denoiser, data: TrainingData, settings: TrainingSettings, device: torch.device):
        self.model, self.data, self.settings, self.device = model.to(device).train(), data, settings, device
        self.optimizer = torch.optim.AdamW(
            model.parameters(), settings.learning_rate, betas=BETAS, weight_decay=WEIGHT_DECAY, fused=True
        )
        self.schedule = get_cosine_schedule_with_warmup(
            self.optimizer, round(WARMUP_SHARE * settings.steps), settings.steps
        )
        self.average = EMAModel(model.parameters(), use_ema_warmup=True, power=EMA_POWER, foreach=True)
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.losses: list[float] = []
        self.seconds = 0.0

    def step(self) -> float:
        """One step of gradient descent; its loss."""
        indices = torch.randint(len(self.data), (self.settings.batch_size,), generator=self.generator)
        observation, actions = self.data.draw(indices, self.generator)
        with torch.autocast(self.device.type, torch.bfloat16, enabled=_multiplies_bfloat16(self.device)):
            loss = self.model.loss(
                [part.to(self.device) for part in observation],
                actions.to(self.device),
                self.settings.noise_draws,
                self.generator,
            )
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        self.schedule.step()
        self.average.step(self.model.parameters())
        self.losses.append(loss.item())
        return self.losses[-1]

    def run(self, unfinished: Path, training: Training) -> None:
        """Take the steps that are missing, keeping the state in the file ``unfinished``."""
        start = saved = time.perf_counter()
        before, spent = len(self.losses), self.seconds
        timed_from, timed_at = before, start
        while len(self.losses) < self.settings.steps:
            loss = self.step()
            now = time.perf_counter()
            self.seconds = spent + now - start
            done = len(self.losses)
            if done - before == UNTIMED_STEPS:
                timed_from, timed_at = done, now
            elif done - before > UNTIMED_STEPS:
                left = (now - timed_at) / (done - timed_from) * (self.settings.steps - done)
                training.report(self.settings.method, done, self.settings.steps, loss, left)
            if now - saved > SAVE_EVERY_S:
                checkpoint.save(unfinished, *self.state())
                saved = time.perf_counter()

    def state(self) -> tuple[dict[str, Tensor], dict[str, float]]:
        """Everything that the steps to come depend on."""
        tensors = {f"weights/{name}": value for name, value in self.model.state_dict().items()}
        for index, (parameter, averaged) in enumerate(
            zip(self.model.parameters(), self.average.shadow_params, strict=True)
        ):
            tensors[f"average/{index}"] = averaged
            tensors |= {f"optimizer/{index}/{key}": value for key, value in self.optimizer.state[parameter].items()}
        tensors["generator"] = self.generator.get_state()
        tensors["losses"] = torch.tensor(self.losses)
        return tensors, {"seconds": self.seconds}

    def restore(self, tensors: dict[str, Tensor], facts: dict[str, float]) -> None:
        """Go on from what `state` returned."""
        self.model.load_state_dict({name: tensors[f"weights/{name}"] for name in self.model.state_dict()})
        for index, parameter in enumerate(self.model.parameters()):
            self.average.shadow_params[index].copy_(tensors[f"average/{index}"])
            prefix = f"optimizer/{index}/"
            self.optimizer.state[parameter] = {
                name.removeprefix(prefix): value.to(self.device)
                for name, value in tensors.items()
                if name.startswith(prefix)
            }
        self.generator.set_state(tensors["generator"])
        self.losses = tensors["losses"].tolist()
        self.seconds = facts["seconds"]
        self.average.optimization_step = self.schedule.last_epoch = len(self.losses)
        schedule = zip(self.optimizer.param_groups, self.schedule.base_lrs, self.schedule.lr_lambdas, strict=True)
        for group, rate, share in schedule:
            group["lr"] = rate * share(len(self.losses))

    def save_averaged(self, path: Path) -> None:
        """Write the averaged weights, which are those to act with, and how the loss fell."""
        self.average.copy_to(self.model.parameters())
        tensors = dict(self.model.state_dict()) | {"losses": torch.tensor(self.losses)}
        checkpoint.save(path, tensors, {"seconds": self.seconds})


def _multiplies_bfloat16(device: torch.device) -> bool:
    return device.type == "cuda" or bool(torch.cpu.get_capabilities().get("avx512_bf16", False))
