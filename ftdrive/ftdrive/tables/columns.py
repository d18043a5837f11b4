"""Recognition of the signals in a table (time, wrench, orientation) and their units by the names of the columns."""

import re
from collections.abc import Iterator, Mapping, Sequence
from difflib import get_close_matches
from itertools import product
from typing import Final, NamedTuple

from ftcalib.data.dataset import shorten_list
from ftcalib.errors import BadDataset
from ftcalib.judge.units import FORCE_UNITS_N, TORQUE_UNITS_NM
from ftcalib.model import STANDARD_GRAVITY_M_S2

_DEG = 0.017453292519943295
# Factors to SI units by quantity and unit; units are written without spaces, dots, `·`, `*`, `-` and `^`.
UNITS: Final[Mapping[str, Mapping[str, float]]] = {
    "time": {"s": 1.0, "sec": 1.0, "secs": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9},
    "force": {**FORCE_UNITS_N, "kg": FORCE_UNITS_N["kgf"], "lb": FORCE_UNITS_N["lbf"]},
    "torque": {
        **{unit.replace("·", ""): size for unit, size in TORQUE_UNITS_NM.items()},
        "mNm": 1e-3,
        "Ncm": 1e-2,
        "kgfmm": TORQUE_UNITS_NM["kgf·m"] / 1e3,
        **dict.fromkeys(("lbin", "inlb"), TORQUE_UNITS_NM["lbf·in"]),
    },
    "length": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254},
    "angle": {"rad": 1.0, "deg": _DEG, "degree": _DEG, "degrees": _DEG, "°": _DEG},
    "acceleration": {"m/s2": 1.0, "m/s²": 1.0, "g": STANDARD_GRAVITY_M_S2},
}
COUNTS: Final = ("counts", "count", "cts", "digits")
_BEHIND = re.compile(r"(?P<name>.+?)(?:\s*[\[(](?P<bracket>[^\])]*)[\])]|_(?P<suffix>[^\W_]+))\s*")
# Longest column name that is searched for a unit, because the search time grows with the square of the length.
_LONGEST_NAME = 200
_SUFFIXES: Final = frozenset(
    {*UNITS["time"], *UNITS["torque"], *COUNTS, "N", "mN", "kgf", "lbf", "mm", "cm", "m", "deg", "rad"}
)


class Layout(NamedTuple):
    """Names that one program gives to the columns of its tables."""

    program: str
    signals: Mapping[str, str]
    """Alternative lists of column names by signal, separated by `|`; the first complete list is used.

    Names are in lower case, with `_` for every character that is not a letter or a digit. `?` means x, y, z; `#` means
    0 to 5; `*` is any prefix that is the same in all names of a list.
    """


_UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
# Column names of each program. If several programs match a table, the one with the most matching columns has priority.
LAYOUTS: Final = (
    Layout(
        "ftdrive",
        {
            "time": "t",
            "wrench": "f? t?",
            "matrix": "r11 r12 r13 r21 r22 r23 r31 r32 r33",
            "quaternion": "q? qw",
            "vector": "r?",
            "position": "?",
            "joints": "q1 q2 q3 q4 q5 q6 | q0 q1 q2 q3 q4 q5",
            "gravity": "g?",
            "sigma": "sigma_f? sigma_t?",
        },
    ),
    Layout(
        "own program",
        {
            "time": "time | timestamp | time_stamp | elapsed | elapsed_time | x_value | zeit",
            "wrench": "f? m? | f_? t_? | f_? m_? | force_? torque_? | force_? moment_? | force? torque? | "
            "force? moment? | wrench_f? wrench_t? | f1 f2 f3 t1 t2 t3 | f1 f2 f3 m1 m2 m3 | kraft_? moment_? | "
            "kraft_? drehmoment_?",
            "quaternion": "q_? q_w | quat_? quat_w | quaternion_? quaternion_w | ori_? ori_w | "
            "orientation_? orientation_w",
            "matrix": "r_11 r_12 r_13 r_21 r_22 r_23 r_31 r_32 r_33 | r00 r01 r02 r10 r11 r12 r20 r21 r22",
            "vector": "rotvec_? | rot_vec_? | rv?",
            "rpy": "roll pitch yaw",
            "angles": "euler_? | angle_? | rot_? | alpha beta gamma",
            "position": "p? | p_? | pos? | pos_? | position_? | tcp_?",
            "joints": "j1 j2 j3 j4 j5 j6 | joint1 joint2 joint3 joint4 joint5 joint6 | joint# | q_# | joint_# | "
            "joint_1 joint_2 joint_3 joint_4 joint_5 joint_6 | q_1 q_2 q_3 q_4 q_5 q_6",
            "acceleration": "a? | acc_? | accel_? | acceleration_?",
        },
    ),
    Layout(
        "rostopic echo -p",
        {
            "time": "field_header_stamp | time",
            "wrench": "field_wrench_force_? field_wrench_torque_?",
            "quaternion": "field_pose_orientation_? field_pose_orientation_w | "
            "field_transform_rotation_? field_transform_rotation_w",
            "position": "field_pose_position_? | field_transform_translation_?",
            "joints": "field_position#",
        },
    ),
    Layout(
        "ROS topics",
        {
            "time": "*header_stamp_secs *header_stamp_nsecs | *header_stamp_sec *header_stamp_nanosec | "
            "*header_stamp | *stamp | secs nsecs | sec nanosec | time | timestamp | receive_time",
            "wrench": "*force_? *torque_?",
            "quaternion": "*orientation_? *orientation_w | *rotation_? *rotation_w",
            "position": "*position_? | *translation_?",
            "joints": " ".join(f"*{joint}_joint_position" for joint in _UR_JOINTS)
            + " | "
            + " ".join(f"*{joint}_joint" for joint in _UR_JOINTS),
            "acceleration": "*linear_acceleration_?",
        },
    ),
    Layout(
        "RTDE record",
        {
            "time": "timestamp",
            "flange_wrench": "ft_raw_wrench_#",
            "base_wrench": "actual_tcp_force_#",
            "tcp_pose": "actual_tcp_pose_#",
            "joints": "actual_q_#",
        },
    ),
    Layout(
        "KUKA", {"abc": "a b c | *rist_a *rist_b *rist_c | *pos_a *pos_b *pos_c", "position": "? | *rist_? | *pos_?"}
    ),
    Layout("xArm", {"rpy": "*roll *pitch *yaw", "position": "?"}),
    Layout("Fanuc", {"wpr": "w p r", "position": "?"}),
    Layout("Kawasaki", {"oat": "o a t", "position": "?"}),
    Layout("ABB", {"quaternion_w_first": "*q1 *q2 *q3 *q4", "position": "?"}),
    Layout("Franka", {"transform": " ".join(f"o_t_ee_{i}" for i in range(16)), "wrench": "k_f_ext_hat_k_#"}),
    Layout(
        "MuJoCo",
        {
            "wrench": "force_0 force_1 force_2 torque_0 torque_1 torque_2",
            "quaternion_w_first": "quat_0 quat_1 quat_2 quat_3 | quat_w quat_x quat_y quat_z",
            "position": "pos_0 pos_1 pos_2 | pos_?",
        },
    ),
    Layout("netft", {"time": "elapsed_seconds", "wrench": "f? t?"}),
)


class Signal(NamedTuple):
    """The columns of a table that contain one signal."""

    form: str
    program: str
    columns: Sequence[int]
    units: Sequence[str]
    """Unit of each column as written in the header; empty if the header has none."""


