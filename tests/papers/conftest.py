"""The vehicle, driven once for all tests."""

import pytest

from holdfast.papers import care
from holdfast.papers.care_vehicle import Setting, drive


@pytest.fixture(scope="session")
def run():
    """All sixteen seeds of the paper's example."""
    return drive(Setting())


@pytest.fixture(scope="session")
def rows(run):
    """Every row of the study, by id."""
    return {row.id: row for row in care.judged(run)}
