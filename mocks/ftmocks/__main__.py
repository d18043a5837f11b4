"""Command line: ``python -m ftmocks station``."""

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

from ftmocks.arrays import Array
from ftmocks.imperfections import Imperfections
from ftmocks.kinematics import MODELS
from ftmocks.sensor_errors import CROSS_TALK_PERCENT, GAIN_PERCENT
from ftmocks.sensors.catalogue import CHOICES, KINDS
from ftmocks.station import Station, parse_vector
from ftmocks.workcell import SWING_DEG
from ftmocks.world import MOUNTS_RAD


def _vector(length: int) -> Callable[[str], Array]:
    def numbers(text: str) -> Array:
        try:
            return parse_vector(text, length)
        except ValueError as error:
            raise argparse.ArgumentTypeError(str(error)) from error

    return numbers


def _version(text: str) -> tuple[int, int, int]:
    try:
        major, minor, bugfix = (int(part) for part in [*text.split("."), "0", "0"][:3])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"not a version: {text!r}") from error
    return major, minor, bugfix


def _plane(text: str) -> tuple[float, float, float, float]:
    a, b, c, d = _vector(4)(text).tolist()
    return a, b, c, d


def _positive(text: str) -> float:
    value = float(text)
    if not value > 0.0:
        raise argparse.ArgumentTypeError(f"{text} is not positive")
    return value


def _not_negative(text: str) -> float:
    value = float(text)
    if not 0.0 <= value < math.inf:
        raise argparse.ArgumentTypeError(f"{text} is negative or not finite")
    return value


