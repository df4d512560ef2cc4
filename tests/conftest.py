"""Shared fixtures."""

import os
from dataclasses import dataclass, field

import pytest

from pftrack import datasets
from pftrack.datasets import registry


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


@dataclass(frozen=True)
class FakeEntry(registry.Entry):
    """An entry whose checksums are given, not read from the package."""

    sums: dict = field(default_factory=dict)

    @property
    def checksums(self):
        return self.sums


@pytest.fixture
def publish(monkeypatch):
    """Return a function that puts an entry into the registry."""

    def put(sources, sums, id="fake", **fields) -> FakeEntry:
        entry = FakeEntry(
            id, "a title", "a licence", "a citation", lambda entry, files: files, sources, sums=sums, **fields
        )
        monkeypatch.setitem(registry.ENTRIES, id, entry)
        return entry

    return put
