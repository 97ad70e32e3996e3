"""The numbers that the paper prints, in percent, to stand beside one's own (Oh et al. 2025)."""

# Table I: success rates with 10 demonstrations and GPT-4o.
TABLE1_TASKS = (
    "pick-banana", "push-cube", "open-drawer", "close-cabinet", "turn-faucet",
    "aloha-pick-banana", "aloha-hang", "aloha-sweep", "aloha-pick-place", "aloha-cup-upright",
)  # fmt: skip
TABLE1 = {
    "dp": (40, 30, 60, 100, 70, 60, 30, 40, 10, 60),
    "kat-dp": (60, 40, 20, 70, 60, 100, 50, 20, 30, 70),
    "kat": (48, 74, 42, 90, 78, 80, 50, 10, 30, 40),
    "rip-gauss": (40, 70, 50, 90, 90, 70, 60, 60, 40, 70),
    "rip": (60, 100, 70, 100, 90, 100, 90, 70, 50, 70),
}
# Sec. V-B.2, over the five tasks with gripper actions: normal and gripper-based downsampling.
DOWNSAMPLING = {"uniform": 52, "masked": 74}


def table1(method: str, task: str) -> int | None:
    """The paper's success rate in percent; None where it has none."""
    return dict(zip(TABLE1_TASKS, TABLE1[method], strict=True)).get(task) if method in TABLE1 else None
