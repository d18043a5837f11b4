"""A store on a server: outages, passwords and waiting writers. Each failure is one sentence, and no run is lost."""

import socket
import sys
from pathlib import Path

import psycopg
import pytest
from sqlalchemy import Connection, event

from ftdrive import cli
from ftdrive.errors import BadStore
from ftdrive.store import index_run
from ftdrive.store.store import Store
from tests.postgres import Server
from tests.unit.ftdrive.store.contents import dump

pytestmark = pytest.mark.slow  # every test needs a process of its own


@pytest.mark.parametrize("outage", ["server killed", "connection cut"])
def test_an_outage_in_mid_write_loses_no_run(
    outage: str, runs: Path, postgres: Server, postgres_url: str, caplog: pytest.LogCaptureFixture
) -> None:
    """All rows of the second run are written, but not committed yet."""
    store = Store(postgres_url)
    store.index(runs / "2026-03-01-calibrate")
    before = dump(postgres_url)
    database = store._database

    def fail(connection: Connection) -> None:
        pid = connection.exec_driver_sql("SELECT pg_backend_pid()").scalar()
        if outage == "server killed":
            postgres.kill()
        else:
            postgres.execute(f"SELECT pg_terminate_backend({pid}, 60000)")

    event.listen(database._engine, "commit", fail)
    with pytest.raises(BadStore, match=r"cannot be written \(.*\): check") as error:
        store.index(runs)
    assert "\n" not in str(error.value)
    assert caplog.records == []  # SQLAlchemy would log a traceback if it could not return the connection
    event.remove(database._engine, "commit", fail)
    if outage == "server killed":
        with pytest.raises(BadStore, match="cannot be read"):
            store.results()
        postgres.start()
    assert dump(postgres_url) == before
    store.index(runs)
    assert (len(store.results()), len(store.verifications())) == (4, 2)


def test_a_writer_that_waits_in_vain_is_one_sentence_and_is_caught_up(runs: Path, postgres_url: str) -> None:
    store = Store(postgres_url, wait_s=0.05)
    with Store(postgres_url)._database.writing(), pytest.raises(BadStore, match="lock timeout"):
        store.index(runs)
    store.index(runs)
    assert len(store.results()) == 4


def test_a_reader_does_not_wait_for_a_writer(runs: Path, postgres_url: str) -> None:
    store = Store(postgres_url, wait_s=0.05)
    store.index(runs)
    with Store(postgres_url)._database.writing() as connection:
        assert len(store.results()) == 4
        connection.exec_driver_sql("LOCK TABLE ftdrive_results")
        with pytest.raises(BadStore, match=r"cannot be read .*lock timeout"):
            store.results()


@pytest.mark.parametrize(
    ("database", "user", "reason"),
    [
        ("postgres", "guest:wrong", "password authentication failed"),
        ("postgres", "guest", "no password supplied"),
        ("postgres", "stranger", "does not exist"),
        ("nothing", "lab", "does not exist"),
    ],
)
def test_a_server_that_refuses_is_one_sentence_with_a_documented_code(
    database: str, user: str, reason: str, runs: Path, postgres: Server, capsys: pytest.CaptureFixture[str]
) -> None:
    if not postgres.execute("SELECT 1 FROM pg_roles WHERE rolname = 'guest'"):
        postgres.execute("CREATE ROLE guest LOGIN PASSWORD 'secret'")
    url = postgres.url(database, user)
    for arguments in (["history", "--store", url], ["history", "--index", str(runs), "--store", url]):
        assert cli.run(arguments) == 6
        out, err = capsys.readouterr()
        assert (out, reason in " ".join(err.split())) == ("", True)
        assert "wrong" not in err
        assert "Traceback" not in err


def test_a_calibration_does_not_fail_for_a_server_that_is_down(
    runs: Path, tmp_path: Path, postgres: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    url = postgres.url("postgres").replace("host=", f"host={tmp_path}")
    monkeypatch.setenv("FTDRIVE_STORE_URL", url)
    said = list[str]()
    index_run(runs / "2026-03-01-calibrate", said.append)
    assert "The run is saved, but not yet in the history, because the store postgresql" in " ".join(said)


@pytest.mark.slow
def test_a_server_that_does_not_answer_is_one_sentence() -> None:
    """It accepts the connection and stays silent; libpq waits for 2 s at least."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(BadStore, match=r"cannot be read .*timeout"):
            Store(f"postgresql+psycopg://lab@127.0.0.1:{port}/db", wait_s=0.1).results()


def test_a_missing_libpq_names_the_extra(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setitem(sys.modules, "psycopg", None)
    assert cli.run(["history", "--store", "postgresql+psycopg://lab@host/db"]) == 2
    assert "of the extra fleet: install it with `" in " ".join(capsys.readouterr().err.split())


def test_the_server_trusts_no_wrong_password(postgres: Server) -> None:
    """Otherwise the tests above would show nothing."""
    with pytest.raises(psycopg.OperationalError):
        psycopg.connect(postgres.url("postgres", "guest:wrong").replace("+psycopg", ""))
