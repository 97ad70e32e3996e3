"""What is known of a benchmark of other people beside its tasks: groups, tuning tasks, published results."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Benchmark:
    """``groups`` of the ``name``'s tasks by difficulty, ``NAME/TASK``; ``tuning`` are those on which this package was
    tuned, the others are for measuring only; ``published`` success in percent by group, in the order of ``groups``, of
    other people's policies; ``protocol`` says, for the caption of a table, what differs between theirs and ours."""

    name: str
    groups: Mapping[str, tuple[str, ...]]
    tuning: tuple[str, ...] = ()
    published: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    protocol: str = ""

    @property
    def tasks(self) -> tuple[str, ...]:
        return tuple(task for group in self.groups.values() for task in group)
