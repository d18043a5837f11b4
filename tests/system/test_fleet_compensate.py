"""Recordings compensated in processes and on a Dask cluster: the same bytes."""

from importlib import import_module
from pathlib import Path

import pytest
from dask import config

from ftdrive.fleet.compensate import compensate_all, compensated_bytes, task_of
from ftdrive.fleet.workers import Workers, cluster_workers, local_workers
from ftdrive.live.samples import WrenchFrame
from ftdrive.recording import Recorder
from tests.dask_cluster import dask_cluster
from tests.unit.ftdrive.recorded import block, info

pytestmark = pytest.mark.slow
TASK = task_of(None, WrenchFrame("base"), "estimate")


@pytest.fixture
def recordings(tmp_path: Path) -> list[Path]:
    """Two of each format, 2.5 s each."""
    paths = [tmp_path / f"{number}{ending}" for ending in (".mcap", ".csv", ".parquet") for number in range(2)]
    for start, path in enumerate(paths):
        recorder = Recorder([path], info(), {})
        recorder.write(block(2500, start))
        recorder.close()
    return paths


def results(recordings: list[Path], folder: Path, workers: Workers) -> list[bytes]:
    folder.mkdir()
    found = dict(compensate_all(recordings, folder, TASK, workers))
    assert [one for one in recordings if isinstance(found[one], str)] == []
    return [(folder / one.name).read_bytes() for one in recordings]


def test_processes_and_a_cluster_give_the_same_bytes(recordings: list[Path], tmp_path: Path) -> None:
    here = [compensated_bytes(one.read_bytes(), one.name, TASK).rpartition(b"\n")[0] for one in recordings]
    with local_workers(2) as workers:
        assert results(recordings, tmp_path / "processes", workers) == here
    import_module("distributed")  # its defaults first: else all of them leave with the one that is changed here
    with dask_cluster() as cluster, config.set({"distributed.admin.large-graph-warning-threshold": "1kB"}):
        cluster.start_worker()
        with cluster_workers(cluster.address, timeout_s=60) as workers:
            assert results(recordings, tmp_path / "cluster", workers) == here
