"""The pause of Python's garbage collector."""

import gc
from collections.abc import Iterator

import pytest

from jaxsafe.garbage_collection import without_collection


@pytest.fixture
def nothing_frozen() -> Iterator[None]:
    """Let the collector see everything, as it does outside the tests, and hide it again."""
    gc.unfreeze()
    yield
    gc.freeze()


@pytest.mark.usefixtures("nothing_frozen")
def test_what_is_made_in_the_pause_counts_as_old_after_it() -> None:
    with without_collection():
        assert not gc.isenabled()
        made = [[] for _ in range(3)]
    assert gc.isenabled()
    old = {id(thing) for thing in gc.get_objects(generation=2)}
    assert {id(thing) for thing in made} <= old
    assert gc.get_freeze_count() == 0


def test_what_the_user_has_frozen_stays_frozen() -> None:
    mine = [[]]
    gc.freeze()
    with without_collection():
        pass
    assert not any(thing is mine for thing in gc.get_objects())


@pytest.mark.usefixtures("nothing_frozen")
def test_a_collector_that_was_off_stays_off() -> None:
    gc.disable()
    try:
        with without_collection():
            pass
        assert not gc.isenabled()
    finally:
        gc.enable()
