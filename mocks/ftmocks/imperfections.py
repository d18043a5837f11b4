"""Imperfections of a real arm and its sensors: vibration, noise, delay, friction. Their sizes are settings.

Sources: sizes and spectrum of the ripple are those of a recording of an LBR with .93 kg on an ATI Gamma, which turns
at .78 rad/s. It has 1.4, .6 and .4 N rms on x, y and z, at rest only noise. Its peaks at 40, 80 and 120 Hz move with
the speed, as ``sin(k N q)`` does with the gear ratio N and k = 2, 4, 6. Less than 3 % of the power lie below 3 Hz, and
the torques are those of a force at the centre of mass. Wrists of Universal Robots ring at 8 to 20 Hz for .3 s after a
stop. Their joint angles have 1e-5 to 3e-5 rad of noise, and their joints follow some ms behind the set-point. Friction
of wrist 3 adds .15 N·m to the z torque of the built-in sensor. In a UR5e its raw zero drifts by 7 N in z within 10
minutes after a start, fastest at first.

Chosen here, where the sources are silent:

* The gear ratio is 101. The shares of k = 2, 4, 6 in the power are 60, 30 and 10 %.
* The ripple is an acceleration of the tool along the axes of the sensor, whatever the tool's mass. It has its full size
  however many joints rotate, shared according to their speeds. Below .3 rad/s, the ripple of a joint decreases with the
  square of its speed, as does the acceleration due to a position error of a gear.
* Each joint rings behind its encoder, as a mass on a spring that follows the joint. The seed determines the frequency.
* The noise of joint angles is white, also at rest; joint speeds have none.
* The sensor's delay is that of its filter, 3 ms. The wires of the emulated cell add their own delay and jitter.
* Friction opposes the turn. The drift is exponential with a time constant of 3 minutes and affects no torque. With
  this sensor, an arm starts with its station. Other arms were started long ago, unless `wrist_drift_N` is set.
* The ripple does not shake the sensor's own mass.
"""

import math
from dataclasses import dataclass, fields, replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ftmocks.arrays import Array
from ftmocks.kinematics import Vector6

RIPPLE_M_S2 = (1.5, 0.7, 0.45)
"""RMS acceleration of the ripple on the axes of the sensor, m/s²."""
HARMONICS, POWERS = (2, 4, 6), (0.6, 0.3, 0.1)
FULL_SPEED_RAD_S = 0.3
RING_HZ = (8.0, 20.0)
RING_DECAY_S = 0.1
"""Time constant with which links stop ringing, s: 5 % remain after 0.3 s."""
RUNG_OUT_RAD_S2 = 1e-3
FRICTION_RAD_S = 0.01
"""Approximate joint speed above which friction has its full size, rad/s."""
DRIFT_S, DRIFT_TIME_CONSTANT_S = 600.0, 180.0
WRIST_DRIFT_N = 7.0


@dataclass(frozen=True)
class Imperfections:
    """Sizes of the imperfections. The defaults are those of a real cell; `IDEAL` has no imperfections.

    Parameters
    ----------
    ripple, ring
        Vibration while joints rotate, and after they accelerate, as multiples of this module's sizes.
    gear_ratio
        Revolutions of the motor per revolution of the joint.
    servo_lag_s
        Time constant with which the joints follow the set-point. An ideal cell has it too.
    joint_noise_rad
        Standard deviation of the joint angles that the controller reports.
    wrench_delay_s
        Time between measuring and sending a sample, in addition to the delay of the link.
    wrist_friction_Nm
        Friction of wrist 3 in the readings of the built-in sensor.
    wrist_drift_N
        Drift of the built-in sensor along z in the first 10 minutes.
    """

    ripple: float = 1.0
    ring: float = 1.0
    gear_ratio: float = 101.0
    servo_lag_s: float = 0.005
    joint_noise_rad: float = 2e-5
    wrench_delay_s: float = 0.003
    wrist_friction_Nm: float = 0.15
    wrist_drift_N: float = 0.0

    def changed(self, text: str) -> Self:
        """Return settings changed by ``name=value,…``; "none" selects those of `IDEAL`.

        Raises
        ------
        ValueError
            A name is unknown, or a value is negative or not a number.
        """
        changes: dict[str, float] = {}
        for part in text.split(",") if text else ():
            name, sign, value = part.partition("=")
            if part == "none":
                changes = {field.name: getattr(IDEAL, field.name) for field in fields(self)}
            elif not sign or name not in {field.name for field in fields(self)}:
                known = ", ".join(field.name for field in fields(self))
                raise ValueError(f"{part!r} is not a setting of a real cell: give none, or NAME=VALUE with {known}")
            else:
                changes[name] = float(value)
        if not all(0.0 <= value < math.inf for value in changes.values()) or changes.get("servo_lag_s") == 0.0:
            raise ValueError(f"settings must not be negative, and servo_lag_s must be positive: {text!r}")
        return replace(self, **changes)


