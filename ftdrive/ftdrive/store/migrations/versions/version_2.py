"""Version 2: models, host and payload of a result, changes of the bias, and cells."""

from alembic import op
from sqlalchemy import JSON, Column, Float, String

revision = "0002"
down_revision = "0001"


def upgrade() -> None:
    """Add columns, which are empty in old rows, and the table of cells."""
    for name in ("arm_model", "sensor_model", "robot_host"):
        op.add_column("ftdrive_results", Column(name, String))
    op.add_column("ftdrive_results", Column("payload_kg", Float))
    op.add_column("ftdrive_results", Column("payload_com_m", JSON))
    for name in ("bias_change", "bias_change_sigma", "calibration_sigma"):
        for axis in ("fx", "fy", "fz", "tx", "ty", "tz"):
            op.add_column("ftdrive_verifications", Column(f"{name}_{axis}", Float))
    op.create_index("ix_ftdrive_verifications_created_utc", "ftdrive_verifications", ["created_utc"])
    op.create_table(
        "ftdrive_cells",
        Column("name", String, primary_key=True),
        Column("config", String, nullable=False),
        Column("verify_every_days", Float, nullable=False),
        *(Column(name, String) for name in ("arm_serial", "robot_host", "sensor_url", "tool")),
    )
