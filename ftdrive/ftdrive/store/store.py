"""The store: cells, and an index of results, verifications and weighings, which can be rebuilt from run folders."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import Column, ColumnElement, Connection, Row, Select, Table, bindparam, delete, func, select

from ftdrive.runs.verification import VerificationRecord
from ftdrive.runs.weighings import FILES, REFUSALS, WeighingDay, sum_up
from ftdrive.store import database
from ftdrive.store.database import Database, all_paths
from ftdrive.store.records import STORED, Record, StoredCell, StoredResult, read_records, record_paths

# Time-out when waiting for another writer's lock, s.
WAIT_S = 5.0

_MOST = 5000

_Stored = TypeVar("_Stored")


@dataclass(frozen=True, slots=True)
class Indexed:
    """Numbers of records that `Store.index` or `Store.rebuild` has read and added."""

    results: int
    verifications: int
    weighings: int
    """Number of files with weighings, each of one day."""
    unreadable: tuple[str, ...]
    """Texts with path and error of the files that could not be read."""


class Store:
    """A database with an index of run folders and the cells of a fleet, opened at the first call of a method.

    `url` is the address of an SQLite file or a PostgreSQL database in the form of SQLAlchemy, by default a file in the
    user's data folder. `wait_s` is the time-out for another writer, and for a server that does not answer. Raises
    `ConfigError` for an invalid address or a missing driver. Every method raises `BadStore` if the database cannot be
    read or written, or if its version is newer.
    """

    def __init__(self, url: str | None = None, *, wait_s: float = WAIT_S) -> None:
        self._database = Database(url, wait_s)
        self.name = self._database.name
        """Name of the store in messages: the file, or the address without its password."""

    @cached_property
    def _current(self) -> Database:
        """The database; if its tables are of an older version, they are first rebuilt from the files they name."""
        if (paths := self._database.paths_of_older()) is not None:
            records, _ = read_records(map(Path, sorted(paths)))
            with self._database.writing() as connection:
                self._write(connection, records)
        return self._database

    # -------------------------------------------------------------------------------------------------------- writing

    def index(self, *folders: Path) -> Indexed:
        """Add the new files in run folders, or in folders that contain them; return how many were added.

        A file with a known path is not read again, because files of a run are never overwritten; a weighing file is
        read again if it has grown.
        """
        paths = record_paths(folders)
        with self._current.reading() as connection:
            known = set() if connection is None else _paths_in_store(connection, paths)
        return self._add(path for path in paths if str(path) not in known)

    def rebuild(self, *folders: Path) -> Indexed:
        """Read these folders and those of all indexed runs again, and remove deleted runs from the index.

        A missing run is kept if its parent folder is missing too, because it may be on another disk or computer.
        """
        with self._current.reading() as connection:
            known = set() if connection is None else all_paths(connection)
        parents = {Path(path).parent.parent for path in known}
        gone = [path for path in known if not Path(path).exists() and Path(path).parent.parent.is_dir()]
        return self._add(record_paths([*folders, *parents]), forget=gone)

    def put_weighings(self, record: WeighingDay) -> None:
        """Insert or replace the weighings of a day."""
        with self._current.writing() as connection:
            self._write(connection, [record])

    def put_cells(self, cells: Iterable[StoredCell]) -> None:
        """Insert cells, replacing those with the same name; if that fails, no cell is changed."""
        if rows := [_to_row(cell) for cell in cells]:
            with self._current.writing() as connection:
                connection.execute(self._database.upsert(database.cells), rows)

    def remove_cells(self, names: Iterable[str]) -> None:
        """Remove the cells with these names; ignore unknown names."""
        by_name = delete(database.cells).where(database.cells.c.name == bindparam("cell"))
        with self._current.writing() as connection:
            for name in names:
                connection.execute(by_name, {"cell": name})

    def _add(self, paths: Iterable[Path], forget: Sequence[str] = ()) -> Indexed:
        records, unreadable = read_records(paths)
        if records or forget:
            with self._current.writing() as connection:
                self._write(connection, records, forget)
        kinds = (StoredResult, VerificationRecord, WeighingDay)
        results, verifications, weighings = (sum(isinstance(record, kind) for record in records) for kind in kinds)
        return Indexed(results, verifications, weighings, unreadable)

    def _write(self, connection: Connection, records: Sequence[Record], forget: Sequence[str] = ()) -> None:
        """Insert records and delete those at the paths `forget`; of files with equal content, keep the first path."""
        # The key of a record is its content, so that a copied or moved run counts once, even from two computers.
        for kind, table in database.RECORDS.items():
            rows = [_to_row(record) for record in records if isinstance(record, kind)]
            same = _paths_where(connection, table, table.c.id, [row["id"] for row in rows])
            if gone := [*forget, *(path for path in same if not Path(path).exists())]:
                which = delete(table).where(table.c.path == bindparam("gone"))
                connection.execute(which, [{"gone": path} for path in gone])
            if rows:
                connection.execute(self._database.upsert(table, first_by="path"), rows)

    # -------------------------------------------------------------------------------------------------------- reading

    def results(self, tool: str | None = None) -> list[StoredResult]:
        """Return all results, or those with the name of one tool, the oldest first."""
        table = database.results
        return self._read(_oldest_first(table).where(*_is(table.c.tool, tool)), _by_name(StoredResult))

    def find(self, start: str) -> list[StoredResult]:
        """Return the results whose id begins with this text."""
        query = select(database.results).where(database.results.c.id.startswith(start, autoescape=True))
        return self._read(query, _by_name(StoredResult))

    def verifications(self, calibration_id: str | None = None) -> list[VerificationRecord]:
        """Return all verifications, or those of the calibration with this id, the oldest first."""
        table = database.verifications
        return self._read(_oldest_first(table).where(*_is(table.c.calibration_id, calibration_id)), _to_verification)

    def last_verification(self, calibration_id: str) -> VerificationRecord | None:
        """Return the newest verification of a calibration; None if there is none."""
        return next(reversed(self.verifications(calibration_id)), None)

    def weighings(self, most: int, tool: str | None = None) -> list[WeighingDay]:
        """Return the last `most` records of weighings, each of one day, of all tools or one, the oldest first."""
        table = database.weighings
        newest_first = (table.c.day.desc(), table.c.last_utc.desc().nulls_last(), table.c.id)
        query = select(table).where(*_is(table.c.tool, tool)).order_by(*newest_first).limit(most)
        return self._read(query, _to_weighings)[::-1]

    def last_weighings(self, since_day: str, tool: str | None = None) -> list[WeighingDay]:
        """Return, for each tool and arm, the last day with weighings since a day (ISO 8601, UTC), the oldest first."""
        return sum_up(self._read(_last_weighings(since_day, tool), _to_weighings))

    def cells(self) -> list[StoredCell]:
        """Return all cells, sorted by name."""
        return sorted(self._read(select(database.cells), _by_name(StoredCell)), key=lambda cell: cell.name)

    def fleet(
        self, newest: int, since: datetime
    ) -> tuple[list[StoredCell], list[StoredResult], list[VerificationRecord], list[WeighingDay]]:
        """Return cells, results, verifications and weighings of a fleet from one database connection, the oldest first.

        The results are the `newest` accepted ones for each tool on each arm. Verifications and weighings are those
        since a time; weighings are selected as in `last_weighings`.
        """
        start = since.astimezone(UTC).isoformat(timespec="microseconds")
        checks = select(database.verifications).where(database.verifications.c.created_utc >= start)
        with self._current.reading() as connection:
            cells = _query(connection, select(database.cells), _by_name(StoredCell))
            results = _query(connection, _newest_accepted(newest), _by_name(StoredResult))
            verifications = _query(connection, checks, _to_verification)
            weighings = _query(connection, _last_weighings(start[:10]), _to_weighings)
        cells.sort(key=lambda cell: cell.name)
        return cells, results, sorted(verifications, key=attrgetter("created_utc")), sum_up(weighings)

    def _read(self, query: Select[Any], make: Callable[[Row[Any]], _Stored]) -> list[_Stored]:
        with self._current.reading() as connection:
            return _query(connection, query, make)


def _query(connection: Connection | None, query: Select[Any], make: Callable[[Row[Any]], _Stored]) -> list[_Stored]:
    return [] if connection is None else [make(row) for row in connection.execute(query).all()]


def _paths_in_store(connection: Connection, paths: Sequence[Path]) -> set[str]:
    """Return those paths whose files are in the store, except weighing files that have grown since."""
    texts = [str(path) for path in paths]
    known = {
        path for table in database.RECORDS.values() for path in _paths_where(connection, table, table.c.path, texts)
    }
    growing = [path for path in paths if str(path) in known and path.match(FILES)]
    for start in range(0, len(growing), _MOST):
        sizes = {str(path): path.stat().st_size for path in growing[start : start + _MOST]}
        table = database.weighings
        read = connection.execute(select(table.c.path, table.c.size).where(table.c.path.in_(sizes))).all()
        known -= {path for path, size in read if size != sizes[path]}
    return known


def _paths_where(connection: Connection, table: Table, column: Column[Any], values: Sequence[str]) -> Iterator[str]:
    """Yield the paths of the table's rows with one of the values in `column`, by several queries of limited length."""
    for start in range(0, len(values), _MOST):
        yield from connection.scalars(select(table.c.path).where(column.in_(values[start : start + _MOST])))


