"""The documentation does what it says: examples run, names exist, links lead somewhere."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def test_the_example_of_the_readme_runs():
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    ran = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    assert "True" in ran.stdout  # 5 m on the GPS of a cart at rest is an attack


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    for target in re.findall(r"\]\(([^)#]+)[)#]", page.read_text()):
        assert "://" in target or (page.parent / target).exists(), target


def test_every_equation_has_its_line():
    names = re.findall(r"`(holdfast[\w.]+)`", (ROOT / "docs" / "equations.md").read_text())
    assert len(names) > 5
    for name in names:
        parts = name.split(".")
        for cut in range(len(parts), 0, -1):
            try:
                found = importlib.import_module(".".join(parts[:cut]))
                break
            except ModuleNotFoundError:
                continue
        for attribute in parts[cut:]:
            found = getattr(found, attribute)


def test_the_commands_of_the_readme_name_files_that_exist():
    text = (ROOT / "README.md").read_text()
    for path in re.findall(r"(examples/\S+\.(?:toml|csv))", text):
        assert (ROOT / path).is_file()
    assert "-c requirements.lock" in text
    assert (ROOT / "requirements.lock").is_file()
