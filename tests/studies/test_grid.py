"""A study goes on after whatever happens to it, and a cluster gives the same table as one process."""

import csv
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import grid_cases
from cuspid.runtime.errors import InputError
from cuspid.studies.grid import Case, _failure, grid, run_grid, table


def cases(values, **fixed):
    return tuple(Case(name=f"x{value}", parameters={"x": value, **fixed}) for value in values)


def test_a_grid_is_the_product_of_its_axes_and_keeps_their_order(tmp_path):
    points = grid(baseline_mm=(1.0, 2.5), angle_deg=(0, 3, 6))
    assert [tuple(point.parameters.values()) for point in points][:4] == [(1.0, 0), (1.0, 3), (1.0, 6), (2.5, 0)]
    assert len({point.name for point in points}) == 6
    assert points[0].name == "baseline_mm-1.0_angle_deg-0"


@pytest.mark.long
def test_a_failed_case_is_recorded_and_stops_nobody(tmp_path):
    """Refused, broken, or killed; results are in order, however long a case takes, with units in their columns."""
    outcomes = run_grid(cases([5, 2, 3, 0, 1]), grid_cases.square_unless, tmp_path, workers=2)
    assert [outcome.figures.get("square_mm2") for outcome in outcomes] == [25.0, None, None, None, 1.0]
    assert [outcome.failure for outcome in outcomes][:2] == [None, "no surface: the images need texture"]
    assert "signal 9" in outcomes[2].failure
    assert "ZeroDivisionError" in outcomes[3].failure
    rows = list(csv.DictReader((tmp_path / "results.csv").open()))
    assert [row["square_mm2"] for row in rows] == ["25.0", "", "", "", "1.0"]
    assert [row["x"] for row in rows] == ["5", "2", "3", "0", "1"]
    assert [row["failure"] for row in rows] == [outcome.failure or "" for outcome in outcomes]


@pytest.mark.long
def test_what_is_finished_is_not_run_again(tmp_path):
    few = run_grid(cases([1, 2], folder=str(tmp_path)), grid_cases.leaves_a_mark, tmp_path / "out", workers=1)
    assert len(few) == 2
    seen = []
    run_grid(
        cases([1, 2, 3], folder=str(tmp_path)),
        grid_cases.leaves_a_mark,
        tmp_path / "out",
        workers=1,
        progress=lambda *step: seen.append(step),
    )
    assert (tmp_path / "calls").read_text().split() == ["1", "2", "3"]
    assert seen == [("cases", 2, 3), ("cases", 3, 3)]


@pytest.mark.long
def test_failed_cases_are_run_again_where_asked(tmp_path):
    run_grid(cases([2], folder=str(tmp_path)), grid_cases.is_killed_once, tmp_path / "out", workers=1)
    kept = run_grid(cases([2], folder=str(tmp_path)), grid_cases.is_killed_once, tmp_path / "out", workers=1)
    assert kept[0].failure is not None
    again = run_grid(
        cases([2], folder=str(tmp_path)), grid_cases.is_killed_once, tmp_path / "out", workers=1, retry_failed=True
    )
    assert again[0].figures == {"y": 20.0}


def test_other_parameters_under_the_same_name_are_refused(tmp_path):
    run_grid([Case(name="a", parameters={"x": 1})], grid_cases.square, tmp_path, workers=1)
    with pytest.raises(InputError, match="other parameters"):
        run_grid([Case(name="a", parameters={"x": 2})], grid_cases.square, tmp_path, workers=1)
    with pytest.raises(InputError, match="two cases are called a"):
        run_grid([Case(name="a", parameters={"x": 2})] * 2, grid_cases.square, tmp_path, workers=1)


def test_no_workers_are_refused(tmp_path):
    with pytest.raises(InputError, match="--workers is 0"):
        run_grid(cases([1]), grid_cases.square, tmp_path, workers=0)


@pytest.mark.long
def test_the_processes_of_a_killed_study_end_with_it(tmp_path):
    study = subprocess.Popen([sys.executable, grid_cases.__file__, str(tmp_path)])
    mark = tmp_path / "process"
    for _ in range(600):
        if mark.exists():
            break
        time.sleep(0.1)
    study.kill()
    study.wait()
    number = int(mark.read_text())
    for _ in range(100):
        if not Path(f"/proc/{number}").exists() or "(zombie)" in Path(f"/proc/{number}/status").read_text():
            return
        time.sleep(0.1)
    os.kill(number, signal.SIGKILL)
    pytest.fail("its process works on")


@pytest.fixture(scope="module")
def cluster():
    distributed = pytest.importorskip("distributed", reason="needs Dask: pip install 'cuspid[cluster]'")
    os.environ["PYTHONPATH"] = os.path.dirname(grid_cases.__file__)  # noqa: PTH120
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as made:
        yield made.scheduler_address


@pytest.mark.long
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_each_worker_of_a_cluster_has_a_core_of_its_own(tmp_path, cluster):
    outcomes = run_grid(cases(range(6)), grid_cases.starts_a_child, tmp_path, cluster=cluster)
    assert [outcome.failure for outcome in outcomes] == [None] * 6
    assert len({outcome.figures["core"] for outcome in outcomes}) == 2


@pytest.mark.long
def test_a_cluster_that_loses_a_worker_gives_the_serial_table(tmp_path, cluster):
    for name in ("serial", "cluster"):
        (tmp_path / name).mkdir()
    (tmp_path / "serial" / "first").touch()
    serial = run_grid(
        [Case(name=f"x{k}", parameters={"x": k, "folder": str(tmp_path / "serial")}) for k in range(1, 4)],
        grid_cases.is_killed_once,
        tmp_path / "a",
        workers=1,
    )
    clustered = run_grid(
        [Case(name=f"x{k}", parameters={"x": k, "folder": str(tmp_path / "cluster")}) for k in range(1, 4)],
        grid_cases.is_killed_once,
        tmp_path / "b",
        cluster=cluster,
    )
    assert (tmp_path / "cluster" / "first").exists(), "no worker was killed"
    assert table(clustered).replace("/cluster", "/serial") == table(serial)
    assert all(outcome.failure is None for outcome in clustered)


def test_a_scheduler_that_is_lost_and_a_worker_that_fails_are_named():
    assert "scheduler at tcp://a:1 was lost" in _failure(SimpleNamespace(status="cancelled"), "tcp://a:1")
    failed = SimpleNamespace(status="error", exception=lambda: RuntimeError("no room\nfor more"))
    assert _failure(failed, "tcp://a:1") == "RuntimeError: no room"


def test_a_cluster_that_does_not_answer(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("cuspid.studies.grid.CLUSTER_TIMEOUT_S", 1)
    with pytest.raises(InputError, match="no Dask scheduler answers"):
        run_grid(cases([1]), grid_cases.square, tmp_path, cluster="tcp://127.0.0.1:9")
    assert not (tmp_path / "cases").exists()
