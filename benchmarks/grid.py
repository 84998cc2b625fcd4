"""How much faster two workers finish a grid than one: real cases of the sweep, in local processes and on Dask.

    python benchmarks/grid.py [--rounds 3] [--out benchmarks/results/grid.json]

Each round runs the same cases with one worker and with two, in either way, one after the other. On a machine that does
other work at the same time the ratio says little: the load average is recorded, and so is the CPU time of the cases.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import distributed
import numpy as np
from run import conditions

from cuspid.anatomy.phantom.build import build_phantom
from cuspid.anatomy.phantom.options import PhantomOptions
from cuspid.model.jaw import Jaw
from cuspid.storage import write_json
from cuspid.studies.camera_sweep import SweepOptions, sweep

OPTIONS = SweepOptions(
    baseline_mm=(1.0, 1.5, 2.0, 2.5, 3.0), angle_deg=(0.0, 9.0), image_px=256, path_mm=2.0, frames=3, repeats=0
)
"""Ten cases of some six CPU seconds, half of which a local process needs to start."""
EDGE_MM = 0.3


def timed(jaw: Jaw, *, workers: int | None = None, cluster: str | None = None) -> dict[str, float]:
    """Wall seconds of the grid, and CPU seconds of its cases."""
    with tempfile.TemporaryDirectory() as folder:
        begins: list[float] = []
        # The first report comes when the cases are about to start.
        outcomes = sweep(
            jaw,
            Path(folder),
            OPTIONS,
            workers=workers,
            cluster=cluster,
            progress=lambda stage, done, total: begins.append(time.perf_counter()),
        )
    failed = [outcome.failure for outcome in outcomes if outcome.failure]
    if failed:
        raise SystemExit(f"a case failed: {failed[0]}")
    return {
        # The last reports are of the second, empty round of repeats.
        "wall_s": begins[len(outcomes)] - begins[0],
        "cases_cpu_s": float(sum(float(outcome.figures["cpu_s"] or 0) for outcome in outcomes)),
        "load": os.getloadavg()[0],
    }


@contextmanager
def dask(workers: int) -> Iterator[str]:
    """The address of a cluster of processes that have imported what a case needs."""
    with distributed.LocalCluster(
        n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None, silence_logs=50
    ) as cluster:
        with distributed.Client(cluster) as client:
            client.run(__import__, "cuspid.studies.camera_sweep")
        yield cluster.scheduler_address


def one_round(jaw: Jaw) -> dict[str, dict[str, float]]:
    """All four, one after the other."""
    found = {f"local_{workers}": timed(jaw, workers=workers) for workers in (1, 2)}
    for workers in (1, 2):
        with dask(workers) as address:
            found[f"dask_{workers}"] = timed(jaw, cluster=address)
    return found


def main() -> None:
    """Run the rounds and write the median of the ratios."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--out", type=Path, default=Path("benchmarks/results/grid.json"))
    arguments = parser.parse_args()
    jaw = build_phantom(PhantomOptions(edge_mm=EDGE_MM))
    timed(jaw, workers=1)  # compiled kernels are on disk from here on
    load = os.getloadavg()
    rounds = [one_round(jaw) for _ in range(arguments.rounds)]
    speed_up = {
        way: [each[f"{way}_1"]["wall_s"] / each[f"{way}_2"]["wall_s"] for each in rounds] for way in ("local", "dask")
    }
    result = {
        "cases": len(OPTIONS.settings),
        "options": OPTIONS,
        "load_average_before": load,
        "rounds": rounds,
        "speed_up": speed_up,
        "median_speed_up": {way: float(np.median(values)) for way, values in speed_up.items()},
        **conditions(),
    }
    write_json(arguments.out, result)
    print(result["median_speed_up"], "load", load)


if __name__ == "__main__":
    main()
