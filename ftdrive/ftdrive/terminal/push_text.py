"""What a push to the controller would change, in lines."""

import numpy as np
from numpy.typing import ArrayLike

from ftcalib.rounding import to_place_of
from ftdrive.checks.flange_load import FlangeLoad, margin_in_words
from ftdrive.session.settings_push import Push
from ftdrivers.interfaces import ControllerSettings

_LEVEL_DEG = 0.05


def proposal_in_lines(push: Push) -> list[str]:
    """Return the controller's values beside the new ones, and what speaks for and against the change."""
    lines = _table(push)
    if (restored := push.reason.get("restores")) is not None:
        lines.append(f"The new values are the old ones of {restored}.")
    if push.load is not None and push.new.mass_kg is not None:
        lines += _payload(push, push.load)
    before_kg = push.reason.get("payload_at_calibration_kg")
    if before_kg is not None and push.old.mass_kg is not None and abs(before_kg - push.old.mass_kg) > 1e-3:
        lines.append(f"At the calibration, the payload in the controller was {before_kg:.3f} kg.")
    if push.lean is not None:
        lines.append(_lean(push))
    if push.contact is not None:
        force_N, torque_Nm = np.linalg.norm(push.contact[:3]), np.linalg.norm(push.contact[3:])
        lines.append(f"The reading differs from a free tool by {force_N:.1f} N, {torque_Nm:.2f} N·m: drift or contact.")
    return lines


def _table(push: Push) -> list[str]:
    """Return a row for each value that is to be set, as wide as a narrow terminal."""
    values = {
        "mass, kg": (push.old.mass_kg, push.new.mass_kg, 1.0, 3),
        "centre, mm": (push.old.p_flange_com_m, push.new.p_flange_com_m, 1e3, 1),
        "gravity, m/s²": (push.old.up_base_m_s2, push.new.up_base_m_s2, 1.0, 3),
    }
    rows = [("", "controller", "new", "change")]
    for name, (old, new, scale, digits) in values.items():
        if new is not None:
            change = "" if old is None else _numbers(np.subtract(new, old) * scale, f"+.{digits}f")
            rows.append((name, _numbers(old, f".{digits}f", scale), _numbers(new, f".{digits}f", scale), change))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _payload(push: Push, load: FlangeLoad) -> list[str]:
    centre = ", ".join(to_place_of(1e3 * sigma_m, 1e3 * sigma_m) for sigma_m in load.sigma_m)
    sigma = f"{to_place_of(load.sigma_kg, load.sigma_kg)} kg and {centre} mm"
    inertia = "stays that of a point mass" if not any(push.new.inertia_kg_m2 or ()) else "is kept"
    return [
        f"The centre is in flange axes. One sigma is {sigma}. The inertia {inertia}: gravity does not reveal it.",
        f"The load is {margin_in_words(load.mass_kg, push.devices['arm'].model)}.",
        "Included are sensor and adapter, {sensor_mass_kg:g} kg; their centre is taken half way up the sensor's "
        "height of {sensor_height_mm:g} mm.".format(**push.reason),
    ]


def settings_in_words(settings: ControllerSettings | None) -> str:
    """Return what a controller reports."""
    if settings is None or settings.mass_kg is None:
        return "the controller does not report its payload: compare it at the pendant"
    up = "" if settings.up_base_m_s2 is None else f", gravity {_numbers(settings.up_base_m_s2, '.3f')} m/s²"
    return f"{settings.mass_kg:.3f} kg at {_numbers(settings.p_flange_com_m, '.1f', 1e3)} mm{up}"


def _lean(push: Push) -> str:
    up = push.old.up_base_m_s2
    if up is None:
        return f"The base {push.lean}, compared with [workcell] mounting; the controller does not report its gravity."
    off_deg = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
    setting = "level" if off_deg < _LEVEL_DEG else f"{_numbers(up, '.3f')} m/s²"
    advice = (
        "" if push.lean is None or not push.lean.is_significant or push.new.up_base_m_s2 else "; --gravity sends it"
    )
    return f"The base {push.lean}; the controller is set to {setting}{advice}."


def _numbers(value: ArrayLike | None, form: str, scale: float = 1.0) -> str:
    if value is None:
        return "not reported"
    numbers = [f"{one:{form}}" for one in scale * np.atleast_1d(value)]
    return numbers[0] if np.ndim(value) == 0 else f"({', '.join(numbers)})"
