"""The directory in which compiled programs are kept between runs."""

from __future__ import annotations

import os
from pathlib import Path


def enable_compilation_cache() -> None:
    """Keep compiled programs between runs, so that the second start is quick.

    A directory that the user has set is kept, and so is the user's choice to have no cache.
    """
    import jax

    if getattr(jax.config, "jax_compilation_cache_dir", None) is None:
        try:
            base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
            (base / "jaxsafe").mkdir(parents=True, exist_ok=True)
        except (OSError, RuntimeError):
            return  # without a home directory that can be written, starts only take longer
        jax.config.update("jax_compilation_cache_dir", str(base / "jaxsafe"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)
