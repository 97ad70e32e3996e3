"""Diffusion Policy over raw images (Chi et al. 2023, CNN version), in closed loop.

images ─ResNet-18─▶ places ┐
                           ├─▶ U-Net denoises the next 16 actions ─▶ 8 of them are executed ─▶ look again
the gripper, twice ────────┘
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from robust_instant_policy.demonstration import Demonstration, Observation
from robust_instant_policy.errors import DatasetError, UsageError
from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.diffusion.denoiser import Denoiser
from robust_instant_policy.policies.diffusion.grippers import Grippers
from robust_instant_policy.policies.diffusion.scaling import Scaling
from robust_instant_policy.policies.diffusion.training import Rehearsal, Trained, TrainingSettings, known_by, obtain
from robust_instant_policy.policies.diffusion.vision import ImageEncoder
from robust_instant_policy.policies.training import Training

METHOD = "dp"
DECISIONS_HZ = 11.0  # actions a second; faster recordings are thinned out to about that
HISTORY = 2  # observations shown, and the next two: actions predicted, and executed (Chi et al. 2023, Table VIII)
HORIZON = 16
EXECUTED = 8
IMAGE_PIXELS = 96  # images are scaled to squares of this size
CROP_PIXELS = 88  # of it that is shown: a random square in training, the middle one afterwards
BATCH_SIZE = 16
NOISE_DRAWS = 4
LEARNING_RATE = 3e-4

STILL_M = 0.004  # plans that lead nowhere further than this
STILL_PLANS = 2  # twice in a row say that the policy is done
PATIENCE = 2.0  # an episode may last this many times as long as the longest demonstration


class ImageDiffusion:
    """Diffusion Policy. See `policies.policy.ClosedLoopPolicy`; its demonstrations need images along the way."""

    name = METHOD
    trained_: Trained

    def __init__(self, training: Training | None = None):
        self.training = training or Training()

    def fit(self, demonstrations: Sequence[Demonstration]) -> Self:
        """Load the weights that belong to ``demonstrations``, or train them; returns itself.

        Raises `DatasetError` for demonstrations without images along the way.
        """
        if not demonstrations:
            raise DatasetError("no demonstrations; show the task at least once (rip record --images)")
        every = max(1, round(demonstrations[0].rate_hz / DECISIONS_HZ))
        self.rate_hz = demonstrations[0].rate_hz / every
        self.max_seconds = PATIENCE * max(demonstration.seconds for demonstration in demonstrations)
        self._shown, self._every = demonstrations, every
        actions = [shown.trajectory.actions[_kept(len(shown.trajectory), every)] for shown in demonstrations]
        self._scaling, self._grippers = Scaling.of(np.concatenate(actions)), Grippers.of(np.concatenate(actions))
        details = f"{HORIZON} actions at {self.rate_hz:g} Hz, crops of {CROP_PIXELS} of {IMAGE_PIXELS} pixels"
        steps, seed = self.training.steps, self.training.seed
        settings = TrainingSettings(METHOD, steps, BATCH_SIZE, NOISE_DRAWS, LEARNING_RATE, seed, details)
        width = actions[0].shape[1]
        self.trained_ = obtain(
            lambda: Denoiser(_Encoder(), HISTORY * (ImageEncoder.features + width), width),
            lambda: _ImageData([_images(shown, every) for shown in demonstrations], map(self._scaling.scaled, actions)),
            settings,
            known_by(demonstrations),
            f"{METHOD}-{demonstrations[0].task}-{len(demonstrations)}",
            self.training,
        )
        return self

    def controller(self, observation: Observation) -> DiffusionController:
        """For one episode; it receives observations as the episode goes on."""
        if not hasattr(self, "trained_"):
            raise UsageError("call fit(demonstrations) before asking for a controller")
        return DiffusionController(self.trained_.model, self._scaling, self._grippers, self.rate_hz, self.training.seed)

    def rehearse(self, count: int) -> list[Rehearsal]:
        """The actions that it plans at each of its observations along the first ``count`` demonstrations."""
        rehearsals = []
        for demonstration in self._shown[:count]:
            actions = demonstration.trajectory.actions[_kept(len(demonstration.trajectory), self._every)]
            controller = self.controller(demonstration.observation)
            images = _images(demonstration, self._every)
            seen = [controller.look(image, now) for image, now in zip(images, actions, strict=True)]
            plans = [
                controller.planned(seen[max(0, step - 1) : step + 1]) for step in range(0, len(seen) - 1, EXECUTED)
            ]
            rehearsals.append(Rehearsal(actions[1:], np.concatenate(plans)[None, : len(actions) - 1]))
        return rehearsals


class DiffusionController:
    """Plans `HORIZON` actions, commands `EXECUTED` of them, looks again. See `controller.Controller`."""

    def __init__(self, model: Denoiser, scaling: Scaling, grippers: Grippers, rate_hz: float, seed: int):
        self.rate_hz = rate_hz
        self._model, self._scaling, self._grippers = model, scaling, grippers
        self._generator = torch.Generator().manual_seed(seed)
        self._seen: list[Tensor] = []  # what was made of the last two images and of the gripper in them
        self._commanded: FloatArray | None = None
        self._pending: FloatArray | None = None
        self._still = 0

    def act(self, observation: Observation, action: FloatArray) -> FloatArray | None:
        # Recordings hold the commanded hand, which leads the measured one a little, so the model is shown the command.
        state = action if self._commanded is None else self._commanded
        self._seen = [*self._seen[1 - HISTORY :], self.look(small(observation.rgb), state)]
        if self._pending is not None:
            waypoints, self._pending = self._pending, None
            self._commanded = waypoints[-1]
            return waypoints
        if self._still == STILL_PLANS:
            return None
        waypoints = self.planned(self._seen)
        led_to = np.abs(waypoints - state).max()
        self._still = self._still + 1 if led_to < STILL_M else 0
        # The last one waits for another look: the model knows the scene by the images before and after it.
        waypoints, self._pending = waypoints[:-1], waypoints[-1:]
        self._commanded = waypoints[-1]
        return waypoints

    @torch.no_grad()
    def planned(self, seen: Sequence[Tensor]) -> FloatArray:
        """The next waypoints ``(EXECUTED, 10·A)`` after what was ``seen``, at most `HISTORY` looks, the newest last."""
        condition = torch.cat([seen[0]] * (HISTORY - len(seen)) + list(seen), dim=-1)
        sample = self._model.sample(condition, HORIZON, self._generator)[0, :EXECUTED]
        return self._grippers.nearest(self._scaling.restored(sample.cpu().numpy().astype(np.float64)))

    @torch.no_grad()
    def look(self, image: Tensor, action: FloatArray) -> Tensor:
        """What the model makes of one image, as `small` returns it, and of the gripper in it ``(1, C)``."""
        device = next(self._model.parameters()).device
        margin = (IMAGE_PIXELS - CROP_PIXELS) // 2
        offsets = torch.full((1, 1, 2), margin)
        state = torch.tensor(self._scaling.scaled(action), dtype=torch.float32)[None, None]
        return self._model.encoder(image[None, None].to(device), offsets.to(device), state.to(device))


class _Encoder(nn.Module):
    """Condition ``(B, C)`` from ``images (B, H, 3, s, s)`` uint8, their crops' ``offsets (B, H, 2)`` and the gripper's
    ``states (B, H, D)``."""

    def __init__(self) -> None:
        super().__init__()
        self.image = ImageEncoder(IMAGE_PIXELS)

    def forward(self, images: Tensor, offsets: Tensor, states: Tensor) -> Tensor:
        rows = offsets[..., 0, None, None] + torch.arange(CROP_PIXELS, device=images.device)[:, None]
        columns = offsets[..., 1, None, None] + torch.arange(CROP_PIXELS, device=images.device)
        index = (rows * IMAGE_PIXELS + columns).flatten(-2)[..., None, :].expand(-1, -1, 3, -1)
        crops = images.flatten(-2).gather(-1, index).unflatten(-1, (CROP_PIXELS, CROP_PIXELS)).float() / 255
        places = self.image(crops.flatten(0, 1), offsets.flatten(0, 1)).unflatten(0, images.shape[:2])
        return torch.cat([places, states], dim=-1).flatten(1)


class _ImageData:
    """Every moment of every episode: images and gripper of the last two, and the actions that follow."""

    def __init__(self, images: Sequence[Tensor], actions: Iterable[FloatArray]):
        self._images = torch.cat(list(images))
        episodes = [torch.tensor(own, dtype=torch.float32) for own in actions]
        self._actions = torch.cat(episodes)
        lengths = torch.tensor([len(own) for own in episodes])
        ends = lengths.cumsum(0)
        self._first = (ends - lengths).repeat_interleave(lengths)
        self._last = (ends - 1).repeat_interleave(lengths)

    def __len__(self) -> int:
        return len(self._images)

    def draw(self, indices: Tensor, generator: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor]:
        past = indices[:, None] + torch.arange(1 - HISTORY, 1)
        past = torch.maximum(past, self._first[indices, None])
        future = indices[:, None] + torch.arange(1, HORIZON + 1)
        future = torch.minimum(future, self._last[indices, None])
        corners = torch.randint(IMAGE_PIXELS - CROP_PIXELS + 1, (len(indices), 1, 2), generator=generator)
        observation = (self._images[past], corners.expand(-1, HISTORY, -1), self._actions[past])
        return observation, self._actions[future]


def small(image: NDArray[np.uint8]) -> Tensor:
    """``image (H, W, 3)`` as the network takes it, ``(3, IMAGE_PIXELS, IMAGE_PIXELS)`` uint8."""
    whole = torch.tensor(image).permute(2, 0, 1)[None].float()
    size = (IMAGE_PIXELS, IMAGE_PIXELS)
    scaled = functional.interpolate(whole, size, mode="bilinear", antialias=True, align_corners=False)
    return scaled[0].round().clamp(0, 255).to(torch.uint8)


def _images(demonstration: Demonstration, every: int) -> Tensor:
    if demonstration.frames is None:
        raise DatasetError(
            f"{METHOD} learns from images along the way, and the demonstrations have none; record them with: "
            f"rip record --task {demonstration.task or 'TASK'} --images --every 5 --out DIR"
        )
    kept = range(len(demonstration.trajectory))[_kept(len(demonstration.trajectory), every)]
    return torch.stack([small(frame) for step, frame in enumerate(demonstration.frames()) if step in kept])


def _kept(num_steps: int, every: int) -> slice:
    """Every ``every``-th of ``num_steps``, the last one included."""
    return slice((num_steps - 1) % every, None, every)
