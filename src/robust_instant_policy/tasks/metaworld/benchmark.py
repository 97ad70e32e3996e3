"""Meta-World's fifty tasks: their names, their groups of difficulty, and what others published."""

from __future__ import annotations

PREFIX = "metaworld/"

# Groups of difficulty of Seo et al. (2022, "Masked World Models for Visual Control"), which SmolVLA uses, too.
GROUPS: dict[str, tuple[str, ...]] = {
    "easy": (
        "button-press", "button-press-topdown", "button-press-topdown-wall", "button-press-wall", "coffee-button",
        "dial-turn", "door-close", "door-lock", "door-open", "door-unlock", "drawer-close", "drawer-open", "faucet-close",
        "faucet-open", "handle-press", "handle-press-side", "handle-pull", "handle-pull-side", "lever-pull",
        "peg-unplug-side", "plate-slide", "plate-slide-back", "plate-slide-back-side", "plate-slide-side", "reach",
        "reach-wall", "window-close", "window-open",
    ),
    "medium": (
        "basketball", "bin-picking", "box-close", "coffee-pull", "coffee-push", "hammer", "peg-insert-side", "push-wall",
        "soccer", "sweep", "sweep-into",
    ),
    "hard": ("assembly", "hand-insert", "pick-out-of-hole", "pick-place", "push", "push-back"),
    "very hard": ("disassemble", "pick-place-wall", "shelf-place", "stick-pull", "stick-push"),
}  # fmt: skip
NAMES = tuple(name for group in GROUPS.values() for name in group)

# Everything that this package chose for Meta-World was chosen on these; the others are for measuring only.
TUNING = (
    "reach", "push", "pick-place", "door-open", "drawer-open", "peg-insert-side", "bin-picking", "shelf-place",
    "stick-pull", "lever-pull",
)  # fmt: skip

# Success in percent by group, in the order of `GROUPS`, of one policy for all tasks, trained on 50 demonstrations of
# each: Shukor et al. (2025, "SmolVLA", simulation benchmarks). Their average is over the four groups.
PUBLISHED: dict[str, tuple[float, float, float, float]] = {
    "Diffusion Policy": (23.1, 10.7, 1.9, 6.1),
    "TinyVLA": (77.6, 21.5, 11.4, 15.8),
    "π0 (3.5B)": (71.8, 48.2, 41.7, 30.0),
    "π0 (3.5B, from PaliGemma)": (80.4, 40.9, 36.7, 44.0),
    "SmolVLA (0.45B)": (82.5, 41.8, 45.0, 60.0),
    "SmolVLA (2.25B)": (87.14, 51.82, 70.0, 64.0),
}