class SignalColumns:
    """The columns of a table by signal.

    Parameters
    ----------
    names, units : sequence of str
        Names and units of the header; if a unit is empty, it may be part of the name.
    given : mapping, optional
        Columns of the file, by their names in ftdrive: ``{"fx": "Force X [N]", "t": "1"}``.
    in_memory : bool
        Whether the table is in memory; messages then show Python code instead of a command option.

    Raises
    ------
    BadDataset
        A given column does not exist.
    """

    def __init__(
        self,
        names: Sequence[str],
        units: Sequence[str],
        given: Mapping[str, str] | None = None,
        *,
        in_memory: bool = False,
    ) -> None:
        self.names = names
        self._in_memory = in_memory
        self._keys: dict[str, list[tuple[int, str]]] = {}
        taken = set[int]()
        for key, column in (given or {}).items():
            if key not in _OWN_KEYS:
                raise BadDataset(f"--columns {key}={column}: {key} is unknown; the names are {', '.join(_OWN_KEYS)}")
            index, unit = self._find(key, column)
            taken.add(index)
            self._keys[key] = [(index, unit or units[index])]
        for index, (name, unit) in enumerate(zip(names, units, strict=True)):
            for key, of_name in _keys_of(name) if name and index not in taken else ():
                if key not in (given or {}):
                    self._keys.setdefault(key, []).append((index, unit or of_name))
        ranked = [(self._matched(layout), -rank, layout) for rank, layout in enumerate(LAYOUTS)]
        self._layouts = [layout for *_, layout in sorted(ranked, reverse=True, key=lambda one: one[:2])]

    def find(self, *signals: str) -> Signal | None:
        """Return the first of `signals` in the table, else None. Raises `BadDataset` if two sets of columns match."""
        two, line = list[str](), ""
        for layout, signal in product(self._layouts, signals):
            for way in layout.signals.get(signal, "").split("|"):
                candidates = self._complete(way)
                if len(candidates) == 1:
                    columns, units = zip(*candidates[0], strict=True)
                    return Signal(signal, layout.program, columns, units)
                if candidates and not two:
                    two = [self.names[one[0][0]] for one in candidates]
                    line = self.line(signal)
        if two and signals != ("time",):  # two time columns are no error: each topic has stamps
            raise BadDataset(f"two candidates, {' and '.join(two[:2])}. Name the columns: {line}")
        return None

    def begins(self, signal: str) -> bool:
        """Return whether the table has at least one column of a signal."""
        return any(self._nearest(layout, signal)[0] for layout in LAYOUTS if signal in layout.signals)

    def missing(self, what: str, *signals: str) -> str:
        """Return a message about a missing signal: existing columns, most similar known layout, and line to type."""
        near = (self._nearest(layout, one) for layout in LAYOUTS for one in signals if one in layout.signals)
        share, program, missing, signal = max(near, key=lambda one: one[0])
        nearest = f" The layout of {program} lacks {', '.join(missing)}." if share else ""
        named = shorten_list([name for name in self.names if name])
        if "wrench" in signals and set(missing) == {"tx", "ty", "tz"}:
            nearest += " A three-axis sensor measures no torque and is not supported."
        return f"no {what} among the columns {named}.{nearest} Name the columns: {self.line(signal)}"

    def line(self, signal: str) -> str:
        """Return the option, or argument in Python, to name a signal's columns, filled in as far as recognised."""
        parts = {}
        for key in OWN_NAMES[signal].split():
            found = self._keys.get(key) or self._keys.get(_OTHER_NAMES.get(key, key))
            close = get_close_matches(key, self._keys, 1, 0.9)
            index = (found or (self._keys[close[0]] if close else [(-1, "")]))[0][0]
            parts[key] = self.names[index] if index >= 0 else "…"
        if self._in_memory:
            return f"table=ftdrive.TableOptions(columns={parts})"
        return f'--columns "{",".join(f"{key}={name}" for key, name in parts.items())}"'

    def _find(self, key: str, column: str) -> tuple[int, str]:
        """Return the index and the unit of a column given by name or number."""
        column, unit = column.strip(), ""
        if column not in self.names and (match := re.fullmatch(r"(.+?)\s*\[([^\]]*)\]", column)):
            column, unit = match[1], match[2]
        same = [i for i, name in enumerate(self.names) if name == column]
        same = same or [i for i, name in enumerate(self.names) if _normalized(name) == _normalized(column)]
        if not same and column.isdecimal() and 1 <= int(column) <= len(self.names):
            same = [int(column) - 1]
        if len(same) != 1:
            why = "two columns have this name" if same else f"the columns are {shorten_list(self.names)}"
            raise BadDataset(f"--columns {key}={column}: {why}: give the name of a column, or its number from 1")
        return same[0], unit or [unit for _, unit in _keys_of(self.names[same[0]])][-1]

    def _complete(self, way: str) -> list[list[tuple[int, str]]]:
        """Return each set of columns, as index and unit, whose names match all in `way`, for each common prefix."""
        if not (patterns := _written_out(way)):
            return []
        first = patterns[0].removeprefix("*")
        prefixes = [""]
        if patterns[0].startswith("*"):
            prefixes = [
                key[: -len(first)]
                for key in self._keys
                if key.endswith(first) and (key[: -len(first)] or "_")[-1] == "_"
            ]
        complete = []
        for prefix in prefixes:
            keys = [prefix + word[1:] if word.startswith("*") else word for word in patterns]
            if all(key in self._keys for key in keys):
                columns = self._of_one_case([self._keys[key] for key in keys])
                complete += [[one[min(i, len(one) - 1)] for one in columns] for i in range(max(map(len, columns)))]
        return complete

    def _of_one_case(self, columns: Sequence[list[tuple[int, str]]]) -> list[list[tuple[int, str]]]:
        """Prefer columns in the letter case of the others, so that next to O and A, T is an angle and t is a time."""
        upper = [self.names[one[0][0]].isupper() for one in columns if len(one) == 1] or [False]
        chosen = [[each for each in one if self.names[each[0]].isupper() == all(upper)] for one in columns]
        return [one if len(every) > 1 and one else list(every) for one, every in zip(chosen, columns, strict=True)]

    def _matched(self, layout: Layout) -> int:
        return sum(
            max((len(_written_out(way)) for way in ways.split("|") if self._complete(way)), default=0)
            for ways in layout.signals.values()
        )

    def _has(self, word: str) -> bool:
        if word.startswith("*"):
            return any(f"_{key}".endswith(f"_{word[1:]}") for key in self._keys)
        return word in self._keys

    def _nearest(self, layout: Layout, signal: str) -> tuple[float, str, Sequence[str], str]:
        nearest: tuple[float, str, Sequence[str], str] = (0.0, layout.program, (), signal)
        for way in layout.signals[signal].split("|"):
            keys = _written_out(way)
            missing = [word.removeprefix("*") for word in keys if not self._has(word)]
            nearest = max(
                nearest, (1 - len(missing) / len(keys), layout.program, missing, signal), key=lambda one: one[0]
            )
        return nearest


