"""Language models: any server that speaks OpenAI's protocol, any llama.cpp model file, and one that is embedded."""

from robust_instant_policy.llm.connect import connect, model_name
from robust_instant_policy.llm.model import LanguageModel, Listener, Sampling
from robust_instant_policy.llm.store import RecordedModel, ReplayedModel, SampleStore

__all__ = [
    "LanguageModel",
    "Listener",
    "RecordedModel",
    "ReplayedModel",
    "SampleStore",
    "Sampling",
    "connect",
    "model_name",
]
