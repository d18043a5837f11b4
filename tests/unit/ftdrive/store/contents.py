"""Everything that is in a database, whatever its kind."""

from sqlalchemy import MetaData, NullPool, create_engine, inspect, select


def dump(url: str) -> list[str]:
    """Return every row of every table, as text."""
    engine, metadata = create_engine(url, poolclass=NullPool), MetaData()
    with engine.connect() as connection:
        metadata.reflect(connection)
        return sorted(
            f"{table.name} {sorted(row.items())}"
            for table in metadata.sorted_tables
            for row in connection.execute(select(table)).mappings()
        )


def columns(url: str) -> dict[str, set[str]]:
    """Return the columns and indexes of every table."""
    inspector = inspect(create_engine(url, poolclass=NullPool))
    return {
        table: {f"{one['name']} {one['type']} {one['nullable']}" for one in inspector.get_columns(table)}
        | {str(one["name"]) for one in inspector.get_indexes(table)}
        for table in inspector.get_table_names()
    }


def wipe(url: str) -> None:
    """Drop every table."""
    engine, metadata = create_engine(url, poolclass=NullPool), MetaData()
    metadata.reflect(engine)
    metadata.drop_all(engine)
