"""Does the geometry of demonstrations, images and plans hold together?"""

from robust_instant_policy.sanity.envelope import Envelope
from robust_instant_policy.sanity.finding import DemonstrationError, EnvelopeError, Finding, GeometryError, errors
from robust_instant_policy.sanity.report import Reference, SetReport, check_demonstrations
from robust_instant_policy.sanity.surroundings import Surroundings
from robust_instant_policy.sanity.view import View

__all__ = [
    "DemonstrationError",
    "Envelope",
    "EnvelopeError",
    "Finding",
    "GeometryError",
    "Reference",
    "SetReport",
    "Surroundings",
    "View",
    "check_demonstrations",
    "errors",
]
