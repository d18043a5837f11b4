"""The database of a store: address, lock, tables with their version, and error messages.

The columns are the fields of the records. Every change to the fields of results, verifications or weighings must
increase `SCHEMA`; an older index is then rebuilt from its files.
"""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import UnionType
from typing import Any, Final, get_args, get_type_hints

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
    String,
    Table,
    collate,
    create_engine,
    false,
    inspect,
    make_url,
    select,
    text,
)
from sqlalchemy.exc import ArgumentError, DBAPIError, NoSuchModuleError

from ftdrive.cell.config import user_folder
from ftdrive.errors import BadStore, ConfigError
from ftdrive.runs.verification import VerificationRecord
from ftdrive.runs.weighings import REFUSALS, WeighingDay
from ftdrive.store.records import Record, StoredCell, StoredResult
from ftdrivers.installation import missing_extra

# Version of the tables, which the database stores too.
SCHEMA: Final = 4

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
# Fields of a verification with 6 components each. They get 18 columns, which are read 3 times as fast as JSON.
WRENCHES = ("bias_change", "bias_change_sigma", "calibration_sigma")

metadata: Final = MetaData()
schema: Final = Table("ftdrive_schema", metadata, Column("version", Integer, primary_key=True, autoincrement=False))
_TYPES: Final = {str: String, int: Integer, float: Float, bool: Boolean}


def _define_table(
    name: str, record: type, *more: Column[Any], key: str = "id", index: Collection[str] = (), without: Collection[str]
) -> Table:
    """Define a database table for records: a column per field (JSON if no other type fits), and `more` columns."""
    columns = list[Column[Any]]()
    for field, hint in get_type_hints(record).items():
        is_optional = isinstance(hint, UnionType)
        kind = _TYPES.get(get_args(hint)[0] if is_optional else hint, JSON(none_as_null=True))
        if field not in without:
            column = Column(field, kind, primary_key=field == key, index=field in index, nullable=is_optional)
            columns.append(column)
    return Table(name, metadata, *columns, *more)


results: Final = _define_table(
    "ftdrive_results",
    StoredResult,
    Column("emulated", Boolean, nullable=False, server_default=false()),
    index=["created_utc"],
    without=["emulated"],
)
verifications: Final = _define_table(
    "ftdrive_verifications",
    VerificationRecord,
    *(Column(f"{name}_{axis}", Float) for name in WRENCHES for axis in AXES),
    Column("run", String, nullable=False),
    index=["calibration_id", "created_utc"],
    without=[*WRENCHES, "force_max_N", "torque_max_Nm"],
)
weighings: Final = _define_table(
    "ftdrive_weighings",
    WeighingDay,
    *(Column(f"refused_{code}", Integer, nullable=False) for code in REFUSALS),
    index=["day"],
    without=["refusals"],
)
cells: Final = _define_table("ftdrive_cells", StoredCell, key="name", without=[])
RECORDS: Final[Mapping[type[Record], Table]] = {
    StoredResult: results,
    VerificationRecord: verifications,
    WeighingDay: weighings,
}

# Name of the collation by bytes, so that SQLite and PostgreSQL sort strings in the same order.
_BYTE_ORDER: Final = {"sqlite": "BINARY", "postgresql": "C"}
# Key of the PostgreSQL advisory lock that every writer takes: "ftdrive" in ASCII.
_WRITERS: Final = 0x66746472697665


def default_file() -> Path:
    """Return the path of the user's default store, which may not exist."""
    return user_folder("data") / "store.sqlite"


