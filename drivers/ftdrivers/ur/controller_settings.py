"""Load and gravity that a controller assumes: reading them, and checking new values.

They are read over a separate connection, because they seldom change. In addition, no public document states the type of
`target_gravity`, and a wrong type would end the stream of samples.

Ref: Universal Robots, "Real-Time Data Exchange (RTDE) Guide", outputs; URScript manual, `set_target_payload`,
`set_payload`, `set_gravity`.
Checked on hardware: no.
"""

import math
from collections.abc import Sequence
from types import MappingProxyType
from typing import Final

from ftdrivers.clock import Clock
from ftdrivers.errors import DeviceTimeout, StreamBroken
from ftdrivers.interfaces import ControllerSettings
from ftdrivers.ur.rtde import Subscription

OUTPUTS: Final = MappingProxyType(
    {
        "timestamp": "DOUBLE",
        "payload": "DOUBLE",
        "payload_cog": "VECTOR3D",
        "payload_inertia": "VECTOR6D",
        "target_gravity": "VECTOR3D",
    }
)
"""Names and types of the outputs. A controller may lack any except the first."""
# Largest element of the inertia in `set_target_payload`.
_LARGEST_INERTIA_KG_M2: Final = 133.0
_RATE_HZ: Final = 125.0
_G_M_S2: Final = (8.0, 12.0)


def read_controller_settings(host: str, *, timeout_s: float, clock: Clock) -> ControllerSettings:
    """Read load and gravity once; failures raise ConnectError, DeviceTimeout, StreamBroken or ProtocolError."""
    # The connection is separate, because no source states the type of target_gravity, and a wrong type ends the
    # connection.
    stream = Subscription(host, OUTPUTS, _RATE_HZ, timeout_s=timeout_s, clock=clock)
    try:
        outputs = stream.decode(stream.read(timeout_s)[-1:])
    except TimeoutError as error:
        raise DeviceTimeout(f"{host} sent no sample within {timeout_s:.1f} s", "check the robot") from error
    except OSError as error:
        raise StreamBroken(f"the RTDE connection to {host} was lost ({error})", "check the robot and cable") from error
    finally:
        stream.close()

    def vector(name: str) -> tuple[float, ...] | None:
        return tuple(outputs[name][-1].tolist()) if name in outputs else None

    return ControllerSettings(
        mass_kg=float(outputs["payload"][-1]) if "payload" in outputs else None,
        p_flange_com_m=vector("payload_cog"),
        inertia_kg_m2=vector("payload_inertia"),
        up_base_m_s2=vector("target_gravity"),
    )


def checked_payload(
    mass_kg: float, p_flange_com_m: Sequence[float], inertia_kg_m2: Sequence[float]
) -> tuple[float, list[float], list[float]]:
    """Return mass, centre of mass and inertia as ur_rtde expects them. Raises `ValueError` if they are invalid."""
    mass, com, inertia = float(mass_kg), [*map(float, p_flange_com_m)], [*map(float, inertia_kg_m2)]
    if not 0 <= mass < math.inf:
        raise ValueError(f"mass_kg is {mass_kg}; give 0 or more.")
    if len(com) != 3 or not all(map(math.isfinite, com)):
        raise ValueError(f"p_flange_com_m is {com}; give three finite numbers in metres.")
    if len(inertia) != 6 or not all(abs(one) <= _LARGEST_INERTIA_KG_M2 for one in inertia) or min(inertia[:3]) < 0:
        raise ValueError(
            f"inertia_kg_m2 is {inertia}; give Ixx, Iyy, Izz, Ixy, Ixz, Iyz up to {_LARGEST_INERTIA_KG_M2:g} kg·m²."
        )
    if not any(com):
        com[0] = 1e-9  # the control script keeps the old centre if all three are exactly zero
    return mass, com, inertia


def checked_gravity(up_base_m_s2: Sequence[float]) -> list[float]:
    """Return gravity in the form that ur_rtde expects. Raises `ValueError` if it is invalid."""
    up = [*map(float, up_base_m_s2)]
    if len(up) != 3 or not _G_M_S2[0] <= math.hypot(*up) <= _G_M_S2[1]:
        raise ValueError(f"up_base_m_s2 is {up}; give a vector of about 9.82 m/s² that points away from the earth.")
    return up
