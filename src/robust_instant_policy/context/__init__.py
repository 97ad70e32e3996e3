"""Demonstrations as text: frames, numbers and prompt layouts."""

from robust_instant_policy.context.frames import Frame
from robust_instant_policy.context.prompt import InContextPrompt

__all__ = ["Frame", "InContextPrompt"]
