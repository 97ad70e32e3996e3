"""Actions out of noise: the model that trained policies share, its training loss, and sampling from it."""

from collections.abc import Sequence

import torch
from diffusers import DDIMScheduler, DDPMScheduler
from torch import Tensor, nn
from torch.nn import functional

from robust_instant_policy.policies.diffusion.unet import ConditionalUnet1D

NOISE_STEPS = 100  # of the diffusion process (Chi et al. 2023, Table VIII)
SAMPLING_STEPS = 16  # of them that DDIM takes (Song et al. 2021)
WIDTHS = (64, 128, 256)
# The network predicts the clean actions, not the noise: that needs several times fewer steps of training to become
# smooth and is exact at the first of the sampling steps (Ze et al. 2024 chose it for the same reason).
_PROCESS = {
    "num_train_timesteps": NOISE_STEPS,
    "beta_schedule": "squaredcos_cap_v2",
    "prediction_type": "sample",
    "clip_sample": True,
}


class Denoiser(nn.Module):
    """p(actions | observation), where ``encoder`` turns an observation's tensors into ``condition`` numbers.

    Actions ``(B, T, channels)`` lie in [-1, 1].
    """

    def __init__(self, encoder: nn.Module, condition: int, channels: int, widths: Sequence[int] = WIDTHS):
        super().__init__()
        self.encoder = encoder
        self.unet = ConditionalUnet1D(channels, condition, widths)
        self.channels = channels

    def loss(
        self, observation: Sequence[Tensor], actions: Tensor, noise_draws: int, generator: torch.Generator
    ) -> Tensor:
        """Squared error of the denoised actions (Ho et al. 2020, Sec. 3.2), over ``noise_draws`` an observation.

        An image costs much more to encode than a sequence to denoise, so each is used several times.
        """
        condition = self.encoder(*observation).repeat_interleave(noise_draws, dim=0)
        actions = actions.repeat_interleave(noise_draws, dim=0)
        # Random numbers come from the processor's generator on every device, so that they can be put on record.
        noise = torch.randn(actions.shape, generator=generator).to(actions.device)
        steps = torch.randint(NOISE_STEPS, (len(actions),), generator=generator).to(actions.device)
        noisy = DDPMScheduler(**_PROCESS).add_noise(actions, noise, steps)
        return functional.mse_loss(self.unet(noisy, steps, condition).float(), actions)

    @torch.no_grad()
    def sample(self, condition: Tensor, length: int, generator: torch.Generator) -> Tensor:
        """Actions ``(B, length, channels)`` in [-1, 1] for ``condition (B, C)``."""
        process = DDIMScheduler(**_PROCESS)
        process.set_timesteps(SAMPLING_STEPS)
        shape = (len(condition), length, self.channels)
        actions = torch.randn(shape, generator=generator).to(condition.device)
        for step in process.timesteps:
            steps = step.to(condition.device).expand(len(condition))
            actions = process.step(self.unet(actions, steps, condition), step, actions).prev_sample
        return actions.clamp(-1.0, 1.0)
