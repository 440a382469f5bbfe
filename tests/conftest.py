"""One set-up for all tests: 64 bits, strict promotion, run-time types, one thread."""

import atexit
import os
import shutil
import sys
import tempfile
import time
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"
os.environ["HOLDFAST_CACHE"] = "off"  # tests compile what they test
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    # once for all workers of this session, and gone with it
    _compiled = tempfile.mkdtemp(prefix="holdfast-tests-")
    atexit.register(shutil.rmtree, _compiled, ignore_errors=True)
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.3"
if not any(argument.startswith(("slow", "whole")) for argument in sys.argv):
    # most of the quick tier's time is compilation, which optimises nothing here; the slow tier
    # runs the code as users get it
    os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")
import hypothesis
import jax
import jaxtyping
import pytest

import holdfast  # noqa: F401  # the other flags, before anybody else imports JAX

# an int is a float, as in the numeric tower of every static checker
CHECKER = "beartype.beartype(conf=beartype.BeartypeConf(is_pep484_tower=True))"

hypothesis.settings.register_profile("local", deadline=None)
hypothesis.settings.register_profile("ci", deadline=None, derandomize=True)
hypothesis.settings.load_profile("ci" if os.environ.get("CI") else "local")


def pytest_addoption(parser):
    parser.addoption(
        "--no-typecheck",
        action="store_true",
        help="leave out the run-time checks of types and shapes (faster)",
    )


def pytest_configure(config):
    jax.config.update("jax_enable_x64", True)
    # rank promotion stays allowed: k[:, None] * row is how this code writes an outer product
    jax.config.update("jax_numpy_dtype_promotion", "strict")
    if not config.getoption("--no-typecheck"):
        jaxtyping.install_import_hook("holdfast", CHECKER)


LONG = 2.0
"""Seconds from which on a test may have compiled thousands of mappings' worth."""


@pytest.fixture(autouse=True)
def room_for_programs():
    """Keeps the mappings of compiled programs under what the kernel allows."""
    start = time.monotonic()
    yield
    if time.monotonic() - start > LONG:
        forget_programs()


@pytest.fixture(scope="module", autouse=True)
def room_after_a_module():
    """The same, after many short tests."""
    yield
    forget_programs()


def forget_programs():
    from holdfast.shell import runtime  # once its types are checked

    runtime.forget_programs()


@pytest.fixture(scope="session")
def shared_data():
    """The folder of recorded data sets; HOLDFAST_DATA says where it is."""
    default = Path(__file__).parents[1] / ".." / "shared" / "data"
    folder = Path(os.environ.get("HOLDFAST_DATA", default)).resolve()
    if not folder.is_dir():
        pytest.skip(f"no recorded data at {folder}: set HOLDFAST_DATA to their folder")
    return folder