def _is(column: Column[Any], value: str | None) -> list[ColumnElement[bool]]:
    return [] if value is None else [column == value]


def _oldest_first(table: Table) -> Select[Any]:
    return select(table).order_by(table.c.created_utc.nulls_first(), table.c.id)


def _newest_accepted(most: int) -> Select[Any]:
    table = database.results
    key = (table.c.arm_serial, table.c.robot_host, table.c.tool)
    newest_first = (table.c.created_utc.desc(), table.c.id.desc())
    rank = func.row_number().over(partition_by=key, order_by=newest_first).label("rank")
    accepted = (table.c.verdict != "rejected", table.c.created_utc.is_not(None))
    ranked = select(table.c.id, rank).where(*accepted).subquery()
    return _oldest_first(table).where(table.c.id.in_(select(ranked.c.id).where(ranked.c.rank <= most)))


def _last_weighings(since_day: str, tool: str | None = None) -> Select[Any]:
    """Return a query for the weighing files of the last day of each combination of tool and arm."""
    table = database.weighings
    key = (table.c.tool, table.c.arm_serial, table.c.robot_host, table.c.emulated)
    rank = func.rank().over(partition_by=key, order_by=table.c.day.desc()).label("rank")
    ranked = select(table.c.id, rank).where(table.c.day >= since_day, *_is(table.c.tool, tool)).subquery()
    return select(table).where(table.c.id.in_(select(ranked.c.id).where(ranked.c.rank == 1)))


def _to_row(record: Record | StoredCell) -> dict[str, Any]:
    row = record.to_dict(STORED) if isinstance(record, VerificationRecord) else asdict(record)
    row |= {f"refused_{code}": number for code, number in row.pop("refusals", {}).items()}
    for name in database.WRENCHES if isinstance(record, VerificationRecord) else ():
        values = row.pop(name) or [None] * len(database.AXES)
        row |= {f"{name}_{axis}": value for axis, value in zip(database.AXES, values, strict=True)}
    return row


def _by_name(kind: Callable[..., _Stored]) -> Callable[[Row[Any]], _Stored]:
    return lambda row: kind(**row._asdict())


def _to_verification(row: Sequence[Any]) -> VerificationRecord:
    # columns are read by position, because access by name takes twice as long
    wrenches = [None if row[k] is None else list(row[k : k + 6]) for k in (8, 14, 20)]
    return VerificationRecord._make((*row[:6], None, None, *row[6:8], *wrenches))


def _to_weighings(row: Row[Any]) -> WeighingDay:
    values = row._asdict()
    refusals = {code: values.pop(f"refused_{code}") for code in REFUSALS}
    return WeighingDay(**values, refusals=refusals)
