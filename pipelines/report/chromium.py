"""Chromium: where it is, and the PDF of a page, printed without a window and without a network."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from pipelines.core.errors import BackendUnavailableError, CrashError
from pipelines.core.files import replace_file

_ON_PATH = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome", "msedge")
# Where browsers are on macOS and Windows, which do not put them on PATH.
_INSTALLED = (
    "/Applications/Google Chrome.app/Contents/MacOS/Google Chrome",
    "/Applications/Chromium.app/Contents/MacOS/Chromium",
    "C:/Program Files/Google/Chrome/Application/chrome.exe",
    "C:/Program Files (x86)/Microsoft/Edge/Application/msedge.exe",
)
NO_NETWORK = "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1"
_TIMEOUT_S = 300.0
_LONGEST_MESSAGE = 300
_WITHOUT_PDF = "Leave out --pdf, and print the page from any browser."


def find_chromium() -> str | None:
    """Return Chromium or Chrome: as the variable CHROMIUM names it, else an installed one; None: there is none."""
    on_path = (shutil.which(name) for name in _ON_PATH)
    installed = (place for place in _INSTALLED if Path(place).is_file())
    return os.environ.get("CHROMIUM") or next(filter(None, [*on_path, *installed]), None)


def chromium_path() -> str:
    """Return Chromium or Chrome as `find_chromium`; a BackendUnavailableError says what to install or correct."""
    browser = find_chromium()
    if os.environ.get("CHROMIUM") and browser and shutil.which(browser) is None:
        raise BackendUnavailableError(
            "chromium-variable",
            f"The environment variable CHROMIUM names {browser}, which is no program.",
            remedy="Correct it, or unset it.",
        )
    if browser is None:
        raise BackendUnavailableError(
            "chromium-missing",
            "--pdf needs Chromium or Chrome, and neither is installed.",
            remedy="Install one (`apt-get install chromium`), or name its path in the variable CHROMIUM.",
        )
    return browser


def print_pdf(page: Path, pdf: Path) -> None:
    """Print an HTML file as PDF, which appears when complete; errors as of `chromium_path`, or a CrashError."""
    browser = chromium_path()
    with tempfile.TemporaryDirectory() as profile:
        draft = pdf.with_suffix(".tmp")
        command = [
            browser,
            "--headless=new",
            "--disable-gpu",
            "--no-first-run",
            "--disable-extensions",
            "--disable-background-networking",
            NO_NETWORK,
            f"--user-data-dir={profile}",
            "--no-pdf-header-footer",
            f"--print-to-pdf={draft.absolute()}",
        ]
        if hasattr(os, "geteuid") and os.geteuid() == 0:  # Chromium's sandbox refuses root, in containers mostly.
            command.append("--no-sandbox")
        try:
            done = subprocess.run(
                [*command, page.absolute().as_uri()],
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                errors="replace",
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            message = f"{browser} did not print the page within {_TIMEOUT_S:.0f} s. {_WITHOUT_PDF}"
            raise CrashError("chromium-timeout", message) from error
        if done.returncode != 0 or not draft.is_file():
            reason = " ".join(done.stderr.split())[-_LONGEST_MESSAGE:]
            message = f"{browser} did not print the page (exit code {done.returncode}): {reason}. {_WITHOUT_PDF}"
            raise CrashError("chromium-failed", message)
    replace_file(draft, pdf)
