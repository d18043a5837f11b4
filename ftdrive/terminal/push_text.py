"""What a push to the controller would change, in lines."""

from collections.abc import Sequence

import numpy as np

from drivers.interfaces import LoadSettings
from ftdrive.checks.flange_load import margin_in_words
from ftdrive.session.settings_push import Push

_LEVEL_DEG = 0.05


def proposal_in_lines(push: Push) -> list[str]:
    """Return the controller's values beside the new ones, and what speaks for and against the change."""
    lines = []
    if push.new.mass_kg is not None:
        lines += _payload_table(push)
        lines.append(f"Payload: {margin_in_words(push.new.mass_kg, push.devices['arm'].model)}.")
    if push.load is not None:
        lines.append(
            "Included are sensor and adapter, {sensor_mass_kg:g} kg; their centre is taken half way up the sensor's "
            "height of {sensor_height_mm:g} mm.".format(**push.reason)
        )
    before_kg = push.reason.get("payload_at_calibration_kg")
    if before_kg is not None and push.old.mass_kg is not None and abs(before_kg - push.old.mass_kg) > 1e-3:
        lines.append(f"At the calibration, the payload in the controller was {before_kg:.3f} kg.")
    if push.lean is not None:
        lines.append(_lean(push))
    if push.new.up_base_m_s2 is not None:
        lines.append(f"Gravity  {_vector(push.old.up_base_m_s2)} → {_vector(push.new.up_base_m_s2)} m/s², base axes")
    if push.contact is not None:
        force_N, torque_Nm = np.linalg.norm(push.contact[:3]), np.linalg.norm(push.contact[3:])
        lines.append(f"The reading differs from a free tool by {force_N:.1f} N, {torque_Nm:.2f} N·m: drift or contact.")
    return lines


def _payload_table(push: Push) -> list[str]:
    old, new, load = push.old, push.new, push.load
    sigma_kg, sigma_mm = (None, None) if load is None else (load.sigma_kg, [*(1e3 * load.sigma_m)])
    change_kg = "" if old.mass_kg is None or new.mass_kg is None else f"{new.mass_kg - old.mass_kg:+.3f} kg"
    change_mm = ""
    if old.p_flange_com_m is not None and new.p_flange_com_m is not None:
        change = np.subtract(new.p_flange_com_m, old.p_flange_com_m)
        change_mm = "({:+.1f}, {:+.1f}, {:+.1f}) mm".format(*(1e3 * change))
    rows = [
        ("", "controller", "new", "sigma", "change"),
        ("mass", _mass(old), _mass(new), "" if sigma_kg is None else f"{sigma_kg:.4f} kg", change_kg),
        ("centre (flange)", _centre(old), _centre(new), "" if sigma_mm is None else _three(sigma_mm, 2), change_mm),
        ("inertia", _inertia(old), _inertia(new), "", "not identified: kept" if load is not None else ""),
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def settings_in_words(settings: LoadSettings | None) -> str:
    """Return what a controller reports."""
    if settings is None or settings.mass_kg is None:
        return "the controller does not report its payload: compare it at the pendant"
    up = "" if settings.up_base_m_s2 is None else f", gravity {_vector(settings.up_base_m_s2)} m/s²"
    return f"{_mass(settings)} at {_centre(settings)}{up}"


def _lean(push: Push) -> str:
    up = push.old.up_base_m_s2
    if up is None:
        return f"The base {push.lean}, compared with [workcell] mounting; the controller does not report its gravity."
    off_deg = np.degrees(np.arccos(np.clip(up[2] / np.linalg.norm(up), -1, 1)))
    setting = "level" if off_deg < _LEVEL_DEG else f"{_vector(up)} m/s²"
    advice = (
        "" if push.lean is None or not push.lean.is_significant or push.new.up_base_m_s2 else "; --gravity sends it"
    )
    return f"The base {push.lean}; the controller is set to {setting}{advice}."


def _mass(settings: LoadSettings) -> str:
    return "not reported" if settings.mass_kg is None else f"{settings.mass_kg:.3f} kg"


def _centre(settings: LoadSettings) -> str:
    p_m = settings.p_flange_com_m
    return "not reported" if p_m is None else _three([1e3 * one for one in p_m])


def _three(values_mm: Sequence[float], digits: int = 1) -> str:
    return f"({', '.join(f'{one:.{digits}f}' for one in values_mm)}) mm"


def _inertia(settings: LoadSettings) -> str:
    if settings.inertia_kg_m2 is None:
        return "not reported"
    return "point mass" if not any(settings.inertia_kg_m2) else "as set"


def _vector(values: Sequence[float] | None) -> str:
    return "unknown" if values is None else "({:.3f}, {:.3f}, {:.3f})".format(*values)
