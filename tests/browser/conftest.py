"""A headless browser for the pages of HTML; tests that ask for it are skipped where there is none.

Needs Selenium, and Chromium with its driver: ``/usr/bin/chromium`` and ``/usr/bin/chromedriver``, or what the
variables ``TLF_CHROMIUM`` and ``TLF_CHROMEDRIVER`` name.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NoReturn

import pytest

FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--window-size=1280,900",
)
PHONE = (390, 844)


def program(variable: str, *names: str) -> str | None:
    """A program that a variable names, or the first of these on the path."""
    found = (shutil.which(name) for name in (os.environ.get(variable, ""), *names) if name)
    return next(filter(None, found), None)


def without(what: str) -> NoReturn:
    """Skip, or fail if the variable ``TLF_BROWSER`` says that the browser is needed."""
    message = f"needs {what}"
    if os.environ.get("TLF_BROWSER"):
        pytest.fail(message)
    pytest.skip(message)


@pytest.fixture(scope="session")
def _chromium(tmp_path_factory) -> Iterator[Any]:
    """One browser for all tests."""
    try:
        from selenium import webdriver
        from selenium.webdriver.chrome.service import Service
    except ModuleNotFoundError:
        without("selenium")

    chromium = program("TLF_CHROMIUM", "/usr/bin/chromium", "chromium", "google-chrome")
    driver = program("TLF_CHROMEDRIVER", "/usr/bin/chromedriver", "chromedriver")
    if chromium is None or driver is None:
        without("Chromium and its driver")
    options = webdriver.ChromeOptions()
    options.binary_location = chromium
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    running = webdriver.Chrome(options=options, service=Service(driver))
    try:
        yield running
    finally:
        running.quit()


@pytest.fixture
def browser(_chromium) -> Iterator[Any]:
    """The browser with a desktop's window and an empty page; a Selenium ``WebDriver``."""
    _chromium.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})
    _chromium.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "", "features": []})
    _chromium.get("about:blank")
    _chromium.get_log("browser")
    yield _chromium
    _chromium.get("about:blank")


@pytest.fixture
def opened(browser) -> Callable[[Path], Any]:
    """Opens a file; returns the browser."""

    def open_file(path: Path) -> Any:
        browser.get(path.resolve().as_uri())
        return browser

    return open_file


@pytest.fixture
def phone(browser) -> Any:
    """The browser with a phone's screen."""
    width, height = PHONE
    browser.execute_cdp_cmd(
        "Emulation.setDeviceMetricsOverride",
        {"width": width, "height": height, "deviceScaleFactor": 2, "mobile": True},
    )
    return browser


@pytest.fixture
def theme(browser) -> Callable[[str], None]:
    """Sets what the system prefers: ``light`` or ``dark``."""

    def prefer(name: str) -> None:
        features = [{"name": "prefers-color-scheme", "value": name}]
        browser.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": features})

    return prefer


@pytest.fixture
def complaints(browser) -> Callable[[], list[str]]:
    """What the page has written to the console as warnings and errors since the last call."""

    def read() -> list[str]:
        return [
            entry["message"]
            for entry in browser.get_log("browser")
            if entry["level"] in ("WARNING", "SEVERE")
        ]

    return read


@pytest.fixture
def overflow(browser) -> Callable[[], list[str]]:
    """Elements that make the page wider than its window, outside of boxes that scroll by themselves."""

    def read() -> list[str]:
        return browser.execute_script(
            """
            const width = document.documentElement.clientWidth, found = [];
            if (document.documentElement.scrollWidth <= width) return found;
            for (const one of document.body.querySelectorAll('*')) {
              if (one.closest('.wide') && !one.matches('.wide')) continue;
              if (one.getBoundingClientRect().right > width + 0.5)
                found.push(one.tagName + '.' + one.getAttribute('class'));
            }
            return found.length ? found : ['the page'];
            """
        )

    return read
