"""The store itself: two tables of an SQL database, written from run folders and rebuilt from them at any time."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sqlalchemy import (
    JSON,
    URL,
    Boolean,
    Column,
    Connection,
    Engine,
    Float,
    Integer,
    MetaData,
    NullPool,
    Select,
    String,
    Table,
    bindparam,
    create_engine,
    delete,
    inspect,
    make_url,
    select,
)
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from ftdrive.errors import BadStore, ConfigError
from ftdrive.store.records import (
    Record,
    StoredResult,
    StoredVerification,
    read_records,
    record_paths,
)

SCHEMA = 1
"""Version of the tables, kept in the database; a change of a column raises it."""
WAIT_S = 5.0
"""For another writer."""

_metadata = MetaData()
_schema = Table("ftdrive_schema", _metadata, Column("version", Integer, primary_key=True, autoincrement=False))
_results = Table(
    "ftdrive_results",
    _metadata,
    Column("id", String, primary_key=True),
    Column("path", String, nullable=False),
    Column("run", String, nullable=False),
    Column("created_utc", String, index=True),
    *(Column(name, String) for name in ("tool", "arm_serial", "sensor_serial", "mount")),
    Column("verdict", String, nullable=False),
    Column("n_poses", Integer, nullable=False),
    *(Column(name, Float, nullable=False) for name in ("mass_kg", "g_m_s2")),
    Column("numbers", JSON, nullable=False),
    *(Column(name, String) for name in ("dataset_sha256", "parent", "update")),
    Column("temperature_C", Float),
)
_verifications = Table(
    "ftdrive_verifications",
    _metadata,
    Column("id", String, primary_key=True),
    Column("path", String, nullable=False),
    Column("run", String, nullable=False),
    Column("calibration_id", String, nullable=False, index=True),
    Column("created_utc", String),
    Column("passed", Boolean, nullable=False),
    *(Column(name, String) for name in ("change", "reason")),
    Column("temperature_C", Float),
)
_TABLES: Mapping[type[Record], Table] = {StoredResult: _results, StoredVerification: _verifications}
_INSERT: Mapping[str, Callable[[Table], Any]] = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}


@dataclass(frozen=True, slots=True)
class Indexed:
    """What one call of `Store.index` has read."""

    results: int
    verifications: int
    unreadable: tuple[str, ...]
    """Files that were left out, each with the reason."""


def default_file() -> Path:
    """Return the store of a user; it need not exist."""
    home = os.environ.get("XDG_DATA_HOME", "")
    folder = Path(home) if Path(home).is_absolute() else Path("~/.local/share").expanduser()
    return folder / "ftdrive" / "store.sqlite"


class Store:
    """An index of run folders. Nothing is opened before the first call of a method.

    Parameters
    ----------
    url : str, optional
        Of an SQLite file or a PostgreSQL database, as SQLAlchemy has it; by default `default_file`.
    wait_s : float
        For another writer to an SQLite file.

    Raises
    ------
    ConfigError
        The address is not one of a database, or its driver is not installed.
    BadStore
        From every method: the database cannot be read or written, or has tables of another version.
    """

    def __init__(self, url: str | None = None, *, wait_s: float = WAIT_S) -> None:
        try:
            self._url = URL.create("sqlite", database=str(default_file())) if url is None else make_url(url)
            backend = self._url.get_backend_name()
            self._is_sqlite = backend == "sqlite"
            if backend not in _INSERT:
                raise ConfigError(f"[store] url begins with {backend}: give sqlite:////PATH or postgresql+psycopg://…")
            options = {"connect_args": {"timeout": wait_s}} if self._is_sqlite else {}
            self._engine: Engine = create_engine(self._url, poolclass=NullPool, **options)
        except (ArgumentError, NoSuchModuleError) as error:
            raise ConfigError("[store] url is no address of a database: give one such as sqlite:////PATH") from error
        except ModuleNotFoundError as error:
            raise ConfigError(f"[store] url = {self.name!r} needs the package {error.name}: install it") from error

    @property
    def name(self) -> str:
        """The file, or the address without its password."""
        return (self._is_sqlite and self._url.database) or self._url.render_as_string()

    # -------------------------------------------------------------------------------------------------------- writing

    def index(self, *folders: Path) -> Indexed:
        """Add what is new in these run folders, or in the run folders that they contain.

        A file that is known by its path is not read again, because no file of a run is ever overwritten.
        """
        known = self._known_paths()
        return self._add(path for path in record_paths(folders) if str(path) not in known)

    def rebuild(self, *folders: Path) -> Indexed:
        """Read these folders and all that were indexed before again, and forget runs that were deleted.

        Runs whose parent folder cannot be reached are kept: a disk may be missing, or another computer has them.
        """
        known = self._known_paths()
        parents = {Path(path).parent.parent for path in known}
        gone = [path for path in known if not Path(path).exists() and Path(path).parent.parent.is_dir()]
        return self._add(record_paths([*folders, *parents]), forget=gone)

    def _add(self, paths: Iterable[Path], forget: Sequence[str] = ()) -> Indexed:
        records, unreadable = read_records(paths)
        if records or forget:
            with self._writing() as connection:
                for kind, table in _TABLES.items():
                    rows = [asdict(one) for one in records if isinstance(one, kind)]
                    self._write(connection, table, rows, forget)
        results = sum(isinstance(one, StoredResult) for one in records)
        return Indexed(results, len(records) - results, unreadable)

    def _write(self, connection: Connection, table: Table, rows: list[dict[str, Any]], forget: Sequence[str]) -> None:
        """Insert rows; of two files with the same content the first by path counts, whatever the order."""
        ids = {row["id"] for row in rows}
        same = [path for id_, path in connection.execute(select(table.c.id, table.c.path)) if id_ in ids]
        if gone := [*forget, *(path for path in same if not Path(path).exists())]:
            which = delete(table).where(table.c.path == bindparam("gone"))
            connection.execute(which, [{"gone": path} for path in gone])
        if rows:
            insert = _INSERT[self._engine.dialect.name](table)
            new = {column.name: insert.excluded[column.name] for column in table.columns}
            first = insert.excluded.path <= table.c.path
            connection.execute(insert.on_conflict_do_update(index_elements=["id"], set_=new, where=first), rows)

    # -------------------------------------------------------------------------------------------------------- reading

    def results(self, tool: str | None = None) -> list[StoredResult]:
        """Return all results, or those of a tool, the oldest first."""
        query = select(_results).order_by(_results.c.created_utc, _results.c.id)
        rows = self._read(query if tool is None else query.where(_results.c.tool == tool))
        return [StoredResult(**row) for row in rows]

    def find(self, start: str) -> list[StoredResult]:
        """Return the results whose id begins so."""
        rows = self._read(select(_results).where(_results.c.id.startswith(start, autoescape=True)))
        return [StoredResult(**row) for row in rows]

    def verifications(self, calibration_id: str | None = None) -> list[StoredVerification]:
        """Return all verifications, or those of a calibration, the oldest first."""
        query = select(_verifications).order_by(_verifications.c.created_utc, _verifications.c.id)
        if calibration_id is not None:
            query = query.where(_verifications.c.calibration_id == calibration_id)
        return [StoredVerification(**row) for row in self._read(query)]

    def last_verification(self, calibration_id: str) -> StoredVerification | None:
        """Return the newest verification of a calibration, if there is one."""
        return next(reversed(self.verifications(calibration_id)), None)

    def _known_paths(self) -> set[str]:
        return {row["path"] for table in _TABLES.values() for row in self._read(select(table.c.path))}

    def _read(self, query: Select[Any]) -> list[dict[str, Any]]:
        file = self._file
        if file is not None and not file.exists():  # connecting would create it
            return []
        with self._in_words("read"), self._engine.connect() as connection:
            if not self._has_tables(connection):
                return []
            return [dict(row) for row in connection.execute(query).mappings()]

    # ----------------------------------------------------------------------------------------------------- connection

    @property
    def _file(self) -> Path | None:
        """The SQLite file; None for a server, memory or a file: URI."""
        path = self._url.database or ""
        return Path(path) if self._is_sqlite and path and not path.startswith("file:") else None

    @contextmanager
    def _writing(self) -> Iterator[Connection]:
        """Connect, create the tables where they are missing, and commit at the end."""
        with self._in_words("written"):
            if self._file is not None:
                self._file.parent.mkdir(parents=True, exist_ok=True)
            with self._engine.connect() as connection:
                if self._is_sqlite:
                    connection.exec_driver_sql("BEGIN IMMEDIATE")  # else two writers that read first cannot both go on
                if not self._has_tables(connection):
                    _metadata.create_all(connection)
                    connection.execute(_schema.insert().values(version=SCHEMA))
                yield connection
                connection.commit()

    def _has_tables(self, connection: Connection) -> bool:
        """Return whether the tables are there; raises `BadStore` if they have another version."""
        if not inspect(connection).has_table(_schema.name):
            return False
        found = connection.scalar(select(_schema.c.version))
        if found != SCHEMA:
            newer = found is not None and found > SCHEMA
            fix = "install a newer ftdrive" if newer else "move it away, and rebuild it from the run folders"
            raise BadStore(f"the store {self.name} has version {found}, this ftdrive uses version {SCHEMA}: {fix}")
        return True

    @contextmanager
    def _in_words(self, verb: str) -> Iterator[None]:
        """Turn an error of the database into one sentence."""
        try:
            yield
        except (DBAPIError, OSError) as error:
            reason = " ".join(str(error.orig if isinstance(error, DBAPIError) else error).split())
            raise BadStore(
                f"the store {self.name} cannot be {verb} ({reason}): check [store] url, and who may use it"
            ) from error