# ftdrive's own names for the columns of each signal, as in the option `--columns`.
OWN_NAMES: Final = {
    "time": "t",
    "wrench": "fx fy fz tx ty tz",
    "base_wrench": "fx fy fz tx ty tz",
    "matrix": "r11 r12 r13 r21 r22 r23 r31 r32 r33",
    "transform": "r11 r12 r13 r21 r22 r23 r31 r32 r33",
    "quaternion": "qx qy qz qw",
    "quaternion_w_first": "qw qx qy qz",
    "vector": "rx ry rz",
    "tcp_pose": "x y z rx ry rz",
    "rpy": "roll pitch yaw",
    "abc": "a b c",
    "wpr": "w p r",
    "oat": "o a t",
    "angles": "rx ry rz",
    "position": "x y z",
    "joints": "q1 q2 q3 q4 q5 q6",
    "gravity": "gx gy gz",
    "acceleration": "ax ay az",
    "sigma": "sigma_fx sigma_fy sigma_fz sigma_tx sigma_ty sigma_tz",
}
_OWN_KEYS: Final = tuple(dict.fromkeys(" ".join(OWN_NAMES.values()).split()))
_OTHER_NAMES: Final = {"tx": "mx", "ty": "my", "tz": "mz", "t": "time"}


def _normalized(name: str) -> str:
    """Return a column name in lower case, with `_` for characters that are neither letters nor digits."""
    return re.sub(r"[\W_]+", "_", name.lower()).strip("_")


def factor(unit: str, kind: str, column: str) -> float | None:
    """Return the factor from a unit to SI; None if `unit` is empty. Raises `BadDataset` unless it is a unit of `kind`.

    The unit may begin with a number: `.82 N` corrects the scale of a sensor that was checked with a known mass.
    """
    if size := re.fullmatch(r"(\d*\.?\d+(?:e[+-]?\d+)?)\s+(\S.*)", unit.strip()):
        return float(size[1]) * (factor(size[2], kind, column) or 1.0)
    text = re.sub(r"[\s.·*^-]", "", unit)
    if not text or text.lower() in COUNTS:
        return None if not text else 1.0
    of_kind = UNITS[kind]
    lower = {name.lower(): value for name, value in of_kind.items() if name != "mN"}
    size_SI = of_kind.get(text, lower.get(text.lower()))
    if size_SI is None:
        known = ", ".join(of_kind)
        raise BadDataset(
            f"column '{column}' has the unit {unit}, which is not a unit of {kind} ({known}). Give the right unit: "
            f'--columns "…={column} [{next(iter(of_kind))}]"'
        )
    return size_SI


def _keys_of(name: str) -> Iterator[tuple[str, str]]:
    """Split a column name such as `fx [N]`, `t_ms` or `x (mm)`: yield each possible normalized name with its unit."""
    match = _BEHIND.fullmatch(name) if len(name) <= _LONGEST_NAME else None
    if match and match["bracket"] is not None and re.search(r"[^\W\d]|°|^$", match["bracket"]):
        yield _normalized(match["name"]), match["bracket"].strip()
        return
    yield _normalized(name), ""
    if match and match["suffix"] in _SUFFIXES:
        yield _normalized(match["name"]), match["suffix"]


def _written_out(way: str) -> list[str]:
    """Return the names in one list of a `Layout`, with `?` expanded to x, y, z and `#` to 0 to 5."""
    marks = {"?": "xyz", "#": "012345"}
    return [
        word.replace(mark, letter) if mark else word
        for word in way.split()
        for mark in [next((mark for mark in marks if mark in word), "")]
        for letter in (marks[mark] if mark else " ")
    ]
