"""What belongs into the repository and what does not."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.needs import needed

ROOT = Path(__file__).parents[2]


@pytest.mark.skipif(not (ROOT / ".git").exists() or shutil.which("git") is None, reason="this is no checkout by git")
def test_nothing_is_tracked_that_is_to_be_ignored() -> None:
    """A wheel once lay in the root: build products are in .gitignore, and nothing that it names is tracked."""
    command = ["git", "-c", f"safe.directory={ROOT}", "ls-files", "--cached", "--ignored", "--exclude-standard"]
    tracked = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert tracked.stdout == ""


def test_the_readme_of_the_wheel_has_no_link_into_this_repository() -> None:
    needed("hatchling")
    command = [sys.executable, "-m", "hatchling", "metadata", "readme"]
    made = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    assert "To use it: " in made.stdout
    assert not re.search(r"\]\((?!https?:)", made.stdout)
