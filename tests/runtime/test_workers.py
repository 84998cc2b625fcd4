"""Work in threads: in order, no more of it than may be, none after an error."""

import os
import threading
import time

import pytest

from cuspid.runtime.workers import (
    computed_once,
    core_numbers,
    map_ahead,
    map_batches,
    map_in_threads,
    map_slices,
    run_in_shares,
    usable_cores,
)


def pinned(work):
    """What ``work`` returns in a thread that may run on one core alone."""
    found = []

    def alone():
        os.sched_setaffinity(0, {min(core_numbers())})
        found.append(work())

    thread = threading.Thread(target=alone)
    thread.start()
    thread.join()
    return found[0]


def test_results_come_in_the_order_of_the_items_and_each_is_told():
    calls = []

    def late(item):
        time.sleep(0.01 * (3 - item))
        return 10 * item

    assert map_in_threads(late, range(4), stage="tens", progress=lambda *step: calls.append(step)) == [0, 10, 20, 30]
    assert calls == [("tens", done, 4) for done in (1, 2, 3, 4)]
    assert map_in_threads(late, []) == []


def test_the_first_error_is_raised_and_what_was_not_begun_is_left():
    begun = []

    def refuse(item):
        begun.append(item)
        time.sleep(0.01)
        raise ValueError(item)

    with pytest.raises(ValueError, match=r"^0$"):
        map_in_threads(refuse, range(1000))
    assert len(begun) < 1000


def test_work_ahead_comes_in_order_and_goes_no_farther_than_there_are_cores():
    drawn = []

    def items():
        for item in range(20):
            drawn.append(item)
            yield item

    def late(item):
        time.sleep(0.002 * (3 - item % 4))
        return 10 * item

    taken = []
    for result in map_ahead(late, items()):
        taken.append(result)
        assert len(drawn) <= len(taken) + usable_cores()
    assert taken == [10 * item for item in drawn] == list(range(0, 200, 10))
    assert list(map_ahead(late, [])) == []


def test_the_first_error_of_work_ahead_is_raised_in_its_place():
    results = map_ahead(lambda item: 1 // (item - 1), range(5))
    assert next(results) == -1
    with pytest.raises(ZeroDivisionError):
        next(results)


def test_batches_follow_each_other_and_no_item_is_read_before_its_batch():
    drawn = []

    def items():
        for item in range(100):
            drawn.append(item)
            yield item

    taken = []
    for batch in map_batches(lambda item: 10 * item, items()):
        taken += batch
        assert len(taken) == len(drawn)
    assert taken == list(range(0, 1000, 10))
    assert list(map_batches(lambda item: item, [])) == []


def test_a_pinned_thread_takes_smaller_batches_and_one_share():
    def first() -> int:
        return len(next(map_batches(lambda item: item, range(1000))))

    assert first() == usable_cores() * pinned(first)
    assert pinned(shares) == [(0, 1)]


def shares():
    told = []
    run_in_shares(lambda share, of: told.append((share, of)))
    return sorted(told)


def test_each_share_is_worked_on_once():
    assert shares() == [(share, usable_cores()) for share in range(usable_cores())]


@pytest.mark.parametrize("count", [0, 1, 2, 7, 1000])
@pytest.mark.parametrize("parts", [None, 1, 4])
def test_slices_follow_each_other_and_leave_nothing_out(count, parts):
    slices = map_slices(lambda part: part, count, parts)
    assert len(slices) == (parts or usable_cores())
    assert [item for part in slices for item in range(count)[part]] == list(range(count))
    sizes = [part.stop - part.start for part in slices]
    assert max(sizes) - min(sizes) <= 1


def test_few_items_start_no_threads_and_are_cut_alike():
    where = map_slices(lambda part: (part, threading.get_ident()), 99, 4, few=100)
    assert {thread for _, thread in where} == {threading.get_ident()}
    assert [part for part, _ in where] == map_slices(lambda part: part, 99, 4)
    assert threading.get_ident() not in map_slices(lambda _: threading.get_ident(), 100, 4, few=100)


def test_where_slices_are_cut_does_not_depend_on_the_cores():
    assert map_slices(lambda part: part, 1000, 4) == pinned(lambda: map_slices(lambda part: part, 1000, 4))


def test_a_thread_that_is_pinned_to_one_core_starts_one_thread_at_a_time():
    def which(_):
        time.sleep(0.01)
        return threading.get_ident(), tuple(core_numbers())

    assert pinned(usable_cores) == 1
    threads, cores = zip(*pinned(lambda: map_in_threads(which, range(8))), strict=True)
    assert len(set(threads)) == 1
    assert set(cores) == {(min(core_numbers()),)}
    assert core_numbers() == core_numbers(os.getpid()), "and the others keep their cores"


def test_a_system_without_affinity_lends_all_cores(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity")
    assert usable_cores() == os.cpu_count()


def test_what_many_threads_ask_for_at_once_is_computed_once(monkeypatch):
    """Since Python 3.12, functools' own cached property is not."""
    monkeypatch.setattr("cuspid.runtime.workers.usable_cores", lambda: 8)
    computed, together = [], threading.Barrier(8)

    class Answer:
        @computed_once
        def value(self):
            computed.append(self)
            time.sleep(0.05)
            return object()

    one, other = Answer(), Answer()

    def ask(_):
        together.wait(10)
        return one.value

    assert set(map_in_threads(ask, range(8))) == {one.value}
    assert computed == [one]
    assert other.value is not one.value
    assert isinstance(Answer.value, computed_once)
