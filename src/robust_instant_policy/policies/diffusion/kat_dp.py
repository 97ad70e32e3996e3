"""KAT-DP: the keypoints of KAT in, its trajectory out, with a diffusion model in place of the language model.

The method of the paper's comparison (Di Palo and Johns 2024; Oh et al. 2025, Sec. V-A.2).
"""

from typing import Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from robust_instant_policy.geometry import FloatArray
from robust_instant_policy.policies.aggregation import take_first
from robust_instant_policy.policies.context import Context, LocatedScene
from robust_instant_policy.policies.diffusion.denoiser import Denoiser
from robust_instant_policy.policies.diffusion.grippers import Grippers
from robust_instant_policy.policies.diffusion.scaling import Scaling
from robust_instant_policy.policies.diffusion.training import Rehearsal, Trained, TrainingSettings, known_by, obtain
from robust_instant_policy.policies.keypoint_policy import KeypointPolicy
from robust_instant_policy.policies.policy import Plan, Stopwatch
from robust_instant_policy.policies.sampling import Proposal
from robust_instant_policy.policies.settings import Settings
from robust_instant_policy.policies.training import Training
from robust_instant_policy.trajectory import Trajectory

METHOD = "kat-dp"
BATCH_SIZE = 32
NOISE_DRAWS = 1
LEARNING_RATE = 3e-4
KEYPOINT_NOISE_M = 0.003  # keypoints of a new scene are about this uncertain; training sees that
LENGTH_MULTIPLE = 4  # of the sequences that the network takes


class KeypointDiffusion(KeypointPolicy):
    """Whole trajectories, downsampled as for KAT, sampled by diffusion given the scene's keypoints; open loop.

    ``num_queries`` samples are drawn and the first one is executed, as KAT does.
    """

    name = METHOD
    trained_: Trained

    def __init__(self, settings: Settings | None = None, training: Training | None = None, **options: Any):
        super().__init__(settings, **options)
        self.training = training or Training()

    def fit_context(self, context: Context) -> Self:
        """Load the weights that belong to the demonstrations, or train them; returns itself."""
        super().fit_context(context)
        demonstrations = context.demonstrations
        aligned = context.prompt.aligned
        keypoints = context.keypoints[list(aligned.kept)].reshape(len(aligned.kept), -1)
        actions = aligned.actions
        self._keypoints, self._actions = keypoints, actions
        self._inputs, self._outputs, self._grippers = Scaling.of(keypoints), Scaling.of(actions), Grippers.of(actions)
        # the last step is repeated up to a length that the network takes
        padding = ((0, 0), (0, -actions.shape[1] % LENGTH_MULTIPLE), (0, 0))
        data = _KeypointData(
            torch.tensor(self._inputs.scaled(keypoints), dtype=torch.float32),
            torch.tensor(KEYPOINT_NOISE_M / self._inputs.half_range, dtype=torch.float32),
            torch.tensor(np.pad(self._outputs.scaled(actions), padding, mode="edge"), dtype=torch.float32),
        )
        steps, seed, details = self.training.steps, self.training.seed, _described(self.settings)
        settings = TrainingSettings(METHOD, steps, BATCH_SIZE, NOISE_DRAWS, LEARNING_RATE, seed, details)
        self.trained_ = obtain(
            lambda: Denoiser(nn.Identity(), keypoints.shape[1], actions.shape[2]),
            lambda: data,
            settings,
            # Not by the keypoints: their last bits depend on the number of threads that found them.
            known_by(demonstrations),
            f"{METHOD}-{demonstrations[0].task}-{len(demonstrations)}",
            self.training,
        )
        return self

    def plan_scene(self, scene: LocatedScene) -> Plan:
        watch = Stopwatch()
        with watch.stage("diffusion"):
            candidates = self._sampled(scene.keypoints, self.trained_.model)
        return take_first(self.context_, scene, Proposal(candidates, tuple(watch.stages)))

    def executions(self, plan: Plan) -> tuple[Trajectory, ...]:
        """The first sample."""
        return plan.candidates[:1]

    def rehearse(self, count: int) -> list[Rehearsal]:
        """Its samples in the scenes of the first ``count`` demonstrations."""
        return [
            Rehearsal(shown, np.stack([sample.actions for sample in self._sampled(keypoints, self.trained_.model)]))
            for keypoints, shown in zip(self._keypoints[:count], self._actions[:count], strict=True)
        ]

    def _sampled(self, keypoints: FloatArray, model: Denoiser) -> tuple[Trajectory, ...]:
        device = next(model.parameters()).device
        condition = torch.tensor(self._inputs.scaled(keypoints.ravel()), dtype=torch.float32, device=device)
        generator = torch.Generator().manual_seed(self.training.seed)
        num_steps = self._actions.shape[1]
        length = -(-num_steps // LENGTH_MULTIPLE) * LENGTH_MULTIPLE
        samples = model.sample(condition.expand(self.settings.num_queries, -1), length, generator)
        actions = self._outputs.restored(samples.cpu().numpy().astype(np.float64))
        return tuple(Trajectory.from_actions(self._grippers.nearest(own[:num_steps])) for own in actions)


class _KeypointData:
    """Scaled ``keypoints (I, 3·K)``, with noise of size ``noise (3·K,)``, and ``actions (I, T, D)``."""

    def __init__(self, keypoints: Tensor, noise: Tensor, actions: Tensor):
        self._keypoints, self._noise, self._actions = keypoints, noise, actions

    def __len__(self) -> int:
        return len(self._keypoints)

    def draw(self, indices: Tensor, generator: torch.Generator) -> tuple[tuple[Tensor, ...], Tensor]:
        keypoints = self._keypoints[indices]
        noise = self._noise * torch.randn(keypoints.shape, generator=generator)
        return (keypoints + noise,), self._actions[indices]


def _described(settings: Settings) -> str:
    """The settings that decide the weights; default values are left out, so that names of checkpoints stay the same."""
    found = {str(settings.keypoints), settings.column} - {Settings().keypoints, Settings().column}
    return (
        f"{settings.num_keypoints} keypoints by {' '.join((settings.features, *sorted(found)))}, "
        f"{settings.downsampling} downsampling to {settings.num_steps} steps"
    )
