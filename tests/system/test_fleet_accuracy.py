"""Simulated calibrations in processes and on a Dask cluster: the same numbers."""

from pathlib import Path

import pytest

from ftdrive.fleet.accuracy import BLOCK, Accuracy, accuracy_of
from ftdrive.fleet.workers import cluster_workers, local_workers
from tests.calibrated_runs import white_run
from tests.dask_cluster import dask_cluster

pytestmark = pytest.mark.slow


def test_processes_and_a_cluster_give_the_same_numbers(tmp_path: Path) -> None:
    folder = white_run(tmp_path, "run")
    with local_workers(2) as workers:
        local = accuracy_of(folder, workers, draws=4 * BLOCK)
    assert isinstance(local, Accuracy)
    with dask_cluster() as cluster:
        cluster.start_worker()
        with cluster_workers(cluster.address, timeout_s=60) as workers:
            assert accuracy_of(folder, workers, draws=4 * BLOCK) == local