def _load(text: str) -> dict[str, object]:
    mass, sign, place = text.partition("@")
    if not sign:
        raise argparse.ArgumentTypeError(f"a load is KG@x,y,z, not {text!r}")
    return {"mass_kg": _positive(mass), "at_mm": _vector(3)(place).tolist()}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m ftmocks", description="Emulated robot cells.", allow_abbrev=False)
    station = parser.add_subparsers(dest="what", required=True).add_parser(
        "station",
        allow_abbrev=False,
        help="one arm and one wrist sensor",
        description="One UR controller and one wrist force/torque sensor in one process. Prints one JSON line when "
        "everything listens; ends when standard input closes. Vectors are numbers separated by commas.",
    )
    add = station.add_argument
    add("--seed", type=int, default=0, help="seed of the truth below, the noise and the start posture (default 0)")
    add("--host", help="loopback address to listen on (default: a free 127.x.y.z)")
    add("--time-scale", type=_positive, default=1.0, metavar="K", help="the arm moves K times faster than real")
    add("--sensor", choices=CHOICES, default="can", metavar="NAME", help=f"{', '.join(CHOICES)} (default can)")
    add(
        "--sensor-setting",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="; ".join(f"{name}: {', '.join(kind.settings)}" for name, kind in KINDS.items() if kind.settings),
    )
    add(
        "--imperfections",
        default="",
        metavar="NAME=VALUE,…",
        help="imperfections of a real cell that the model lacks; none turns all of them off; "
        + ", ".join(f"{field.name} ({field.default:g})" for field in fields(Imperfections)),
    )
    add("--sensor-delay-ms", type=float, metavar="D", help="time between the measurement of a sample and its sending")
    add("--rtde-delay-ms", type=float, metavar="D", help="the same for the samples of the arm")
    add("--recording", type=Path, metavar="FILE.csv", help="serve the raw wrench and the joints of a recording")
    add(
        "--load",
        type=_load,
        metavar="KG@x,y,z",
        help="a load that hangs from a 250 mm string; the position of its hook, flange axes, mm",
    )
    add(
        "--swing",
        type=_not_negative,
        default=SWING_DEG,
        metavar="DEG",
        help=f"swing of a load after it is hung (default {SWING_DEG:g})",
    )
    add("--pace", type=_not_negative, metavar="K", help="play FILE.csv K times faster (default 1; 0: hold its start)")
    add("--do", action="append", default=[], metavar="JSON", help="a first request of the control channel")

    arm = station.add_argument_group("arm")
    add = arm.add_argument
    add("--model", choices=sorted(MODELS), help="default UR5e, UR5 with PolyScope 3")
    add(
        "--polyscope",
        type=_version,
        default=(5, 15, 0),
        metavar="X.Y.Z",
        help="software version (default 5.15.0; 10: PolyScope X)",
    )
    add("--no-tcp-offset", action="store_true", help="answer NOT_FOUND to the RTDE output tcp_offset")
    add("--serial-number", default="20225500001")
    add("--tcp", type=_vector(6), default=[0.0] * 6, metavar="x,y,z,rx,ry,rz", help="active TCP, m and rad")
    add("--payload", type=float, metavar="kg", help="payload set in the controller (default: tool and sensor)")
    add("--payload-cog", type=_vector(3), metavar="x,y,z", help="its centre of mass in the flange frame, m")
    add("--start-q-deg", type=_vector(6), metavar="q1,…,q6", help="start posture (default near the tour's first pose)")
    add("--joint-limit-deg", type=_positive, default=360.0)
    add("--plane", type=_plane, metavar="nx,ny,nz,d", help="safety plane in base: n·p >= d (m) is allowed")
    add(
        "--kinematics",
        default="drawn",
        metavar="drawn|ideal|FILE.json",
        help="factory calibration: random as in real arms, none, or from a file with model, theta, a, d, alpha",
    )
    add(
        "--kinematics-message",
        choices=("true", "none", "wrong"),
        default="true",
        help="kinematics that the primary interface sends; wrong: that of another arm of the same model (default true)",
    )

    truth = station.add_argument_group("truth (each overrides what the seed draws)")
    add = truth.add_argument
    add("--mass", type=float, metavar="kg")
    add("--com", type=_vector(3), metavar="x,y,z", help="centre of mass in the sensor frame, m")
    add(
        "--inertia",
        metavar="ixx,iyy,izz,ixy,ixz,iyz",
        help="inertia tensor about the centre of mass, sensor axes, kg·m²; zeros for a point mass; "
        "'none': the payload has weight, but no inertia",
    )
    add(
        "--sensor-origin", type=_vector(3), metavar="x,y,z", help="sensor origin in the flange frame, m (default 0,0,0)"
    )
    add(
        "--sensor-mass-kg",
        type=_not_negative,
        metavar="kg",
        help="sensor and adapter, halfway between flange and sensor origin (default 0.25; 0 for ur-ft)",
    )
    add("--sensor-rotvec-deg", type=_vector(3), metavar="x,y,z", help="R_flange_sensor as a rotation vector, degrees")
    add("--mount", choices=sorted(MOUNTS_RAD), default="floor")
    add("--tilt-deg", type=_vector(2), metavar="alpha,beta", help="tilt of the base; beta counts from the mount")
    add("--force-bias", type=_vector(3), metavar="x,y,z", help="N")
    add("--torque-bias", type=_vector(3), metavar="x,y,z", help="N·m")
    add("--noise", type=_vector(2), metavar="sF,sT", help="standard deviation of one reading, N and N·m")
    add(
        "--gain",
        type=_not_negative,
        metavar="PERCENT",
        help=f"errors of the sensor's gains, one sigma (default {GAIN_PERCENT:g})",
    )
    add(
        "--cross-talk",
        type=_not_negative,
        metavar="PERCENT",
        help=f"cross-talk between its axes, one sigma, of the ranges (150 N, 10 N·m) (default {CROSS_TALK_PERCENT:g})",
    )
    add(
        "--nonlinear",
        type=_not_negative,
        default=0.0,
        metavar="PERCENT",
        help="quadratic and cubic error at the end of the range",
    )
    add("--force-drift", type=_vector(3), metavar="x,y,z", help="N per minute (default 0)")
    add("--torque-drift", type=_vector(3), metavar="x,y,z", help="N·m per minute (default 0)")
    return parser


def main() -> int:
    """Run the command that the command line requests and return the exit code."""
    parser = _parser()
    options = parser.parse_args()
    try:
        station = Station(options)
    except ValueError as error:
        parser.error(str(error))
    except OSError as error:
        sys.stderr.write(f"cannot listen: {error}\n")
        return 3
    return station.run()


if __name__ == "__main__":
    sys.exit(main())
