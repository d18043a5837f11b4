"""Run by Alembic: migrates over the connection, and in the transaction, of `ftdrive.store.migrations.migrate`."""

from alembic import context

context.configure(connection=context.config.attributes["connection"], version_table="ftdrive_alembic")
context.run_migrations()
