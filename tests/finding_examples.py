"""A finding of each code with values as they are found in real data."""

from collections.abc import Iterator
from typing import Any, Final

from ftcalib.findings import CODES, Finding

# fmt: off
_VALUES: Final[dict[str, Any]] = {
    "also": ["inverted orientations"], "axes": "x and y", "channel": "fx", "channels": "fx, fy and fz",
    "com_mm": [12.0, -3.0, 85.0], "components": 0.0123, "direction": [0.0, 0.12, -0.99], "entry": "Fx by Ty",
    "corrections": [["force", ["-x", "y", "z"]], ["torque", ["y", "-x", "z"]]], "factor": 1.0213, "kind": "tool",
    "names": "mounting, centre of mass", "neighbour": "before", "order": "x, y, z, w", "orders": ["wxyz"],
    "origin": "sensor", "parent": "dde4162981b1", "point_mm": [12.0, -3.0, 185.0], "pose": 12, "poses": [5, 17, 23],
    "principal_gm2": [1.2, 3.4, 5.6], "read_as": "w, x, y, z", "run": "runs/2026-11-30-gripper", "sigma": 0.0012,
    "side": "+y", "source": "cross-validation", "unit": "mm", "unit_N": [0.61459, 0.00012],
    "units": [["lbf", "N·m"], ["kgf", "kgf·m"]],
}
# fmt: on


def examples() -> Iterator[Finding]:
    """Yield a finding of each code, in the order of the table."""
    for name, code in CODES.items():
        values = {key: _VALUES.get(key, 12 if key.startswith("n_") else 12.345) for key in code.values}
        values |= {key: 0.0123 for key in values if key.startswith("sigma_")}
        if name == "constant_force":
            values["force_N"] = [1.2, -2.0, 12.3]
        yield Finding(name, code.severities[0], values)
