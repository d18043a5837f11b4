"""Version 3: whether the cell of a result was emulated."""

from alembic import op
from sqlalchemy import Boolean, Column, false

revision = "0003"
down_revision = "0002"


def upgrade() -> None:
    """Add the column; old rows are taken as real until their files are read again."""
    op.add_column("ftdrive_results", Column("emulated", Boolean, nullable=False, server_default=false()))
