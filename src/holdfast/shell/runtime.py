"""JAX as the command wants it: compiled code kept on disk, no asynchronous dispatch."""

import gc
import os
import stat
from pathlib import Path

OFF = "off"


def configure() -> Path | None:
    """Set JAX up; the folder that keeps compiled code, None where there is none.

    `HOLDFAST_CACHE` moves that folder, or switches it off with "off". It holds machine code,
    so a folder that others could write to is not used.
    """
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    # what has been imported stays to the end: looking through it again slows the reading of logs
    gc.freeze()
    folder = cache_folder()
    if folder is None:
        return None
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
    return folder


MAPPINGS = 30_000
"""Memory mappings from which on compiled programs are forgotten: each holds some, Linux allows
65 530, and a compiler that gets no more ends the process."""


def forget_programs() -> None:
    """Between two pieces of work: give up compiled programs if they hold too many mappings."""
    held = Path("/proc/self/maps")
    if held.exists() and held.read_bytes().count(b"\n") > MAPPINGS:
        import jax

        jax.clear_caches()
        gc.collect()


def cores() -> int:
    """Processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cache_folder() -> Path | None:
    """The folder for compiled code, made if need be; None if off, or if it is not ours alone."""
    wish = os.environ.get("HOLDFAST_CACHE", "")
    if wish == OFF:
        return None
    base = os.environ.get("XDG_CACHE_HOME", "")
    try:
        home = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
        folder = Path(wish) if wish else home / "holdfast"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        status = folder.stat()
    except (OSError, RuntimeError):
        return None
    ours = not hasattr(os, "getuid") or status.st_uid == os.getuid()
    shared = stat.S_IMODE(status.st_mode) & (stat.S_IWGRP | stat.S_IWOTH)
    return folder if ours and not shared and os.access(folder, os.W_OK) else None
