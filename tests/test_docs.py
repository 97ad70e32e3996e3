"""Every code block of README and docs/ runs, or, where it would take hours, is at least a command that exists."""

import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

from robust_instant_policy.cli import parse

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
BLOCK = re.compile(r"^```(\w+)\n(.*?)^```", re.MULTILINE | re.DOTALL)
TARGETS = set(re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
OTHER_PROGRAMS = {
    "git", "cd", "pip", "export", "vllm", "ollama", "llama-server", "docker", "sglang", "lms", "ray",
    "setup.sh", "lerobot-record", "lerobot-rollout", "lerobot-eval",
}  # fmt: skip


def blocks(page: Path, *languages: str) -> list[str]:
    return [body for language, body in BLOCK.findall(page.read_text()) if language in languages]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_blocks_run_in_order(page, workbench, monkeypatch):
    monkeypatch.chdir(workbench)
    namespace: dict = {"__name__": "__main__"}
    for body in blocks(page, "python"):
        exec(compile(body, str(page), "exec"), namespace)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_shell_blocks_hold_commands_that_exist(page):
    for body in blocks(page, "sh", "bash", "shell"):
        for line in body.replace("\\\n", " ").splitlines():
            words = shlex.split(line, comments=True)
            while words and "=" in words[0] and not words[0].startswith("-"):
                words.pop(0)
            if not words:
                continue
            program = Path(words[0]).name
            if program == "rip":
                parse(words[1:])  # exits with a message for a wrong command
            elif program == "make":
                assert set(word for word in words[1:] if "=" not in word) <= TARGETS, line
            elif program.startswith("python"):
                assert words[1] == "-m" or (ROOT / words[1]).exists(), line
            else:
                assert program in OTHER_PROGRAMS, line


def test_result_tables_in_the_documentation_are_those_of_the_results_folder():
    command = [sys.executable, str(ROOT / "scripts" / "include_results.py"), "--check"]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stdout


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_blocks_name_their_language_and_links_lead_somewhere(page):
    text = page.read_text()
    fences = re.findall(r"^```(.*)$", text, re.MULTILINE)
    assert all(fences[0::2]), "a code block without a language"
    for target in re.findall(r"\]\((?!https?:|#|mailto:)([^)#]+)", text):
        assert (page.parent / target).exists(), f"{page.name} links to {target}"
