"""One simulated flight for all tests of the report."""

import pytest

import demo


@pytest.fixture(scope="session")
def plant():
    return demo.drone()


@pytest.fixture(scope="session")
def watch(plant):
    return demo.monitor(plant)


@pytest.fixture(scope="session")
def flight(plant, watch):
    """Simulated, attacked from 30 s to 50 s."""
    return demo.run(plant, watch)


@pytest.fixture(scope="session")
def log(plant, watch, flight):
    """The same log replayed: GPS at 1 Hz, two faults, no truth."""
    missing = [(row, output) for row in range(600) for output in (0, 1) if row % 10]
    return demo.replayed(plant, watch, flight, missing=missing, faulty=[(100, 2), (400, 3)])