class Database:
    """An SQLite file or a PostgreSQL database; parameters and errors are those of `ftdrive.store.store.Store`."""

    def __init__(self, url: str | None, wait_s: float) -> None:
        self._wait_s = wait_s
        try:
            self._url = URL.create("sqlite", database=str(default_file())) if url is None else make_url(url)
            self._dialect = self._url.get_backend_name()
            self._is_sqlite = self._dialect == "sqlite"
            if self._dialect not in _BYTE_ORDER:
                raise ConfigError(
                    f"[store] url begins with {self._dialect}: give sqlite:////PATH or postgresql+psycopg://…"
                )
            self._engine: Engine = create_engine(self._url, poolclass=NullPool, connect_args=self._limits())
        except (ArgumentError, NoSuchModuleError, ValueError) as error:  # ValueError if the port is no number
            raise ConfigError("[store] url is not a database address: give one such as sqlite:////PATH") from error
        except ImportError as error:
            raise ConfigError(
                missing_extra(f"[store] url = {self.name!r}", error.name or "psycopg", "fleet")
            ) from error

    @property
    def name(self) -> str:
        """Name of the database in messages: the file, or the address without its password."""
        return (self._is_sqlite and self._url.database) or self._url.render_as_string()

    @contextmanager
    def reading(self) -> Iterator[Connection | None]:
        """Yield a connection for reading; None if the database does not exist or has no tables yet."""
        if self._file is not None and not self._file.exists():  # connecting would create the file
            yield None
            return
        with self._connected("read") as connection:
            yield None if self._version(connection) is None else connection

    @contextmanager
    def writing(self) -> Iterator[Connection]:
        """Yield a connection that locks out other writers, and commit at the end of the block.

        Missing tables are created. Tables of an older version are replaced by empty ones, except for that of the cells.
        """
        # Writers take one lock for the whole database, because row locks of two writers may cause a deadlock.
        if self._file is not None:
            with self._naming_store("written"):
                self._file.parent.mkdir(parents=True, exist_ok=True)
        with self._connected("written") as connection:
            if self._is_sqlite:
                connection.exec_driver_sql("BEGIN IMMEDIATE")  # locks now: writers that read first block
            else:
                connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _WRITERS})
            if self._version(connection) != SCHEMA:
                metadata.drop_all(connection, [schema, *RECORDS.values()])
                metadata.create_all(connection)
                connection.execute(schema.insert().values(version=SCHEMA))
            yield connection
            connection.commit()

    def paths_of_older(self) -> set[str] | None:
        """Return the paths of all records if the tables are of an older version; None otherwise."""
        with self.reading() as connection:
            return None if connection is None or self._version(connection) == SCHEMA else all_paths(connection)

    def upsert(self, table: Table, first_by: str | None = None) -> Any:
        """Return a statement that inserts rows, or replaces rows with the same primary key.

        With `first_by`, a row is replaced only if the new string in this column does not sort after the stored one.
        """
        insert = import_module(f"sqlalchemy.dialects.{self._dialect}").insert(table)  # import only one of two dialects
        new = {column.name: insert.excluded[column.name] for column in table.columns}
        key = [column.name for column in table.primary_key]
        where = None
        if first_by is not None:
            where = insert.excluded[first_by] <= collate(table.c[first_by], _BYTE_ORDER[self._dialect])
        return insert.on_conflict_do_update(index_elements=key, set_=new, where=where)

    def _version(self, connection: Connection) -> int | None:
        """Return the version of the tables; 0 if none is stored, None if there are no tables. A newer one raises."""
        # Tables of an older version are not migrated, because the store is rebuilt from the run folders.
        if not inspect(connection).has_table(schema.name):
            return None
        version = connection.scalar(select(schema.c.version)) or 0
        if version > SCHEMA:
            raise BadStore(
                f"the store {self.name} has version {version}, but this ftdrive uses version {SCHEMA}: "
                "install a newer ftdrive"
            )
        return version

    @property
    def _file(self) -> Path | None:
        """Path of the SQLite file; None for a server, an in-memory database, or a file: URI."""
        path = self._url.database or ""
        return Path(path) if self._is_sqlite and path and not path.startswith("file:") else None

    def _limits(self) -> dict[str, Any]:
        """Return the arguments of the database driver for its time-outs for locks and a server that does not answer."""
        if self._is_sqlite:
            return {"timeout": self._wait_s}
        wait_s = max(2, round(self._wait_s))
        limits = {
            "connect_timeout": wait_s,
            "keepalives_idle": wait_s,
            "keepalives_interval": 1,
            "keepalives_count": wait_s,
            "tcp_user_timeout": 1000 * wait_s,
        }
        return {name: value for name, value in limits.items() if name not in self._url.query}

    @contextmanager
    def _connected(self, verb: str) -> Iterator[Connection]:
        with self._naming_store(verb), self._engine.connect() as connection:
            if not self._is_sqlite:
                connection.exec_driver_sql(f"SET LOCAL lock_timeout = {round(1000 * self._wait_s)}")
            yield connection

    @contextmanager
    def _naming_store(self, verb: str) -> Iterator[None]:
        try:
            yield
        except (DBAPIError, OSError) as error:
            reason = " ".join(str(error.orig if isinstance(error, DBAPIError) else error).split())
            raise BadStore(
                f"the store {self.name} cannot be {verb} ({reason}): check its address and permissions"
            ) from error


def all_paths(connection: Connection) -> set[str]:
    """Return the paths of all records in the database, whose tables may be of any version."""
    existing = {*inspect(connection).get_table_names()}
    tables = [table for table in RECORDS.values() if table.name in existing]
    return {path for table in tables for path in connection.scalars(select(table.c.path))}
