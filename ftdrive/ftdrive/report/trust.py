"""How old a result is, and what its last verification found: from the run folders near its file, and from the store."""

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ftcalib import CalibrationResult
from ftdrive.errors import BadStore, ConfigError
from ftdrive.runs.verification_record import age_of, outcome_in_words, verification_near


def trust(
    result: CalibrationResult, source: Path, store_url: Callable[[], str | None], now: datetime
) -> dict[str, Any]:
    """Return age and last verification of a result; a store that cannot be read is named in `store_error`.

    Parameters
    ----------
    result : CalibrationResult
    source : Path
        Its file or run folder.
    store_url : callable
        Reads `[store] url`; None is the user's store.
    now : datetime
    """
    near = verification_near(source, result.id)
    kept, error = _of_store(result.id, store_url)
    known = [_plain(one) for one in (near, kept) if one is not None and one.created_utc]
    last = max(known, key=lambda one: datetime.fromisoformat(one["created_utc"]), default=None)
    verified = "not verified"
    if last is not None:
        age = now - datetime.fromisoformat(last["created_utc"])
        verified = outcome_in_words(age, passed=last["passed"], change=last["change"])
    words = ", ".join([*age_of(result, now), verified])
    return {"words": words, "last_verification": last, "store_error": error}


def _of_store(calibration_id: str, url: Callable[[], str | None]) -> tuple[Any, str]:
    """Return what the store has, and why it cannot be read."""
    from ftdrive.store.store import Store

    try:
        return Store(url()).last_verification(calibration_id), ""
    except (BadStore, ConfigError) as error:
        return None, str(error)


def _plain(one: Any) -> dict[str, Any]:
    """Return the fields that a `VerificationRecord` and a `StoredVerification` share."""
    at = one.created_utc if isinstance(one.created_utc, datetime) else datetime.fromisoformat(one.created_utc)
    return {
        "created_utc": at.astimezone(UTC).isoformat(),
        "passed": one.passed,
        "change": one.change,
        "reason": one.reason or "",
        "path": str(one.path),
    }
