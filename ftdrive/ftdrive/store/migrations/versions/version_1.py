"""Version 1: results and verifications. A store of that version has these tables already, and no Alembic table."""

from typing import Any

from alembic import op
from sqlalchemy import JSON, Boolean, Column, Float, Integer, String

revision = "0001"
down_revision = None


def upgrade() -> None:
    """Create the tables where they are missing."""
    _create("ftdrive_schema", Column("version", Integer, primary_key=True, autoincrement=False))
    _create(
        "ftdrive_results",
        Column("id", String, primary_key=True),
        Column("path", String, nullable=False),
        Column("run", String, nullable=False),
        Column("created_utc", String),
        *(Column(name, String) for name in ("tool", "arm_serial", "sensor_serial", "mount")),
        Column("verdict", String, nullable=False),
        Column("n_poses", Integer, nullable=False),
        *(Column(name, Float, nullable=False) for name in ("mass_kg", "g_m_s2")),
        Column("numbers", JSON, nullable=False),
        *(Column(name, String) for name in ("dataset_sha256", "parent", "update")),
        Column("temperature_C", Float),
    )
    _create(
        "ftdrive_verifications",
        Column("id", String, primary_key=True),
        Column("path", String, nullable=False),
        Column("run", String, nullable=False),
        Column("calibration_id", String, nullable=False),
        Column("created_utc", String),
        Column("passed", Boolean, nullable=False),
        *(Column(name, String) for name in ("change", "reason")),
        Column("temperature_C", Float),
    )
    for table, column in (("ftdrive_results", "created_utc"), ("ftdrive_verifications", "calibration_id")):
        op.create_index(f"ix_{table}_{column}", table, [column], if_not_exists=True)


def _create(name: str, *columns: Column[Any]) -> None:
    op.create_table(name, *columns, if_not_exists=True)
