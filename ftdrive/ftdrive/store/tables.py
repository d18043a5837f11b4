"""The tables of the store as this version reads and writes them, and their rows as records.

A change of a column of results, verifications or weighings raises `SCHEMA`: an older index is then built again from
its files.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, Final

from sqlalchemy import JSON, Boolean, Column, Float, Integer, MetaData, Row, String, Table, false

from ftdrive.runs.weighings import REFUSALS
from ftdrive.store.records import (
    BriefVerification,
    Record,
    StoredCell,
    StoredResult,
    StoredVerification,
    StoredWeighings,
)

SCHEMA: Final = 4
"""Version of the index, kept in the database."""

_WRENCH = ("fx", "fy", "fz", "tx", "ty", "tz")
_WRENCHES = ("bias_change", "bias_change_sigma", "calibration_sigma")
"""Fields of a verification with a column for each component: read three times as fast as JSON."""

metadata: Final = MetaData()
schema: Final = Table("ftdrive_schema", metadata, Column("version", Integer, primary_key=True, autoincrement=False))
results: Final = Table(
    "ftdrive_results",
    metadata,
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
    *(Column(name, String) for name in ("arm_model", "sensor_model", "robot_host")),
    Column("payload_kg", Float),
    Column("payload_com_m", JSON(none_as_null=True)),
    Column("emulated", Boolean, nullable=False, server_default=false()),
)
verifications: Final = Table(
    "ftdrive_verifications",
    metadata,
    Column("id", String, primary_key=True),
    Column("path", String, nullable=False),
    Column("run", String, nullable=False),
    Column("calibration_id", String, nullable=False, index=True),
    Column("created_utc", String, index=True),
    Column("passed", Boolean, nullable=False),
    *(Column(name, String) for name in ("change", "reason")),
    Column("temperature_C", Float),
    *(Column(f"{name}_{axis}", Float) for name in _WRENCHES for axis in _WRENCH),
)
weighings: Final = Table(
    "ftdrive_weighings",
    metadata,
    Column("id", String, primary_key=True),
    Column("path", String, nullable=False),
    Column("day", String, nullable=False, index=True),
    *(Column(name, String) for name in ("tool", "arm_serial", "sensor_serial", "robot_host", "calibration_id")),
    Column("emulated", Boolean, nullable=False),
    Column("size", Integer, nullable=False),
    Column("weighings", Integer, nullable=False),
    *(Column(f"refused_{code}", Integer, nullable=False) for code in REFUSALS),
    Column("last_utc", String),
    *(Column(name, Float) for name in ("mass_kg", "mass_sigma_kg")),
)
cells: Final = Table(
    "ftdrive_cells",
    metadata,
    Column("name", String, primary_key=True),
    Column("config", String, nullable=False),
    Column("verify_every_days", Float, nullable=False),
    *(Column(name, String) for name in ("arm_serial", "robot_host", "sensor_url", "tool")),
)
RECORDS: Final[Mapping[type[Record], Table]] = {
    StoredResult: results,
    StoredVerification: verifications,
    StoredWeighings: weighings,
}

CHECK: Final = [
    *(verifications.c[name] for name in BriefVerification._fields[:-1]),
    *(verifications.c[f"{name}_{axis}"] for name in _WRENCHES for axis in _WRENCH),
]
"""Columns of a check."""
_SINGLE = tuple(column.name for column in verifications.columns if not column.name.endswith(_WRENCH))


def to_row(record: Record | StoredCell) -> dict[str, Any]:
    """Return a record by columns."""
    row = asdict(record)
    row |= {f"refused_{code}": number for code, number in row.pop("refusals", {}).items()}
    for name in _WRENCHES if isinstance(record, StoredVerification) else ():
        values = row.pop(name) or [None] * len(_WRENCH)
        row |= {f"{name}_{axis}": value for axis, value in zip(_WRENCH, values, strict=True)}
    return row


def to_result(row: Row[Any]) -> StoredResult:
    """Return a row of `results` as a record."""
    return StoredResult(**row._asdict())


def to_cell(row: Row[Any]) -> StoredCell:
    """Return a row of `cells` as a record."""
    return StoredCell(**row._asdict())


def to_verification(row: Row[Any]) -> StoredVerification:
    """Return a row of `verifications` as a record."""
    return StoredVerification(
        **dict(zip(_SINGLE, row, strict=False)),
        bias_change=_wrench(row[-18:-12]),
        bias_change_sigma=_wrench(row[-12:-6]),
        calibration_sigma=_wrench(row[-6:]),
    )


def to_weighings(row: Row[Any]) -> StoredWeighings:
    """Return a row of `weighings` as a record."""
    values = row._asdict()
    refusals = {code: values.pop(f"refused_{code}") for code in REFUSALS}
    return StoredWeighings(**values, refusals=refusals)


def to_check(row: Sequence[Any]) -> BriefVerification:
    """Return a row with the columns `CHECK` as a check."""
    calibration_id, created_utc, passed, change, temperature_C, *bias = row
    return BriefVerification(calibration_id, created_utc, passed, change, temperature_C, tuple(bias))


def _wrench(values: Sequence[Any]) -> list[float] | None:
    return None if values[0] is None else list(values)
