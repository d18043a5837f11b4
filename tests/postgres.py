"""A private PostgreSQL server on a unix socket, one for each test process, and the databases of a test.

Tests of a store take `store_url` and run on SQLite and on PostgreSQL, which is skipped where it is not installed.
"""

import os
import pwd
import shutil
import signal
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from itertools import count
from pathlib import Path
from typing import Any

import pytest

_SETTINGS = {
    "listen_addresses": "",
    "fsync": "off",  # only the power of the computer could fail
    "autovacuum": "off",
    "shared_buffers": "16MB",
    "max_wal_senders": "0",
    "wal_level": "minimal",
}
_START_S = 60.0


class Server:
    """A running server that trusts every user of its socket but "guest", who needs a password."""

    def __init__(self, programs: Path, folder: Path) -> None:
        self._programs, self._folder = programs, folder
        self._user: dict[str, Any] = {}
        if os.geteuid() == 0:  # the server refuses to run as root
            user = next(one for one in pwd.getpwall() if one.pw_name in ("postgres", "nobody"))
            os.chown(folder, user.pw_uid, user.pw_gid)
            self._user = {"user": user.pw_uid, "group": user.pw_gid, "extra_groups": []}
        self._numbers = count()
        options = ["-D", "data", "-U", "lab", "-A", "trust", "-E", "UTF8", "--locale=C", "--no-sync"]
        subprocess.run([programs / "initdb", *options], check=True, capture_output=True, cwd=folder, **self._user)
        (folder / "data" / "pg_hba.conf").write_text("local all guest scram-sha-256\nlocal all all trust\n")
        self.start()

    def start(self) -> None:
        """Start the server, also after `kill`; return when it answers."""
        import psycopg

        settings = [part for name, value in _SETTINGS.items() for part in ("-c", f"{name}={value}")]
        command = [str(self._programs / "postgres"), "-D", "data", "-k", str(self._folder), *settings]
        with (self._folder / "log").open("ab") as log:
            self._process = subprocess.Popen(command, stderr=log, cwd=self._folder, **self._user)
        deadline_s = time.monotonic() + _START_S
        answers = False
        while not answers:
            try:
                answers = bool(self.execute("SELECT 1"))
            except psycopg.OperationalError as error:
                if self._process.poll() is not None or time.monotonic() > deadline_s:
                    raise RuntimeError((self._folder / "log").read_text()) from error
                time.sleep(0.01)

    def kill(self) -> None:
        """End all its processes at once with SIGKILL; return when none of them holds the memory that they share."""
        main = self._process.pid
        self._process.send_signal(signal.SIGSTOP)  # it starts no other
        children = [int(pid) for pid in Path(f"/proc/{main}/task/{main}/children").read_text().split()]
        for pid in (main, *children):
            with suppress(ProcessLookupError):  # it has ended meanwhile
                os.kill(pid, signal.SIGKILL)
        self._process.wait()
        while any(_is_alive(pid) for pid in children):
            time.sleep(0.01)

    def stop(self) -> None:
        """End it, and all connections."""
        self._process.send_signal(signal.SIGQUIT)
        self._process.wait()

    def execute(self, statement: str) -> list[tuple[Any, ...]]:
        """Run a statement as the owner of all databases, outside of them."""
        import psycopg

        with psycopg.connect(host=str(self._folder), user="lab", dbname="postgres", autocommit=True) as connection:
            cursor = connection.execute(statement)
            return [] if cursor.description is None else cursor.fetchall()

    def new_database(self, options: str = "") -> str:
        """Create a database; return its name."""
        name = f"test_{next(self._numbers)}"
        self.execute(f"CREATE DATABASE {name} STRATEGY file_copy {options}")
        return name

    def url(self, database: str, user: str = "lab") -> str:
        """Return the address of a database; `user` may have a password, as "guest:secret"."""
        return f"postgresql+psycopg://{user}@/{database}?host={self._folder}"


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def find_programs() -> Path | None:
    """Return the folder of the newest version, 15 at least, where Debian installs it."""
    folders = sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: int(path.parent.name))
    return folders[-1] if folders and int(folders[-1].parent.name) >= 15 else None


@pytest.fixture(scope="session")
def postgres() -> Iterator[Server]:
    """The server of this test process."""
    pytest.importorskip("psycopg", exc_type=ImportError)
    if (programs := find_programs()) is None:
        pytest.skip("PostgreSQL 15 or newer is not installed")
    folder = Path(tempfile.mkdtemp(prefix="ftdrive-postgres-"))
    try:
        server = Server(programs, folder)
        yield server
        server.stop()
    finally:
        shutil.rmtree(folder)


@pytest.fixture
def postgres_url(postgres: Server) -> Iterator[str]:
    """Address of an empty database."""
    name = postgres.new_database()
    yield postgres.url(name)
    postgres.execute(f"DROP DATABASE {name} WITH (FORCE)")


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.slow)])
def store_url(request: pytest.FixtureRequest, tmp_path: Path) -> str:
    """Address of an empty database of each kind."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path / 'store.sqlite'}"
    return str(request.getfixturevalue("postgres_url"))
