"""What a check found out, and the errors that it becomes."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from robust_instant_policy.errors import DatasetError, RipError

Severity = Literal["error", "warning", "unchecked"]


@dataclass(frozen=True)
class Finding:
    """One result of a check.

    ``kind`` names the check ("contact", "camera", "gripper state"), ``message`` is one line for the user, and
    ``numbers`` holds what was measured, in SI units. ``cause`` names the hypothesis that explains the numbers
    ("inverse pose"), empty where none does. ``severity`` is "unchecked" where the data cannot decide.
    """

    kind: str
    severity: Severity
    message: str
    numbers: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    cause: str = ""

    def __str__(self) -> str:
        return f"{self.severity}: {self.message}"


class _FindingsError(RipError):
    """All ``findings`` in one line."""

    def __init__(self, findings: Iterable[Finding]):
        self.findings = tuple(findings)
        super().__init__("; ".join(finding.message for finding in self.findings).replace("?; ", "? "))


class GeometryError(_FindingsError):
    """Images, cameras and gripper paths that contradict each other."""


class DemonstrationError(_FindingsError, DatasetError):
    """Demonstrations that cannot be used as they are."""


class EnvelopeError(_FindingsError):
    """A plan that leaves what was demonstrated."""


def errors(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Those of ``findings`` that are errors."""
    return tuple(finding for finding in findings if finding.severity == "error")
