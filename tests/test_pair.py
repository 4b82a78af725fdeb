"""Both epochs at once give what one after the other gives."""

from __future__ import annotations

import threading

import pytest

from loda_pdal.kernels.parallel import set_threads
from loda_pdal.model.pair import Pair, at_once


def test_each_epoch_gets_its_own_arguments() -> None:
    found = at_once(lambda a, b: a - b, Pair(10, 20), Pair(1, 2))
    assert found == Pair(9, 18)


def test_the_epochs_run_at_the_same_time() -> None:
    set_threads(2)
    meeting = threading.Barrier(2, timeout=10)  # breaks unless both calls get here while the other is running
    try:
        assert at_once(lambda name: (meeting.wait(), name)[1], Pair("before", "after")) == Pair("before", "after")
    finally:
        set_threads(None)


def test_one_thread_means_one_after_the_other() -> None:
    set_threads(1)
    try:
        assert at_once(lambda _: threading.get_ident(), Pair(0, 1)) == Pair(*[threading.get_ident()] * 2)
    finally:
        set_threads(None)


def test_the_error_of_the_before_epoch_comes_first() -> None:
    def fail(name: str) -> None:
        raise ValueError(name)

    with pytest.raises(ValueError, match="before"):
        at_once(fail, Pair("before", "after"))
