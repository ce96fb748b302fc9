"""The DW1000's driver runs with a sanitizer."""

import pytest


@pytest.fixture(scope="session", autouse=True)
def sanitized_driver():
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("CC", "cc -fsanitize=undefined -fno-sanitize-recover=all")
        yield
