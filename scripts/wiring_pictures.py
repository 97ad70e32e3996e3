"""Draws docs/images/wiring-*.svg: what is connected to what in three cells. python scripts/wiring_pictures.py"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

FOLDER = Path(__file__).parents[1] / "docs" / "images"
WIDTH, HEIGHT = 150, 46  # of a box, in pixels


@dataclass(frozen=True)
class Box:
    """A device with its middle ``x, y`` in pixels; each of ``lines`` is one line of text."""

    x: int
    y: int
    lines: tuple[str, ...]


PICTURES: dict[str, tuple[int, int, dict[str, Box], tuple[tuple[str, str, str], ...]]] = {
    "wiring-aloha": (
        900, 290,
        {
            "pc": Box(440, 50, ("computer",)),
            "u2d2": Box(270, 140, ("U2D2 adapter", "/dev/serial/by-id/…")),
            "u2d2b": Box(620, 140, ("U2D2 adapter", "of the leader")),
            "camera": Box(445, 140, ("RealSense D415", "above the table")),
            "follower": Box(270, 250, ("ViperX 300", "servos 1 to 9")),
            "leader": Box(620, 250, ("WidowX 250 leader", "servos 1 to 9")),
            "power": Box(85, 250, ("12 V supply",)),
            "power2": Box(805, 250, ("12 V supply",)),
        },
        (
            ("pc", "u2d2", "USB"), ("pc", "u2d2b", "USB"), ("pc", "camera", "USB 3"),
            ("u2d2", "follower", "TTL bus, 1 Mbit/s"), ("u2d2b", "leader", "TTL bus"), ("power", "follower", "12 V"),
            ("power2", "leader", "12 V"),
        ),
    ),
    "wiring-ur5e": (
        760, 290,
        {
            "pc": Box(380, 50, ("computer",)),
            "switch": Box(130, 140, ("Ethernet cable", "or switch")),
            "camera": Box(560, 140, ("RealSense D415", "above the table")),
            "box": Box(130, 250, ("UR control box", "ports 30004, 63352")),
            "arm": Box(380, 250, ("UR5e",)),
            "gripper": Box(630, 250, ("Hand-E", "with its URCap")),
        },
        (
            ("pc", "switch", "Ethernet"), ("pc", "camera", "USB 3"), ("switch", "box", "192.168.1.x"),
            ("box", "arm", "arm cable"), ("arm", "gripper", "tool port"),
        ),
    ),
    "wiring-so101": (
        760, 290,
        {
            "pc": Box(380, 50, ("computer",)),
            "board": Box(200, 140, ("bus adapter and", "supply, follower")),
            "board2": Box(560, 140, ("bus adapter and", "supply, leader")),
            "camera": Box(380, 140, ("RealSense D405", "above the table")),
            "follower": Box(200, 250, ("SO-101 follower", "servos 1 to 6")),
            "leader": Box(560, 250, ("SO-101 leader", "servos 1 to 6")),
        },
        (
            ("pc", "board", "USB-C"), ("pc", "board2", "USB-C"), ("pc", "camera", "USB 3"),
            ("board", "follower", "TTL bus and power"), ("board2", "leader", "TTL bus and power"),
        ),
    ),
}  # fmt: skip


def svg(width: int, height: int, boxes: dict[str, Box], cables: tuple[tuple[str, str, str], ...]) -> str:
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}"',
        'font-family="sans-serif" font-size="13">',
        f'<rect width="{width}" height="{height}" fill="#fff"/>',
    ]
    for one, other, words in cables:
        a, b = boxes[one], boxes[other]
        parts.append(f'<line x1="{a.x}" y1="{a.y}" x2="{b.x}" y2="{b.y}" stroke="#5c6f91" stroke-width="2"/>')
        x, y = (a.x + b.x) / 2, (a.y + b.y) / 2
        parts.append(
            f'<text x="{x:.0f}" y="{y + 4:.0f}" text-anchor="middle" fill="#2e4a86" stroke="#fff" stroke-width="4" '
            f'paint-order="stroke">{escape(words)}</text>'
        )
    for box in boxes.values():
        left, top = box.x - WIDTH / 2, box.y - HEIGHT / 2
        parts.append(
            f'<rect x="{left:.0f}" y="{top:.0f}" width="{WIDTH}" height="{HEIGHT}" rx="6" fill="#eef2f8" '
            'stroke="#333"/>'
        )
        for index, line in enumerate(box.lines):
            y = box.y + 5 + 16 * (index - (len(box.lines) - 1) / 2)
            parts.append(f'<text x="{box.x}" y="{y:.0f}" text-anchor="middle">{escape(line)}</text>')
    return "\n".join([*parts, "</svg>", ""])


if __name__ == "__main__":
    for name, picture in PICTURES.items():
        (FOLDER / f"{name}.svg").write_text(svg(*picture))
