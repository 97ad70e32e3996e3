"""Language models: servers that speak OpenAI's protocol, llama.cpp model files, and the embedded model."""

from robust_instant_policy.llm.connect import check_server, connect, model_name
from robust_instant_policy.llm.model import DEADLINE_S, LanguageModel, Listener, Sampling, refusal_advice
from robust_instant_policy.llm.store import RecordedModel, ReplayedModel, SampleStore

__all__ = [
    "DEADLINE_S",
    "LanguageModel",
    "Listener",
    "RecordedModel",
    "ReplayedModel",
    "SampleStore",
    "Sampling",
    "check_server",
    "connect",
    "model_name",
    "refusal_advice",
]
