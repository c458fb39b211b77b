"""A real browser without a window, where there is one."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import dataclass
from pathlib import Path

import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell")


@dataclass(frozen=True)
class Opened:
    """What became of a page: the document after its script has run, and what the browser complained of."""

    dom: str
    complaints: list[str]

    @property
    def title(self) -> str:
        return self.dom.partition("<title>")[2].partition("</title>")[0]

    @property
    def rows(self) -> list[str]:
        """Sequences of the table, in the order shown."""
        body = self.dom.partition("<tbody>")[2].partition("</tbody>")[0]
        return re.findall(r'<th scope="row"><a href="#s\d+">(.*?)</a>', body, re.DOTALL)

    @property
    def count(self) -> str:
        return self.dom.partition('<output id="count"')[2].partition(">")[2].partition("</output>")[0]


def find_browser() -> str:
    """The browser's path; skips the test where there is none."""
    given = os.environ.get("DOPE_CHROMIUM")
    found = given or next((path for name in NAMES if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"no browser: none of {', '.join(NAMES)} is in PATH, and DOPE_CHROMIUM is not set")
    return found


def open_page(page: Path, address: str = "", *, profile: Path, height: int = 1200) -> Opened:
    """Open a page, wait until it is loaded, and return what it has become."""
    command = [find_browser(), "--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--v=0",
               f"--user-data-dir={profile}", f"--window-size=1300,{height}", "--virtual-time-budget=4000", "--dump-dom",
               page.resolve().as_uri() + address]  # fmt: skip
    answer = subprocess.run(command, capture_output=True, text=True, timeout=180, check=True)
    return Opened(answer.stdout, [line for line in answer.stderr.splitlines() if "CONSOLE" in line])
