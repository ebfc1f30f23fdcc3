"""A real Chromium without a window, for the pages that the package writes."""

import io
import shutil
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest
from matplotlib.image import imread
from selenium import webdriver

TIMEOUT_S = 300


@contextmanager
def opened() -> Iterator:
    """A driver of Chromium; a test that asks for it is skipped where there is none."""
    programs = {name: shutil.which(name) for name in ("chromium", "chromedriver")}
    if None in programs.values():
        pytest.skip(f"needs chromium and chromedriver, found {programs}")
    options = webdriver.ChromeOptions()
    options.binary_location = programs["chromium"]
    for flag in ("headless=new", "no-sandbox", "disable-dev-shm-usage", "disable-gpu", "hide-scrollbars"):
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options, webdriver.ChromeService(programs["chromedriver"]))
    try:
        driver.command_executor.client_config.timeout = TIMEOUT_S
        driver.set_page_load_timeout(TIMEOUT_S)
        driver.set_script_timeout(TIMEOUT_S)
        yield driver
    finally:
        driver.quit()


def shown_as(driver, width: int, dark: bool = False, height: int = 900) -> None:
    """Give the window a size in CSS pixels, and let its user prefer light or dark pages."""
    size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": width < 600}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"features": [scheme]})


def pixels(shown) -> np.ndarray:
    """What a driver's window, or one element of its page, looks like: [height, width, 3] in [0, 1]."""
    take = getattr(shown, "get_screenshot_as_png", None)
    return imread(io.BytesIO(take() if take else shown.screenshot_as_png))[..., :3]
