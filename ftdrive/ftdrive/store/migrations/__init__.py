"""Migrations of the tables between versions of ftdrive, by Alembic and without alembic.ini."""

from alembic import command
from alembic.config import Config
from sqlalchemy import Connection

from ftdrive.store.tables import SCHEMA, schema


def migrate(connection: Connection) -> None:
    """Create the tables, or bring those of an older version to `SCHEMA`, in the transaction of the caller."""
    config = Config(attributes={"connection": connection})
    config.set_main_option("script_location", "ftdrive.store:migrations")
    command.upgrade(config, "head")
    connection.execute(schema.delete())
    connection.execute(schema.insert().values(version=SCHEMA))
