"""Fixtures that several test files use."""

import pytest
from chromium import start_chromium


@pytest.fixture(scope="session")
def chromium():
    """One Chromium for all tests of pages; see `chromium.Page`."""
    driver = start_chromium()
    yield driver
    driver.quit()
