"""Pages opened in a real browser: Chromium without a window, by its driver."""

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

#: As root there is no sandbox; WebGL is drawn in software; nothing is asked of anybody at start.
_FLAGS = (
    "--headless",
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
)

#: How long a page may take until it says that it is ready.
_PATIENCE_S = 60.0


class Tab:
    """One tab of a browser.

    Parameters
    ----------
    driver : selenium.webdriver.Chrome
    """

    def __init__(self, driver: Any) -> None:
        self.driver = driver

    def open(self, page: Path, *, width_px: int = 1366, dark: bool = False) -> None:
        """Open a page from where it lies, and wait until it is ready."""
        self.command(
            "Emulation.setDeviceMetricsOverride",
            width=width_px,
            height=900,
            deviceScaleFactor=1,
            mobile=width_px < 500,
        )
        feature = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.command("Emulation.setEmulatedMedia", features=[feature])
        self.driver.get(page.resolve().as_uri())
        self.until("return document.documentElement.dataset.ready === 'yes'")

    def command(self, name: str, **arguments: Any) -> Any:
        """Ask of the browser itself."""
        return self.driver.execute_cdp_cmd(name, arguments)

    def run(self, script: str, *arguments: Any) -> Any:
        """Run JavaScript in the page, and return what it returns."""
        return self.driver.execute_script(script, *arguments)

    def until(self, script: str) -> None:
        """Wait until JavaScript returns something true."""
        end = time.monotonic() + _PATIENCE_S
        while not self.run(script):
            assert time.monotonic() < end, f"still not: {script}\n{self.complaints()}"
            time.sleep(0.05)

    def one(self, selector: str) -> Any:
        """Return the first element of a CSS selector."""
        return self.driver.find_element("css selector", selector)

    def complaints(self) -> list[str]:
        """Return what the console has had to complain of since it was last asked."""
        return [entry["message"] for entry in self.driver.get_log("browser")]

    def asked(self) -> list[str]:
        """Return the addresses that were asked for since this was last asked."""
        events = [json.loads(entry["message"]) for entry in self.driver.get_log("performance")]
        messages = [event["message"] for event in events]
        return [
            one["params"]["request"]["url"]
            for one in messages
            if one["method"] == "Network.requestWillBeSent"
        ]


@contextmanager
def browser(folder: Path) -> Iterator[Tab]:
    """Yield a tab of a browser that keeps what it keeps in a folder.

    Without Chromium and its driver the test is skipped, except in CI, where it fails.
    """
    program, driver_path = shutil.which("chromium"), shutil.which("chromedriver")
    if program is None or driver_path is None:
        message = (
            "there is no chromium with its chromedriver to open pages in; .ci/browser installs"
        )
        if os.environ.get("CI"):
            pytest.fail(message)
        pytest.skip(message)
    from selenium import webdriver
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = program
    for flag in (*_FLAGS, f"--user-data-dir={folder}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
    driver: Any = webdriver.Chrome(options=options, service=Service(executable_path=driver_path))
    try:
        driver.get("about:blank")
        driver.get_log("performance")  # what the browser's own first page was made of
        yield Tab(driver)
    finally:
        driver.quit()
