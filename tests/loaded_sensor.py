"""Sensors with errors of their matrix, on a tool with known loads: a generator that shares nothing with the estimator.

A sensor reads (I + E) times the true wrench in its own axes, plus square and cube where it is not linear. One run is a
set of poses at rest with a bias that walks, hysteresis, noise and inexact orientations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from ftcalib import CalibrationDataset
from ftcalib.loads.model import KnownLoad, LoadRun

Array = NDArray[np.float64]

LEVER_M = 0.067
"""Range of torque over range of force."""
RANGE = np.repeat([150.0, 150.0 * LEVER_M], 3)
G_M_S2 = 9.80665
TIP_M, SIDE_M, OTHER_M = np.array([0, 0, 0.2]), np.array([0.1, 0, 0.05]), np.array([0, -0.1, 0.05])
NOISE, WALK = np.repeat([0.03, 0.001], 3), np.repeat([0.01, 0.0003], 3)
HYSTERESIS, TURN_DEG, MASS, PLACE_M, ORIGIN_M = 0.0015, 0.02, 0.001, 0.0005, 0.0005
TOOL_KG, TOOL_COM_M = 1.3, np.array([0.004, 0.01, 0.06])


@dataclass(frozen=True)
class Set:
    """One run of a protocol."""

    name: str
    poses: int = 24
    mass_kg: float = 0.0
    place_m: Array | None = None
    hung: bool = False
    place_known: bool = True


@dataclass
class LoadedSensor:
    """A sensor drawn at random, on an arm."""

    seed: int
    gain: float = 0.02
    not_linear: float = 0.0
    """Square and cube at the range, one sigma, relative to the range."""
    rng: np.random.Generator = field(init=False)

    def __post_init__(self) -> None:
        self.rng = rng = np.random.default_rng([4901, self.seed])
        sigma = np.where(np.eye(6) > 0, 1.0, 0.5) * self.gain * RANGE[:, None] / RANGE
        self.E = rng.normal(size=(6, 6)) * sigma
        self.R_flange_sensor = Rotation.from_rotvec([*rng.normal(size=2) * 0.01, rng.uniform(-3, 3)]).as_matrix()
        self.gravity = G_M_S2 * np.array([*rng.normal(size=2) * 0.01, -1.0])
        self.hysteresis = HYSTERESIS * rng.normal(size=6)
        self.powers = self.not_linear * rng.normal(size=(2, 6))
        self.origin_m = ORIGIN_M * rng.normal(size=3)
        """By which the sensor is not where the cell describes it."""

    def read(self, wrench_flange: Array) -> Array:
        """Return readings (n, 6) of true wrenches in flange axes, without bias."""
        w = np.concatenate([part @ self.R_flange_sensor for part in np.split(wrench_flange, 2, axis=1)], axis=1)
        share = w / RANGE
        return np.asarray(w + w @ self.E.T + RANGE * (self.powers[0] * share**2 + self.powers[1] * share**3))

    def dataset(self, n: int, masses: Sequence[tuple[float, Array]], *, hung: bool) -> CalibrationDataset:
        """Return n poses with masses (kg) at places (3,) from the sensor origin, the tool among them."""
        rng = self.rng
        given = _hanging(n, rng) if hung else Rotation.random(n, rng=rng)
        true = (given * Rotation.from_rotvec(np.deg2rad(TURN_DEG) * rng.normal(size=(n, 3)))).as_matrix()
        u = self.gravity @ true
        M, s = sum(m for m, _ in masses), sum((m * p for m, p in masses), np.zeros(3))
        w = np.concatenate([M * u, np.cross(s, u)], axis=1)
        y = self.read(w)
        sensed = np.concatenate([part @ self.R_flange_sensor for part in np.split(w, 2, axis=1)], axis=1)
        y[1:] -= self.hysteresis * np.diff(sensed, axis=0)
        y += np.repeat([3.0, 0.2], 3) * rng.normal(size=6) + np.cumsum(WALK * rng.normal(size=(n, 6)), axis=0)
        y = np.asarray(y + NOISE * rng.normal(size=(n, 6)), dtype=np.float64)
        cov = np.tile(np.diag(NOISE**2), (n, 1, 1))
        return CalibrationDataset(given.as_matrix(), y, cov, np.full(n, 2000), np.asarray(4.0 * np.arange(n)))

    def runs(self, sets: Sequence[Set]) -> list[LoadRun]:
        """Return the runs of a protocol, with loads that are not exactly as declared."""
        found = []
        for one in sets:
            masses, load = [(TOOL_KG, TOOL_COM_M)], None
            if one.place_m is not None:
                true_kg = one.mass_kg * (1 + MASS * self.rng.normal())
                true_m = one.place_m + self.origin_m + PLACE_M * self.rng.normal(size=3)
                masses.append((true_kg, true_m))
                place = tuple(one.place_m.tolist()) if one.place_known else None
                load = KnownLoad(one.name, one.mass_kg, MASS * one.mass_kg, place, PLACE_M)
            found.append(LoadRun(one.name, self.dataset(one.poses, masses, hung=one.hung), load))
        return found

    def weighed_tool_kg(self, share: float = 0.002) -> tuple[float, float]:
        """Return the mass of the tool as a scale reads it, and its sigma."""
        return TOOL_KG * (1 + share * self.rng.normal()), share * TOOL_KG

    def contacts(
        self, n: int, torque_Nm: float = 0.0, most_N: float = 100.0, place_m: Array = TIP_M
    ) -> tuple[Array, Array]:
        """Return n contacts (n, 6) of 30 to `most_N` N at a place, flange axes, and what the sensor reads of them."""
        force = _directions(n, self.rng) * self.rng.uniform(30, most_N, n)[:, None]
        torque = np.cross(place_m, force) + torque_Nm * _directions(n, self.rng)
        w = np.concatenate([force, torque], axis=1)
        return w, self.read(w)


def _directions(n: int, rng: np.random.Generator) -> Array:
    v = rng.normal(size=(n, 3))
    return np.asarray(v / np.linalg.norm(v, axis=1)[:, None])


def _hanging(n: int, rng: np.random.Generator, most_deg: float = 75.0) -> Rotation:
    """Orientations of a flange that points down, tilted by up to so much, spread evenly and turned at random."""
    tilt = np.deg2rad(most_deg) * np.sqrt((np.arange(n) + 0.5) / n)
    side = 2.399963 * np.arange(n)
    tilted = Rotation.from_rotvec(np.stack([tilt * np.cos(side), tilt * np.sin(side), 0 * tilt], axis=1))
    about = Rotation.from_euler("z", rng.uniform(-np.pi, np.pi, (n, 1)))
    return tilted * Rotation.from_rotvec([np.pi, 0, 0]) * about


TOOL = Set("tool")
GRIP_M, HIGHER_M = np.array([0.02, -0.01, 0.2]), np.array([0.02, -0.01, 0.15])
_SHIFT_M = np.array([0.06, 0, 0])
PROTOCOLS: dict[str, tuple[Set, ...]] = {
    "rigid, tip": (TOOL, Set("tip", 24, 2.0, TIP_M)),
    "rigid, side and tip": (TOOL, Set("side", 24, 2.0, SIDE_M), Set("tip", 24, 2.0, TIP_M)),
    "hung, tip": (TOOL, Set("tip", 12, 2.0, TIP_M, hung=True)),
    "hung, side and tip": (TOOL, Set("side", 12, 2.0, SIDE_M, hung=True), Set("tip", 12, 2.0, TIP_M, hung=True)),
    "hung, 2 sides and tip": (
        TOOL,
        Set("side", 12, 2.0, SIDE_M, hung=True),
        Set("other", 12, 2.0, OTHER_M, hung=True),
        Set("tip", 12, 2.0, TIP_M, hung=True),
    ),
    "bar, gripped twice": (
        TOOL,
        Set("grip", 6, 2.0, GRIP_M, place_known=False),
        Set("shifted", 6, 2.0, GRIP_M + _SHIFT_M, place_known=False),
    ),
    "bar, gripped 50 mm above": (
        TOOL,
        Set("grip", 6, 2.0, HIGHER_M, place_known=False),
        Set("shifted", 6, 2.0, HIGHER_M + _SHIFT_M, place_known=False),
    ),
}
"""Of the note on known loads, section 6, and a bar that is held above the place of the contact."""


def with_load(runs: Sequence[LoadRun], row: int, **changed: object) -> list[LoadRun]:
    """Return the runs with another declaration of one load."""
    found = list(runs)
    load = found[row].load
    assert load is not None
    found[row] = replace(found[row], load=replace(load, **changed))  # type: ignore[arg-type]
    return found
