"""Control requests that act on the tool and on the sensor."""

import math
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from ftmocks.arrays import Array
from ftmocks.disturbances import FOREVER_S, Cable, Push, SensorDrift
from ftmocks.inertia import Body
from ftmocks.sensors.catalogue import Sensor
from ftmocks.wires.faults import Faults
from ftmocks.world import Truth, World

Request = dict[str, Any]

BUMP_BASE = (15.0, 0.0, 0.0, 0.0, 0.0, 0.0)
BUMP_S = 0.3
CABLE_POINT_M = (0.04, 0.0, 0.06)
STRING_MM = 250.0
SWING_DEG = 2.0
"""Swing of a load that an operator has hung, degrees."""
GRIPPED_M = 0.06
"""Edge length of the cubic load in the gripper, m."""
NO_NUMBER: Array = np.full(6, np.nan)


class Workcell:
    """Control requests that act on the tool and on the sensor.

    Parameters
    ----------
    world
        The emulated world, which the requests change.
    sensors
        Sensors by name.
    swing_deg
        Swing of a load after it was hung.
    """

    def __init__(self, world: World, sensors: Mapping[str, Sensor], swing_deg: float = SWING_DEG) -> None:
        self._world = world
        self._sensors = sensors
        self._swing_deg = swing_deg
        self._empty: Truth | None = None
        """True quantities of the cell before a load was gripped; None if the gripper is empty."""
        self.verbs: dict[str, Callable[[Request], dict[str, Any] | None]] = {
            "push": self._push,
            "bump": self._bump,
            "cable": self._cable,
            "drift": self._drift,
            "payload-shift": self._payload_shift,
            "hang": self._hang,
            "grip": self._grip,
            "unhang": lambda _: self._unload(),
            "freeze-sensor": self._freeze_sensor,
            "nan": self._nan,
            "saturate": self._saturate,
            "sensor-faults": self._sensor_faults,
            "unplug": self._unplug,
        }
        """Methods by the value of "do". A wrong request raises ValueError, TypeError or KeyError and does nothing."""

    def _push(self, request: Request) -> None:
        wrench = _numbers(request["wrench"], 6)
        push = self._contact(wrench, request, FOREVER_S)
        self._world.touch("push", push if wrench.any() else None)

    def _bump(self, request: Request) -> None:
        wrench = _numbers(request.get("wrench", BUMP_BASE), 6)
        self._world.touch("bump", self._contact(wrench, {"axes": "base", **request}, BUMP_S))

    def _contact(self, wrench: Array, request: Request, seconds: float) -> Push:
        in_sensor = {"sensor": True, "base": False}[request.get("axes", "sensor")]
        return Push(wrench, in_sensor, self._world.now_s + float(request.get("seconds", seconds)))

    def _cable(self, request: Request) -> None:
        if not request.get("on", True):
            self._world.touch("cable", None)
            return
        point_m = _numbers(request.get("point_m", CABLE_POINT_M), 3)
        if "joint" in request:
            joint = int(request["joint"])
            if not 1 <= joint <= 6:
                raise ValueError(f"the joint must be 1 to 6, not {joint}")
            beyond_rad = float(np.radians(request["beyond_deg"]))
            cable = Cable(_numbers(request["force_N_deg"], 3), point_m, joint=joint - 1, beyond_rad=beyond_rad)
        else:
            towards = _numbers(request["towards"], 3) if "towards" in request else None
            within_rad = float(np.radians(request.get("within_deg", 45.0)))
            cable = Cable(_numbers(request["force_N"], 3), point_m, towards=towards, within_rad=within_rad)
        self._world.touch("cable", cable)

    def _drift(self, request: Request) -> None:
        zero = [0.0] * 3
        total = [*_numbers(request.get("force_N", zero), 3), *_numbers(request.get("torque_Nm", zero), 3)]
        self._world.drifts += (SensorDrift(np.array(total), self._world.now_s, float(request["seconds"])),)

    def _payload_shift(self, request: Request) -> dict[str, Any]:
        mass_kg = float(request["mass_kg"]) if "mass_kg" in request else None
        com_m = _numbers(request["p_sensor_com_m"], 3) if "p_sensor_com_m" in request else None
        if mass_kg is None and com_m is None:
            raise KeyError("mass_kg")
        self._world.shift_payload(mass_kg, com_m)
        return {"truth": self._world.truth.to_json()}

    def _hang(self, request: Request) -> None:
        mass_kg, p_flange_m = _load(request)
        string_m = 1e-3 * float(request.get("string_mm", STRING_MM))
        swing_deg = float(request.get("swing_deg", self._swing_deg))
        if not (0.0 < string_m < math.inf and 0.0 <= swing_deg < 90.0):
            raise ValueError(f"a string of {1e3 * string_m} mm, or a swing of {swing_deg}°, is not possible")
        self._unload()
        self._world.hang(mass_kg, p_flange_m, string_m, math.radians(swing_deg))

    def _grip(self, request: Request) -> None:
        mass_kg, p_flange_m = _load(request)
        self._unload()
        self._empty = self._world.truth
        load = Body(mass_kg, self._empty.in_sensor(p_flange_m), np.eye(3) * GRIPPED_M**2 / 6)
        self._world.truth = self._empty.holding(load)

    def _unload(self) -> None:
        self._world.unhang()
        if self._empty is not None:
            self._world.truth, self._empty = self._empty, None

    def _freeze_sensor(self, request: Request) -> None:
        self._world.read_always(None)
        if request.get("on", True):
            self._world.read_always(self._world.measure(1)[0])

    def _nan(self, request: Request) -> None:
        for sensor in self._chosen(request):
            if not sensor.carries_nan:
                raise ValueError(f"the wire of {sensor.name} carries whole numbers only")
        self._world.read_always(NO_NUMBER if request.get("on", True) else None)

    def _saturate(self, request: Request) -> None:
        for sensor in self._chosen(request):
            sensor.saturate(int(request.get("axis", 2)) if request.get("on", True) else None)

    def _sensor_faults(self, request: Request) -> None:
        known = {field.name for field in fields(Faults)}
        changes = {key: value for key, value in request.items() if key not in ("do", "device")}
        if unknown := sorted(changes.keys() - known):
            raise ValueError(f"unknown fault {unknown[0]}; known: {', '.join(sorted(known))}")
        for sensor in self._chosen(request):
            for key, value in changes.items():
                setattr(sensor.emulator.faults, key, type(getattr(sensor.emulator.faults, key))(value))

    def _unplug(self, request: Request) -> dict[str, Any]:
        chosen = self._chosen(request)
        for sensor in chosen:
            sensor.emulator.unplug()
        return {"devices": [sensor.name for sensor in chosen]}

    def _chosen(self, request: Request) -> list[Sensor]:
        device = request.get("device", "sensor")
        chosen = list(self._sensors.values()) if device == "sensor" else [self._sensors[device]]
        if not chosen:
            raise ValueError("this station has no sensor")
        return chosen


def _load(request: Request) -> tuple[float, Array]:
    """Return mass, kg, and position (3,) of a load in flange coordinates, m."""
    mass_kg = float(request["mass_kg"])
    if not 0.0 < mass_kg < math.inf:
        raise ValueError(f"a load of {mass_kg} kg is impossible")
    return mass_kg, 1e-3 * _numbers(request["at_mm"], 3)


def _numbers(values: Any, count: int) -> Array:
    numbers = np.array(values, dtype=float)
    if numbers.shape != (count,) or not np.isfinite(numbers).all():
        raise ValueError(f"expected {count} numbers, got {values!r}")
    return numbers
