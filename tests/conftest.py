"""Shared fixtures."""

import os

import pytest

from pftrack import datasets


@pytest.fixture(scope="session")
def footage():
    """Return a function that loads a real sequence, or skips the test with the reason why it cannot be had.

    Nothing is downloaded for a test. With ``PFTRACK_REQUIRE_DATA=1`` nothing may be skipped.
    """

    def load(id: str) -> datasets.Sequence:
        if datasets.registry.locate(id)[1] and os.environ.get("PFTRACK_REQUIRE_DATA") != "1":
            pytest.skip(f"{id} is not on this machine; pftrack data fetch {id} gets it")
        return datasets.load(id)

    return load
