"""Demonstrations as text: frames, numbers and prompt layouts."""

from robust_instant_policy.context.factorised import FactorisedPrompt
from robust_instant_policy.context.frames import Frame
from robust_instant_policy.context.leave_one_out import leave_one_out
from robust_instant_policy.context.prompt import Frames, Layout, Prompt
from robust_instant_policy.context.sequence import SequencePrompt
from robust_instant_policy.context.writing import write_prompt

__all__ = [
    "FactorisedPrompt",
    "Frame",
    "Frames",
    "Layout",
    "Prompt",
    "SequencePrompt",
    "leave_one_out",
    "write_prompt",
]
