"""What the tests of pages share: a parser of their elements and text, and a browser where there is one."""

import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

BROWSER = shutil.which("chromium") or shutil.which("google-chrome")
OPTIONS = (
    "--headless", "--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
    "--enable-logging=stderr", "--virtual-time-budget=2000",
)  # fmt: skip


class Page(HTMLParser):
    """``of(tag)`` are the attributes of all elements of a kind; ``text`` is what can be read."""

    def __init__(self, content: str):
        super().__init__()
        self.seen: list[tuple[str, dict]] = []
        self.text, self._hidden = "", False
        self.feed(content)

    def handle_starttag(self, tag, attributes):
        self.seen.append((tag, dict(attributes)))
        self._hidden = tag in ("script", "style")

    def handle_endtag(self, tag):
        self._hidden = False

    def handle_data(self, data):
        if not self._hidden:
            self.text += data

    def of(self, tag):
        return [attributes for name, attributes in self.seen if name == tag]

    def loaded(self) -> list[str]:
        """All addresses that are not part of the page itself."""
        addresses = [attributes.get(name, "#") for _, attributes in self.seen for name in ("src", "href")]
        return [address for address in addresses if not address.startswith(("data:", "#"))]


def drawn(page: Path, tmp_path: Path) -> tuple[str, str]:
    """The page's document after its scripts ran in the browser, and what the browser logged."""
    profile = f"--user-data-dir={tmp_path / 'profile'}"
    done = subprocess.run(
        [BROWSER, *OPTIONS, profile, "--dump-dom", page.as_uri()], capture_output=True, text=True, timeout=120
    )
    return done.stdout, done.stderr
