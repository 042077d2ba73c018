"""Checkpoints with orbax.

The directory of a step appears whole or not at all, so a kill spoils no checkpoint. This holds even
if the checkpoint of a step is written again. The old one is moved aside, and is removed only when
the new one is there.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import hashlib
import io
import json
import logging
import shutil
import sys
import time
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxsafe.devices import processes
from jaxsafe.schema.errors import ConfigError, choices_text, show
from jaxsafe.storage.forms import check
from jaxsafe.types import is_key

logging.getLogger("absl").setLevel(logging.ERROR)

QUIET_S = 0.5
"""The threads of a failed read or write count as ended after this time without complaints [s]."""

SETTLE_S = 10.0
"""Longest time to wait for the threads of a failed read or write to end [s]."""

MAX_REASON = 120
"""Largest number of characters of an error of orbax or tensorstore that a message repeats."""

PRECISION = "precision"
"""Name of a fact that `Checkpoints.save` adds: the type of the numbers in the checkpoint."""

DIGEST = "sha256"
"""Name of a fact that `Checkpoints.save` adds: the digest of everything else in the checkpoint."""

ASIDE = ".before"
"""Suffix of the name of a checkpoint while the one that replaces it is written."""


class Checkpoints:
    """The checkpoints in `<run>/checkpoints/`. All are kept.

    Their numbers are the environment steps of each seed.
    """

    def __init__(self, run: Path, create: bool = False) -> None:
        """Open the directory of checkpoints.

        Args:
            run: the run directory.
            create: whether to make the directory if it is missing, and to write to it.
        """
        self.directory = (run / "checkpoints").absolute()
        self._create = create
        if create:
            self._recover()

    @functools.cached_property
    def _ocp(self) -> Any:
        import orbax.checkpoint  # this takes a while, and a new run needs it late

        return orbax.checkpoint

    @functools.cached_property
    def _manager(self) -> Any:
        options = self._ocp.CheckpointManagerOptions(
            create=self._create, enable_async_checkpointing=False, read_only=not self._create
        )
        return self._ocp.CheckpointManager(self.directory, options=options)

    @property
    def steps(self) -> list[int]:
        """The steps at which there are checkpoints, in order."""
        return sorted(self._manager.all_steps()) if self.directory.is_dir() else []

    def save(self, step: int, state: Any, facts: dict[str, Any]) -> None:
        """Write one checkpoint, or write it again.

        A digest of the state and the facts is written with them, and `restore` compares it.

        Args:
            step: environment steps of each seed.
            state: a pytree of arrays on the host. PRNG keys are given as their key data.
            facts: facts about the checkpoint, which JSON can hold.

        Raises:
            ConfigError: there is no room for it, or it cannot be written for another reason.
        """
        ocp = self._ocp
        facts = {**facts, PRECISION: jnp.result_type(float).name}
        facts[DIGEST] = _digest(state, facts)
        place = self.directory / str(step)
        before = self.directory / f"{step}{ASIDE}"
        if step in self.steps:
            if processes.leads():
                place.rename(before)
            processes.wait_for_all("moved aside")
            self._manager.reload()
        args = ocp.args.Composite(
            state=ocp.args.StandardSave(state), facts=ocp.args.JsonSave(facts)
        )
        reason = ""
        with _silence() as complaints:
            try:
                self._manager.save(step, args=args, force=True)
            except (OSError, ValueError, RuntimeError) as error:
                if jax.process_count() > 1 and "os_error_code" not in str(error):
                    raise  # perhaps another process was lost
                reason = (
                    str(error).strip().rpartition(": ")[2].partition(" [")[0][:MAX_REASON]
                    or type(error).__name__
                )
            if reason:
                _settle(complaints)
        if processes.leads():
            if reason:
                self._take_back()
            else:
                shutil.rmtree(before, ignore_errors=True)
        if reason:
            raise ConfigError(
                f"{place}: checkpoint cannot be written: {reason}; make room, then resume"
            )

    def _recover(self) -> None:
        """Undo the writes that were not finished. One process does this, and the others wait."""
        if processes.leads():
            self._take_back()
        processes.wait_for_all("taken back")

    def _take_back(self) -> None:
        """Put a checkpoint back if the one that replaces it was never completely written.

        The incomplete one is removed.
        """
        for part in self.directory.glob("*.orbax-checkpoint-tmp*"):
            shutil.rmtree(part, ignore_errors=True)
        for before in self.directory.glob(f"*{ASIDE}"):
            if before.with_suffix("").exists():
                shutil.rmtree(before)
            else:
                before.rename(before.with_suffix(""))

    def facts(self, step: int) -> dict[str, Any]:
        """Read the JSON of one checkpoint, as it was written.

        Raises:
            ConfigError: there is no checkpoint at this step, or it is broken.
        """
        facts = self._read(step, facts=self._ocp.args.JsonRestore())["facts"]
        check(facts, {}, f"{self.directory / str(step)}: facts")
        return facts

    def restore(self, step: int, like: Any, newer: Sequence[str] = ()) -> Any:
        """Read the arrays of one checkpoint, on the host.

        A checkpoint that was written before there were digests is read without comparing one.

        Args:
            step: environment steps of each seed.
            like: shapes of the arrays, in the structure that the result has.
            newer: the last parts of the names of arrays that are 0 if the checkpoint lacks them.

        Raises:
            ConfigError: there is no checkpoint at this step, or it is broken, damaged or of another
                run.
        """
        facts = self.facts(step)
        place = self.directory / str(step)
        now = jnp.result_type(float).name
        if facts.get(PRECISION, now) != now:
            raise ConfigError(
                f"{place}: checkpoint was written in {facts[PRECISION]}, "
                f"this process computes in {now}"
            )
        abstract = jax.tree.map(_empty, like)
        absent = [name for name in newer if not self.has(step, name)]
        if absent:
            state = self._read_older(step, abstract, absent)
        else:
            state = self._read(step, state=self._ocp.args.StandardRestore(abstract))["state"]
        for (path, array), expected in zip(
            jax.tree_util.tree_leaves_with_path(state), jax.tree.leaves(abstract), strict=True
        ):
            if array.shape != expected.shape:
                name = jax.tree_util.keystr(path, simple=True, separator="/")
                raise ConfigError(
                    f"{place}: checkpoint is of another run: "
                    f"{name} has shape {array.shape}, expected {expected.shape}"
                )
        digest = facts.pop(DIGEST, None)
        if (digest is not None or PRECISION in facts) and digest != _digest(state, facts, absent):
            raise ConfigError(
                f"{place}: checkpoint is damaged: its content is not what was written"
            )
        return jax.tree.map(_as, state, like)

    def has(self, step: int, name: str) -> bool:
        """Return whether a checkpoint has an array of this name.

        It is True as well if the index of the checkpoint cannot be read.
        """
        try:
            text = (self.directory / str(step) / "state" / "_METADATA").read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError):
            return True
        return f"'{name}'" in text

    def _read_older(self, step: int, abstract: Any, absent: Collection[str]) -> Any:
        """Read the arrays of a checkpoint that lacks some of them. The absent ones are 0."""
        tree = _without(self._ocp.tree.serialize_tree(abstract, keep_empty_nodes=True), absent)
        partial = self._ocp.args.PyTreeRestore(item=tree, partial_restore=True)
        # A manager of orbax that has read in this way no longer writes, so another one reads.
        read = Checkpoints(self.directory.parent)._read(step, state=partial)["state"]

        def pick(path: Any, leaf: np.ndarray) -> Any:
            names = _names(path)
            if names[-1] in absent:
                return np.zeros_like(leaf)
            value = read
            for name in names:
                value = value[int(name) if isinstance(value, (list, tuple)) else name]
            return value

        return jax.tree_util.tree_map_with_path(pick, abstract)

    def _read(self, step: int, **args: Any) -> Any:
        if step not in self.steps:
            raise ConfigError(
                f"checkpoint: no step {show(step)} in {self.directory}"
                f"{choices_text(step, self.steps)}"
            )
        content = {}
        reason = ""
        with _silence() as complaints:
            try:
                content = self._manager.restore(step, args=self._ocp.args.Composite(**args))
            except Exception as error:  # orbax and tensorstore raise whatever their layers raise
                lines = [line for line in str(error).splitlines() if line.strip()]
                reason = (lines or [type(error).__name__])[0][:MAX_REASON]
            # This stands outside the except clause, because the error keeps the failed tasks alive,
            # which complain when they end.
            if reason:
                _settle(complaints)
        if reason:
            raise ConfigError(f"{self.directory / str(step)}: checkpoint cannot be read: {reason}")
        return content


@contextlib.contextmanager
def _silence() -> Iterator[io.StringIO]:
    """Keep standard error silent, and collect what would have been written to it.

    Threads and tasks of a failed read or write complain one by one, also through loggers.
    """
    loggers = [logging.getLogger(name) for name in ("asyncio", "absl")]
    before = [logger.disabled for logger in loggers]
    for logger in loggers:
        logger.disabled = True
    try:
        with contextlib.redirect_stderr(io.StringIO()) as complaints:
            yield complaints
    finally:
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


@functools.cache
def _ignore_late_complaints() -> None:
    """Silence, from now on, complaints about calls to an event loop that has ended.

    The threads of a failed read may take long to end.
    """
    previous = sys.unraisablehook

    def hook(what: sys.UnraisableHookArgs) -> None:
        if "Event loop is closed" not in str(what.exc_value):
            previous(what)

    sys.unraisablehook = hook
    logging.getLogger("asyncio").addFilter(
        lambda record: "never retrieved" not in record.getMessage()
    )


def _settle(complaints: io.StringIO) -> None:
    """Wait until the threads of a failed read or write have ended, then free what they leave."""
    _ignore_late_complaints()
    end = time.monotonic() + SETTLE_S
    length = -1
    while time.monotonic() < end and length != complaints.tell():
        length = complaints.tell()
        time.sleep(QUIET_S)
    gc.collect()


def _names(path: Any) -> list[str]:
    return [jax.tree_util.keystr((key,), simple=True) for key in path]


def _without(tree: Any, names: Collection[str]) -> Any:
    """Return nested mappings and lists without the entries of some names."""
    if isinstance(tree, dict):
        return {key: _without(value, names) for key, value in tree.items() if key not in names}
    return [_without(value, names) for value in tree] if isinstance(tree, list) else tree


def _digest(state: Any, facts: dict[str, Any], absent: Collection[str] = ()) -> str:
    """Return the SHA-256 of arrays with their names, types and shapes, and of the facts.

    Arrays whose names end in one of `absent` are left out.
    """
    digest = hashlib.sha256(json.dumps(facts, sort_keys=True).encode())
    for path, leaf in jax.tree_util.tree_leaves_with_path(state):
        if absent and _names(path)[-1] in absent:
            continue
        array = np.asarray(leaf)
        digest.update(f"{jax.tree_util.keystr(path)} {array.dtype} {array.shape}".encode())
        digest.update(array.tobytes())
    return digest.hexdigest()


def _empty(shape: Any) -> np.ndarray:
    data = jax.eval_shape(jax.random.key_data, shape) if is_key(shape) else shape
    return np.empty(data.shape, data.dtype)


def _as(x: Any, shape: Any) -> Any:
    return jax.random.wrap_key_data(jnp.asarray(x)) if is_key(shape) else x