IDEAL = Imperfections(
    ripple=0.0, ring=0.0, joint_noise_rad=0.0, wrench_delay_s=0.0, wrist_friction_Nm=0.0, wrist_drift_N=0.0
)


class WarmUp(NamedTuple):
    """Drift of the built-in sensor after the arm was started: `drift_N` along z within 10 minutes."""

    drift_N: float
    start_s: float

    def at(self, now_s: float) -> Array:
        """Return the current drift (6,), N and N·m, in flange axes."""
        done, whole = (-math.expm1(-s / DRIFT_TIME_CONSTANT_S) for s in (now_s - self.start_s, DRIFT_S))
        return np.array([0.0, 0.0, self.drift_N * done / whole, 0.0, 0.0, 0.0])


class Ripple:
    """Vibration of the tool, caused by the gears of rotating joints. `seed` draws the phases."""

    def __init__(self, settings: Imperfections, seed: int) -> None:
        self._orders = settings.gear_ratio * np.array(HARMONICS)
        phases = np.random.default_rng([seed, 7]).uniform(0.0, 2 * np.pi, (6, len(HARMONICS), 3))
        sizes = settings.ripple * np.sqrt(2.0 * np.array(POWERS))[:, None] * RIPPLE_M_S2
        self._waves = (sizes * np.exp(1j * phases)).reshape(-1, 3)

    def at(self, q_rad: Array, qd_rad_s: Array) -> Array:
        """Return accelerations (n, 3) of the tool in sensor axes, m/s², for joint angles and speeds (n, 6)."""
        speed = np.linalg.norm(qd_rad_s, axis=1, keepdims=True)
        shares = qd_rad_s / np.maximum(speed, 1e-12) * -np.expm1(-((qd_rad_s / FULL_SPEED_RAD_S) ** 2))
        turns = np.exp(1j * q_rad[:, :, None] * self._orders) * shares[:, :, None]
        return np.asarray((turns.reshape(len(q_rad), -1) @ self._waves).real)


class Ringing(NamedTuple):
    """State of ringing links after a control cycle. Each link is a mass on a spring behind its joint.

    The deflection from the quasi-static one is the real part of ``amplitudes exp(rates t)``.

    Parameters
    ----------
    rates
        (6,) complex eigenvalues, 1/s.
    size
        Factor on the acceleration of the joints.
    amplitudes
        (6,) complex amplitudes, rad; None while the links are at rest.
    held_rad
        (6,) quasi-static deflection due to the acceleration of the joints.
    """

    rates: NDArray[np.complex128]
    size: float
    amplitudes: NDArray[np.complex128] | None = None
    held_rad: Array | float = 0.0

    @classmethod
    def at_rest(cls, settings: Imperfections, seed: int) -> "Ringing":
        """Return the state of links that do not ring."""
        hertz = np.random.default_rng([seed, 8]).uniform(*RING_HZ, 6)
        rates = np.empty(6, np.complex128)
        rates.real, rates.imag = -1.0 / RING_DECAY_S, 2 * np.pi * hertz
        return cls(rates, settings.ring)

    def at(self, t: float) -> Array:
        """Return the acceleration (6,) of the links relative to their joints after `t` seconds, rad/s²."""
        if self.amplitudes is None:
            return np.zeros(6)
        return np.asarray((self.amplitudes * self.rates**2 * np.exp(self.rates * t)).real)

    def after(self, t: float, qdd: Vector6) -> "Ringing":
        """Return the state after `t` seconds, from where the joints accelerate by `qdd` (rad/s²)."""
        if self.size == 0.0 or (self.amplitudes is None and not any(qdd)):
            return self
        held = -self.size * np.array(qdd) / np.abs(self.rates) ** 2
        moved = (self.held_rad - held) * (
            1.0 + 1j * self.rates.real / self.rates.imag
        )  # so that the speed of the link does not jump
        amplitudes = moved if self.amplitudes is None else moved + self.amplitudes * np.exp(self.rates * t)
        if not any(qdd) and float(np.abs(amplitudes * self.rates**2).max()) < RUNG_OUT_RAD_S2:
            return self._replace(amplitudes=None, held_rad=0.0)
        return self._replace(amplitudes=amplitudes, held_rad=held)
