"""Everything that is in a database, read without the code under test and in the same form from each kind."""

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import Connection, NullPool, create_engine, text

_TABLES = {
    "sqlite": "SELECT name FROM sqlite_master WHERE type = 'table'",
    "postgresql": "SELECT tablename FROM pg_tables WHERE schemaname = 'public'",
}


@contextmanager
def connected(url: str) -> Iterator[Connection]:
    """Connect, and commit at the end."""
    with create_engine(url, poolclass=NullPool).begin() as connection:
        yield connection


def dump(url: str) -> list[str]:
    """Return every row of every table, sorted by columns and as text."""
    with connected(url) as connection:
        return sorted(
            f"{name}: {sorted((key, _plain(value)) for key, value in row.items())}"
            for name in _names(connection)
            for row in connection.execute(text(f"SELECT * FROM {name}")).mappings()
        )


def wipe(url: str) -> None:
    """Drop every table."""
    with connected(url) as connection:
        for name in _names(connection):
            connection.execute(text(f"DROP TABLE {name}"))


def _names(connection: Connection) -> list[str]:
    return list(connection.scalars(text(_TABLES[connection.dialect.name])))


def _plain(value: Any) -> Any:
    """Return a value as PostgreSQL gives it: with lists, objects and truth values."""
    if isinstance(value, str) and value[:1] in ("[", "{"):
        return json.loads(value)
    return int(value) if isinstance(value, bool) else value
