"""Chromium without a window, driven by selenium: for tests of pages made by the package."""

import base64
import io
import os
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

REQUIRED = "PASSIVE_ENV_BROWSER"
"""Where this environment variable is "required", a missing browser fails tests instead of skipping them."""
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
GET = "install chromium and chromium-driver (Debian, Ubuntu: apt-get install chromium chromium-driver)"
CONTROLS = ("button", "slider", "checkbox", "combobox", "link", "image", "img", "region")
"""Roles that need a name."""
PATIENCE_S = 120.0
DESKTOP, PHONE = (1360, 1000), (390, 844)


def start_chromium() -> Any:
    """A selenium driver, or the test is skipped (fails, where a browser is required) with the reason."""
    required = os.environ.get(REQUIRED) == "required"
    if not required:
        pytest.importorskip("selenium", reason="selenium is not installed")
    from selenium import webdriver

    browser = next((path for path in map(shutil.which, BROWSERS) if path), None)
    driver = shutil.which("chromedriver")
    if browser is None or driver is None:
        missing = "no Chromium or Chrome" if browser is None else "no chromedriver"
        report = pytest.fail if required else pytest.skip
        report(f"{missing} on the path: {GET}")
    options = webdriver.ChromeOptions()
    options.binary_location = browser
    flags = ["headless=new", "disable-gpu", "disable-dev-shm-usage", "hide-scrollbars", "disable-background-networking"]
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        flags.append("no-sandbox")  # Chromium refuses to run as root otherwise
    for flag in flags:
        options.add_argument(f"--{flag}")
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    return webdriver.Chrome(options=options, service=webdriver.ChromeService(driver))


class Page:
    """A page from a file, opened in a browser.

    Args:
        driver: of `start_chromium`.
        path: HTML file.
        ready: JavaScript expression that is true once the page answers.
        size: width and height of the window [px].
        touch: whether to pose as a phone.
    """

    def __init__(self, driver: Any, path: Path, ready: str, size: tuple[int, int] = DESKTOP, touch: bool = False):
        self.driver = driver
        driver.get("about:blank")
        driver.get_log("browser")  # what an earlier page said
        screen = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": touch}
        driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", screen)
        driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": touch})
        driver.get(Path(path).resolve().as_uri())
        self.wait_for(ready)

    def run(self, script: str, *arguments: Any) -> Any:
        """Value of a JavaScript function's body."""
        return self.driver.execute_script(script, *arguments)

    def value(self, expression: str) -> Any:
        """Value of a JavaScript expression."""
        return self.run(f"return {expression}")

    def wait_for(self, expression: str) -> None:
        """Wait until an expression is true.

        Raises:
            TimeoutError: it never was.
        """
        end = time.monotonic() + PATIENCE_S
        while not self.value(expression):
            if time.monotonic() > end:
                raise TimeoutError(f"{expression} was not true within {PATIENCE_S:g} s; console: {self.complaints()}")
            time.sleep(0.05)

    def find(self, selector: str) -> Any:
        """The element of a CSS selector."""
        return self.driver.find_element("css selector", selector)

    def press(self, *keys: str) -> None:
        """Press keys where the focus is."""
        from selenium.webdriver.common.action_chains import ActionChains

        ActionChains(self.driver).send_keys(*keys).perform()

    def screenshot(self) -> np.ndarray:
        """Pixels of the window, uint8 [h, w, 3]."""
        shot = self.driver.execute_cdp_cmd("Page.captureScreenshot", {"format": "png"})["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(shot))).convert("RGB"))

    def is_drawn(self) -> bool:
        """Whether the window shows more than a background and a few words."""
        pixels = self.screenshot().astype(int) @ [65536, 256, 1]
        share = (pixels != pixels[-1, 0]).mean()
        return 0.01 < share < 0.5 and len(np.unique(pixels)) > 100

    def complaints(self) -> list[str]:
        """Warnings and errors in the console since the last look."""
        return [each["message"] for each in self.driver.get_log("browser") if each["level"] in ("WARNING", "SEVERE")]

    def fetched(self) -> list[str]:
        """Addresses of everything that was loaded besides the page itself."""
        return self.value("performance.getEntriesByType('resource').map((entry) => entry.name)")

    def unnamed(self) -> list[str]:
        """Roles of controls that a screen reader could not name."""
        nodes = self.driver.execute_cdp_cmd("Accessibility.getFullAXTree", {})["nodes"]
        found = [(node["role"]["value"], node.get("name", {}).get("value", "")) for node in nodes if "role" in node]
        return [role for role, name in found if role in CONTROLS and not name.strip()]
