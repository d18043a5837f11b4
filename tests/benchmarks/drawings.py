"""The line drawings of the documentation: `uv run python -m tests.benchmarks.pictures drawings`.

Colours are of middle brightness, so that a drawing is readable on a white and on a dark page. Lengths are px.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from html import escape
from math import atan2, cos, log10, radians, sin
from pathlib import Path
from types import MappingProxyType
from typing import Literal

GREY, BLUE, ORANGE, GREEN = "#7a7f87", "#2f7fd0", "#c8791e", "#2f9e5f"
Point = tuple[float, float]
Anchor = Literal["start", "middle", "end"]


class Drawing:
    """Lines, arrows and words of one picture."""

    def __init__(self, width: int, height: int, title: str) -> None:
        self._head = (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
            f'font-family="sans-serif" font-size="13">\n<title>{escape(title)}</title>'
        )
        self._shapes: list[str] = []

    def svg(self) -> str:
        return "\n".join([self._head, *self._shapes, "</svg>", ""])

    def path(self, d: str, colour: str = GREY, *, width: float = 2, dashed: bool = False, filled: bool = False) -> None:
        dashes = ' stroke-dasharray="5 4"' if dashed else ""
        fill = colour if filled else "none"
        self._shapes.append(
            f'<path d="{d}" fill="{fill}" stroke="{colour}" stroke-width="{width:g}" stroke-linejoin="round"{dashes}/>'
        )

    def line(self, *points: Point, colour: str = GREY, width: float = 2, dashed: bool = False) -> None:
        self.path("M" + " L".join(f"{x:g},{y:g}" for x, y in points), colour, width=width, dashed=dashed)

    def arrow(self, start: Point, end: Point, colour: str = GREY, *, width: float = 2, dashed: bool = False) -> None:
        at, (x, y) = atan2(end[1] - start[1], end[0] - start[0]), end
        self.line(start, (x - 7 * cos(at), y - 7 * sin(at)), colour=colour, width=width, dashed=dashed)
        left, right = ((x - 11 * cos(at + turn), y - 11 * sin(at + turn)) for turn in (0.4, -0.4))
        self.path(
            f"M{x:g},{y:g} L{left[0]:.1f},{left[1]:.1f} L{right[0]:.1f},{right[1]:.1f} Z", colour, width=1, filled=True
        )

    def box(self, x: float, y: float, width: float, height: float, colour: str = GREY, *, round_px: float = 4) -> None:
        self._shapes.append(
            f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="{round_px:g}" fill="none" '
            f'stroke="{colour}" stroke-width="2"/>'
        )

    def titled(self, x: float, y: float, width: float, colour: str, *lines: str) -> None:
        """Draw a box around centred lines; the first is bold."""
        self.box(x, y, width, 24 + 18 * (len(lines) - 1) + 12, colour)
        self.text(x + width / 2, y + 23, *lines, colour=colour, anchor="middle", bold=True)

    def dot(self, at: Point, colour: str = GREY, *, filled: bool = True) -> None:
        fill = colour if filled else "none"
        self._shapes.append(
            f'<circle cx="{at[0]:g}" cy="{at[1]:g}" r="5" fill="{fill}" stroke="{colour}" stroke-width="2"/>'
        )

    def text(
        self, x: float, y: float, *lines: str, colour: str = GREY, anchor: Anchor = "start", bold: bool = False
    ) -> None:
        """Write lines below one another; the first may be bold."""
        for i, line in enumerate(lines):
            weight = ' font-weight="bold"' if bold and i == 0 else ""
            style = f'fill="{colour}" text-anchor="{anchor}"{weight}'
            self._shapes.append(f'<text x="{x:g}" y="{y + 18 * i:g}" {style}>{escape(line)}</text>')

    def axes(self, at: Point, directions: Iterable[tuple[str, float]], colour: str, length: float = 34) -> None:
        """Draw the axes of a frame by name and direction in degrees, 0 to the right and 90 up."""
        for name, degrees in directions:
            turn = radians(degrees)
            tip = (at[0] + length * cos(turn), at[1] - length * sin(turn))
            self.arrow(at, tip, colour)
            self.text(tip[0] + 9 * cos(turn), tip[1] - 9 * sin(turn) + 5, name, colour=colour, anchor="middle")

    @contextmanager
    def turned(self, degrees: float, about: Point) -> Iterator[None]:
        """Turn what is drawn inside, clockwise."""
        self._shapes.append(f'<g transform="rotate({degrees:g} {about[0]:g} {about[1]:g})">')
        yield
        self._shapes.append("</g>")

    def size(self, start: Point, end: Point, colour: str = GREY) -> None:
        """Draw the line of a dimension, level or upright, with a mark at each end."""
        (x, y), (u, v) = start, end
        ends = f"M{x:g},{y - 5:g} v10 M{u:g},{v - 5:g} v10" if y == v else f"M{x - 5:g},{y:g} h10 M{u - 5:g},{v:g} h10"
        self.path(f"M{x:g},{y:g} L{u:g},{v:g} {ends}", colour, width=1)


def _mount(on: Drawing, x: float, y: float, s: int = 1) -> None:
    """Draw flange and sensor around the axis x; y is the flange face, s is -1 upside down."""
    on.path(f"M{x - 26:g},{y - s * 46:g} V{y - s * 12:g} M{x + 26:g},{y - s * 46:g} V{y - s * 12:g}")
    on.box(x - 42, min(y, y - s * 12), 84, 12, round_px=2)
    on.box(x - 34, min(y, y + s * 34), 68, 34, BLUE)
    on.text(x, y + s * 17 + 5, "sensor", colour=BLUE, anchor="middle")


def _wrist(on: Drawing, x: float, y: float, *, up: bool = False) -> None:
    """Draw flange, sensor and tool. The tip is 170 px from the flange face."""
    s = -1 if up else 1
    _mount(on, x, y, s)
    on.path(f"M{x - 22:g},{y + s * 34:g} v{s * 76} h15 v{s * 60} h14 v{-s * 60} h15 v{-s * 76}")


def _hatched(x: float, y: float, right: float, down: float, count: int = 4) -> str:
    """Return the strokes that mark the solid side of a surface."""
    return "".join(f" M{x + i * right:g},{y + i * down:g} l10,-10" for i in range(count))


def frames() -> Drawing:
    """Draw base, flange, sensor, tool and every vector of a calibration and of its exports."""
    on = Drawing(880, 500, "Frames of base, flange, sensor and TCP, and the vectors between them")
    on.path("M40,450 H120 M56,450 V420 H104 V450 M68,420 V230 L180,92 H268 M92,420 V238 L192,116 H268")
    on.path("M268,84 V124 M332,84 V124 M268,84 H332", width=2)
    on.box(252, 124, 96, 12, round_px=2)
    on.box(262, 136, 76, 62, BLUE)
    on.path("M278,198 V300 H292 V380 H308 V300 H322 V270 H366 V222 H322 V198")
    on.axes((80, 420), (("x", 0), ("z", 90)), GREY, 44)
    on.text(80, 474, "base", anchor="middle", bold=True)
    on.arrow((80, 420), (297, 140), GREY, dashed=True, width=1.5)
    flange, sensor, com, load, tcp = (300.0, 136.0), (300.0, 180.0), (330.0, 252.0), (318.0, 216.0), (300.0, 380.0)
    on.arrow(flange, load, ORANGE)
    on.arrow(sensor, com, BLUE)
    on.arrow(com, (330, 330), GREEN)
    for at, colour in ((load, ORANGE), (com, BLUE)):
        on.dot(at, colour)
    on.dot(flange, filled=False)
    on.dot(sensor, BLUE, filled=False)
    on.dot(tcp)
    on.axes((214, 158), (("x", 0), ("z", -90)), GREY, 26)
    on.axes((214, 216), (("x", 25), ("z", -65)), BLUE, 26)
    on.size((244, 136), (244, 180), BLUE)
    on.size((200, 270), (200, 380))
    on.text(192, 330, "TCP", anchor="end")
    on.line((200, 136), (290, 136), width=1, dashed=True)
    on.line((200, 136), (200, 270), width=1, dashed=True)
    on.line((200, 380), (292, 380), width=1, dashed=True)
    rows = (
        (348, 130, 44, GREY, ("flange: z out of the face",
            "R_base_flange: orientation of the flange in base",
            "A UR pose is that of the TCP: ftdrive removes the TCP offset.")),
        (338, 166, 122, BLUE, ("sensor: its origin is [sensor] height_mm below the face",
            "R_flange_sensor: how the sensor is turned on the flange",
            "force_bias_N, torque_bias_Nm: sensor axes, about its origin")),
        (324, 216, 200, ORANGE, ("centre of mass of all that hangs below the flange",
            "ur-payload cog, franka center_of_mass, push:",
            "flange axes, from the flange; sensor and adapter included")),
        (336, 252, 278, BLUE, ("centre of mass of the tool: p_sensor_com_m",
            "ros2-control, admittance, kth, ft-tools, urdf, mujoco:",
            "sensor axes, from the sensor",
            "xarm: flange axes, from the sensor; mc-rtc: from the flange")),
        (330, 322, 374, GREEN, ("weight of the tool: gravity_force_base_N, base axes",
            "tilt_alpha_rad, tilt_beta_rad: how it leans from the base's z")),
        (306, 380, 434, GREY, ("TCP: the tool's working point, as the controller has it",
            "a reference point of live, record and compensate (--about tcp)")),
    )  # fmt: skip
    for x, y, row, colour, lines in rows:
        on.line((x, y), (392, row - 5), (404, row - 5), colour=colour, width=1)
        on.text(408, row, *lines, colour=colour, bold=True)
    return on


def wrench_sign() -> Drawing:
    """Draw what the sensor reads: hanging, upside down, pushed, and as the reaction."""
    on = Drawing(860, 366, "Sign of the wrench: what hangs on the sensor or pushes against it")
    for x, up in ((120, False), (330, True), (540, False), (750, False)):
        y = 220 if up else 62
        _wrist(on, x, y, up=up)
        on.axes((x - 96, y + (-17 if up else 17)), (("z", 90 if up else -90), ("x", 0)), BLUE, 28)
    for x, y in ((120, 124), (330, 104)):
        on.dot((x, y), GREEN)
        on.arrow((x, y), (x, y + 66), GREEN, width=3)
        on.text(x + 30, y + 54, "1 kg", colour=GREEN)
    for x in (540, 750):
        on.path(f"M{x - 60},234 H{x + 60}" + _hatched(x - 55, 244, 30, 0))
    on.arrow((580, 234), (580, 176), ORANGE, width=3)
    on.text(590, 200, "10 N", colour=ORANGE)
    on.arrow((750, 236), (750, 292), GREY, width=3)
    on.text(762, 276, "10 N")
    on.text(120, 318, "The tool hangs:", "Fz = +9.81 N", colour=GREEN, anchor="middle", bold=True)
    on.text(330, 318, "The tool stands:", "Fz = -9.81 N", colour=GREEN, anchor="middle", bold=True)
    on.text(540, 318, "A table pushes the tool:", "Fz = -10 N, compensated", colour=ORANGE, anchor="middle", bold=True)
    on.text(
        750,
        318,
        "The tool pushes the table:",
        "a sensor that reports this",
        "needs sign = -1",
        anchor="middle",
        bold=True,
    )
    return on


def measure() -> Drawing:
    """Draw what `init` asks to measure with ruler and scale."""
    on = Drawing(860, 470, "What to measure for init: sensor, tool and surroundings")
    _wrist(on, 270, 60)
    on.box(322, 122, 56, 50)
    on.line((292, 142), (322, 142))
    on.line((172, 60), (228, 60), width=1, dashed=True)
    on.line((190, 88), (304, 88), colour=BLUE, width=1, dashed=True)
    on.size((204, 60), (204, 88), BLUE)
    on.text(190, 24, "1. sensor height: from the", "flange face to its origin", colour=BLUE, anchor="end")
    on.line((172, 230), (262, 230), width=1, dashed=True)
    on.size((182, 60), (182, 230), ORANGE)
    on.text(170, 150, "3. tool:", "FROM 0", "TO 200", colour=ORANGE, anchor="end")
    on.size((220, 250), (320, 250), ORANGE)
    on.text(270, 270, "DIAMETER 100, with screws and cables", colour=ORANGE, anchor="middle")
    on.text(270, 290, "--tool 0:200:100", colour=ORANGE, anchor="middle", bold=True)
    on.size((270, 112), (350, 112), ORANGE)
    words = ("4. a camera beside it is a cylinder of its own:", "from 60 to 110, 50 thick, axis 45 mm towards +x")
    on.text(400, 130, *words, colour=ORANGE)
    on.text(400, 168, "--tool 60:110:50:45:0", colour=ORANGE, bold=True)
    on.line((310, 70), (390, 52), colour=BLUE, width=1)
    on.text(400, 56, "2. scale: mass of sensor and adapter, about that of the tool", colour=BLUE)
    on.text(20, 352, "5. room: from the centre of the base, along its axes", colour=GREEN, bold=True)
    on.text(20, 374, "walls and tables: side and distance, such as", "+x 800 mm, or below 20", colour=GREEN)
    on.text(20, 414, "boxes: two opposite corners", colour=GREEN)
    on.path("M520,424 V396 H560 V424 M530,396 V330 L590,270 L640,300 M550,396 V338 L592,294 L632,316")
    on.axes((540, 396), (("x", 0), ("z", 90)), BLUE, 40)
    on.path("M780,230 V436" + _hatched(780, 250, 0, 30, 7), GREEN)
    on.size((540, 380), (780, 380), GREEN)
    on.text(690, 372, "+x 800 mm", colour=GREEN, anchor="middle")
    on.path("M430,436 H780" + _hatched(440, 446, 40, 0, 9), GREEN)
    on.size((470, 424), (470, 436), GREEN)
    on.line((464, 424), (560, 424), width=1, dashed=True)
    on.text(460, 426, "below 20", colour=GREEN, anchor="end")
    return on


def run_folder() -> Drawing:
    """Draw the files of a run in the order in which they appear."""
    on = Drawing(860, 400, "The files of a run folder")
    on.text(20, 28, "runs/2026-11-20T211503Z-gripper/", bold=True)
    on.text(330, 28, "a folder for each run; nothing is overwritten")
    groups = (
        (GREY, "before the arm moves", (
            ("run.json", "devices, configuration, command line, versions"),
            ("plan.json", "joint targets, speeds, clearances"))),
        (ORANGE, "at each pose", (
            ("events.ndjson", "what happened, and who answered each question"),
            ("poses/01.npz … 25.npz", "raw samples, on disk before the next move"))),
        (BLUE, "after the last pose", (
            ("dataset.json", "means and covariances of the poses, as solved"),
            ("calibration.json", "the result: live, verify, export, push take the folder"))),
        (GREEN, "later", (
            ("report.html", "ftdrive report"),
            ("push.json", "receipt of ftdrive push, for --restore"),
            ("runs/…-verify/", "a verification has its own folder: verification.json"))),
    )  # fmt: skip
    y = 62
    for colour, when, files in groups:
        top = y - 14
        for name, content in files:
            on.line((34, y - 5), (52, y - 5), colour=colour)
            on.text(58, y, name, colour=colour, bold=True)
            on.text(250, y, content)
            y += 30
        on.line((34, top), (34, y - 35), colour=colour)
        on.path(f"M640,{top} h12 V{y - 22} h-12", colour)
        on.text(664, (top + y - 22) / 2 + 5, when, colour=colour)
        y += 16
    return on


def data_flow() -> Drawing:
    """Draw how samples become a calibration, and a calibration contact forces."""
    on = Drawing(860, 400, "From the devices to a calibration, and from a calibration to contact forces")

    on.text(20, 28, "once: calibrate", colour=BLUE, bold=True)
    on.titled(20, 50, 130, GREY, "arm", "pose, 500 Hz")
    on.titled(20, 120, 130, GREY, "sensor", "raw wrench")
    on.titled(210, 85, 130, BLUE, "calibrate", "24 poses")
    on.titled(400, 85, 130, BLUE, "run folder", "poses, result")
    on.titled(400, 12, 130, GREY, "poses.csv", "a file of yours")
    on.titled(600, 12, 240, BLUE, "report, verify, history, diff", "is it good, does it still hold?")
    on.titled(600, 85, 240, GREEN, "export", "ROS 2, URDF, URScript, JSON, …")
    on.titled(600, 158, 240, GREEN, "push", "payload, gravity: to the controller")
    on.arrow((150, 71), (206, 98))
    on.arrow((150, 141), (206, 114))
    on.arrow((340, 106), (396, 106), BLUE)
    on.arrow((465, 66), (465, 82))
    on.text(473, 79, "solve")
    on.arrow((530, 96), (596, 46), BLUE)
    on.arrow((530, 106), (596, 106), BLUE)
    on.arrow((530, 116), (596, 170), BLUE)
    on.text(20, 236, "then: all day", colour=ORANGE, bold=True)
    on.titled(20, 256, 130, GREY, "arm", "pose, 500 Hz")
    on.titled(20, 326, 130, GREY, "sensor", "raw wrench")
    on.titled(
        210,
        282,
        320,
        ORANGE,
        "contact = raw - bias - weight",
        "pairing, low-pass, axes and point,",
        "sigma, test for contact",
    )
    on.line((465, 139), (465, 278), colour=BLUE, dashed=True)
    on.arrow((465, 262), (465, 279), BLUE)
    on.text(455, 208, "calibration", colour=BLUE, anchor="end")
    on.arrow((150, 277), (206, 300))
    on.arrow((150, 347), (206, 324))
    on.titled(600, 226, 240, ORANGE, "live, weigh, record", "screen, browser, files")
    on.titled(600, 290, 240, ORANGE, "stream, ros2, serve-load", "Foxglove, topics, UR programs")
    on.titled(600, 354, 240, ORANGE, "open_stream()")
    for y in (247, 311, 372):
        on.arrow((530, 314), (596, y), ORANGE)
    return on


# Known loads


def _weight(on: Drawing, x: float, hook: float, kg: int, string: float = 70) -> None:
    """Draw a weight on a string that hangs from a hook."""
    top = hook + 5 + string
    on.dot((x, hook), ORANGE, filled=False)
    on.line((x, hook + 5), (x, top), colour=ORANGE, width=1.5)
    on.path(f"M{x - 24:g},{top:g} h48 l6,46 h-60 Z", ORANGE)
    on.text(x, top + 29, f"{kg} kg", colour=ORANGE, anchor="middle")


def load_check() -> Drawing:
    """Draw the weight that shows the scale of a sensor."""
    on = Drawing(560, 366, "One weight on a string at the tip")
    _wrist(on, 230, 60)
    _weight(on, 230, 235, 1)
    on.line((140, 60), (180, 60), width=1, dashed=True)
    on.size((140, 60), (140, 235))
    on.text(130, 142, "200 mm from", "the flange face", anchor="end")
    on.line((236, 235), (290, 235), width=1)
    on.text(298, 240, "--at tip=0,0,200: the hook")
    on.text(298, 280, "a thin string of 200 to 300 mm")
    on.text(298, 338, "hangs still")
    return on


def load_string() -> Drawing:
    """Draw a weight at two points of the tool."""
    on = Drawing(790, 400, "A weight on a string at a point beside the tool, and at the tip")
    _wrist(on, 150, 60)
    on.line((172, 110), (245, 110))
    _weight(on, 250, 110, 2, 160)
    on.line((192, 60), (320, 60), width=1, dashed=True)
    on.size((310, 60), (310, 110))
    on.text(320, 90, "50 mm")
    on.size((150, 256), (250, 256))
    on.line((150, 236), (150, 256), width=1, dashed=True)
    on.text(203, 250, "100 mm", anchor="middle")
    with on.turned(35, (560, 235)):
        _wrist(on, 560, 60)
    _weight(on, 560, 240, 2)
    on.line((566, 240), (590, 240), width=1)
    on.text(598, 236, "the hook stays, the arm", "turns about it")
    on.text(598, 290, "at least 20 mm between", "string and tool")
    on.text(150, 386, "1. --at side=100,0,50: 12 tilts", anchor="middle", bold=True)
    on.text(560, 386, "2. --at tip=0,0,200: 12 tilts", anchor="middle", bold=True)
    return on


def load_bar() -> Drawing:
    """Draw one bar, gripped at two places."""
    on = Drawing(760, 270, "One weighed bar, gripped at two places")
    for x, shift, words in ((190, 0, "1. first grip, 6 poses"), (540, 60, "2. shifted by 60 mm, 6 poses")):
        _mount(on, x, 50)
        on.path(f"M{x - 34},84 h68 v44 h-68 Z M{x - 30},128 v50 M{x + 30},128 v50")
        on.path(f"M{x - 30},150 h9 v26 h-9 M{x + 30},150 h-9 v26 h9")
        on.box(x - 140 + shift, 152, 280, 22, ORANGE, round_px=2)
        on.line((x + shift, 146), (x + shift, 180), colour=ORANGE, width=1, dashed=True)
        on.text(x, 240, words, anchor="middle", bold=True)
    on.text(54, 196, "bar, 2.000 kg", colour=ORANGE)
    on.size((540, 192), (600, 192))
    on.text(608, 197, "60 mm")
    return on


# Connections


def connect_robot() -> Drawing:
    """Draw the computer, the ports of a controller, and what must be set at the pendant."""
    on = Drawing(860, 390, "Computer, controller, pendant and sensor: what goes through which port")
    on.box(20, 20, 150, 250, BLUE)
    on.text(95, 46, "computer", "ftdrive", colour=BLUE, anchor="middle", bold=True)
    on.box(600, 20, 240, 250)
    on.text(720, 46, "controller", "--robot 192.168.1.10", anchor="middle", bold=True)
    rows = (
        (GREEN, 104, "30004", "RTDE: pose, state, registers"),
        (GREEN, 146, "30001", "model and kinematics of the arm"),
        (GREEN, 188, "29999; 80 on PolyScope X", "mode, programs, stop"),
        (ORANGE, 240, "30001; 30003 with ur-rtde", "a program of ftdrive: moves, payload"),
    )
    for colour, y, port, content in rows:
        on.arrow((170, y), (596, y), colour)
        on.text(383, y - 8, content, colour=colour, anchor="middle")
        on.text(612, y + 5, port, colour=colour, bold=True)
    on.line((720, 270), (720, 310))
    on.titled(600, 310, 240, GREY, "pendant", "payload, remote control")
    on.line((95, 270), (95, 310))
    on.titled(20, 310, 150, GREY, "sensor", "on its own cable")
    words = "Green needs no control: doctor, live, record, weigh."
    on.text(385, 328, words, colour=GREEN, anchor="middle")
    on.text(385, 352, "Orange needs control: calibrate, verify, push.", colour=ORANGE, anchor="middle")
    return on


def ur_program() -> Drawing:
    """Draw how a program on the controller gets weight and wrench."""
    on = Drawing(860, 330, "A UR program, registers of its controller, and ftdrive serve-load")
    on.box(20, 20, 530, 236)
    on.text(36, 44, "controller", bold=True)
    on.box(36, 60, 160, 180, GREEN)
    on.text(52, 84, "your program", "with ftd.script", colour=GREEN, bold=True)
    on.text(52, 140, "ftd_wrench()", colour=GREEN)
    on.text(52, 180, "ftd_zero()", "ftd_weigh()", colour=GREEN)
    on.box(320, 60, 214, 80, BLUE)
    on.text(
        427,
        84,
        "input registers F …",
        "wrench, weight, state,",
        "live counter",
        colour=BLUE,
        anchor="middle",
        bold=True,
    )
    on.box(320, 168, 214, 72, ORANGE)
    request = ("output registers F, F+1", "request: weigh, zero, status")
    on.text(427, 194, *request, colour=ORANGE, anchor="middle", bold=True)
    on.arrow((320, 100), (200, 100), BLUE)
    on.arrow((196, 196), (316, 196), ORANGE)
    on.box(680, 60, 160, 180, BLUE)
    on.text(760, 90, "ftdrive serve-load", anchor="middle", colour=BLUE, bold=True)
    on.text(760, 122, "contact wrench", "of calibration,", "sensor and pose", anchor="middle", colour=BLUE)
    on.text(760, 206, "never moves the arm", anchor="middle", colour=BLUE)
    on.arrow((680, 100), (538, 100), BLUE)
    on.text(609, 90, "125 Hz or more", colour=BLUE, anchor="middle")
    on.arrow((534, 204), (676, 204), ORANGE)
    on.titled(680, 268, 160, GREY, "sensor", "raw wrench")
    on.arrow((760, 268), (760, 243))
    on.text(36, 288, "F is --first, 24 unless you choose it. If the live counter stands still,")
    on.text(36, 308, "service, sensor, link or arm are silent: the numbers are old.")
    return on


def ros2_node() -> Drawing:
    """Draw the node's topics and services, and its frames."""
    on = Drawing(860, 410, "The node of ftdrive ros2: what it reads, publishes and serves, and its frames")
    on.titled(20, 40, 180, GREY, "arm", "driver, topic, tf or URDF")
    on.titled(20, 130, 180, GREY, "sensor", "driver or WrenchStamped")
    on.titled(270, 85, 170, BLUE, "node /ftdrive", "calibration, tare")
    on.arrow((200, 67), (266, 98))
    on.arrow((200, 157), (266, 126))
    topics = (
        (ORANGE, 46, "~/wrench, ~/contact", "contact wrench"),
        (GREY, 84, "~/wrench_raw", "as measured"),
        (GREEN, 122, "~/status, /diagnostics", "what is wrong, drift"),
        (BLUE, 160, "/tf, /tf_static", "the frames below"),
    )
    for colour, y, name, content in topics:
        on.arrow((440, 92 + (y - 46) * 0.34), (526, y), colour)
        on.text(534, y + 5, name, colour=colour, bold=True)
        on.text(704, y + 5, content, colour=colour)
    on.arrow((355, 190), (355, 145), GREEN)
    on.text(355, 208, "services ~/tare, ~/undo_tare; parameters axes, about, tool", colour=GREEN, anchor="middle")
    on.line((20, 240), (840, 240), width=0.5)
    for x, frame, colour, words in (
        (110, "base", GREY, ("the arm's driver", "publishes the arm")),
        (400, "tool0", GREY, ()),
        (720, "ft_sensor", BLUE, ("axes as identified",)),
    ):
        on.box(x - 90, 275, 180, 36, colour)
        on.text(x, 298, frame, colour=colour, anchor="middle", bold=True)
        on.text(x, 332, *words, colour=colour, anchor="middle")
    on.arrow((200, 293), (306, 293), dashed=True)
    on.text(253, 283, "/tf", anchor="middle")
    on.text(253, 266, "publish_base_tf", anchor="middle")
    on.arrow((490, 293), (626, 293), BLUE)
    on.text(558, 283, "/tf_static", colour=BLUE, anchor="middle")
    on.arrow((400, 311), (400, 356), ORANGE)
    on.text(412, 340, "/tf", colour=ORANGE)
    on.text(400, 376, "base_at_ft_sensor: frame_id of a wrench", colour=ORANGE, anchor="middle", bold=True)
    on.text(400, 396, "in base axes about the sensor (--axes base)", colour=ORANGE, anchor="middle")
    return on


# Figures: the numbers of a table of the page, so that picture and table cannot differ

ROOT = Path(__file__).parents[2]
FIGURES = "docs/contributing/figures"
NUMBER = re.compile(r"(?<![\w.])\d*\.?\d+")


def _rows(page: str, heading: str) -> list[list[str]]:
    """Return the cells of the first table below a heading, without its head."""
    text = (ROOT / page).read_text(encoding="utf-8").split(f"\n## {heading}\n", 1)[1]
    table = re.search(r"(?:^\|.*\n)+", text, re.MULTILINE)
    assert table is not None
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table[0].splitlines()[2:]]


def _numbers(cell: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(cell)]


Row = tuple[str, Sequence[tuple[str, Sequence[float]]]]
"""Label, and the values of each colour; a line joins the values of one colour."""


def _dots(
    title: str, rows: Sequence[Row], ticks: Sequence[float], key: Mapping[str, str], *, logarithmic: bool
) -> Drawing:
    """Draw a line of dots for each row above a common axis; `key` has the words of each colour."""
    left, right, row_px = 350, 840, 24
    on = Drawing(880, 90 + row_px * len(rows), title)
    scale = log10 if logarithmic else float
    start, end = scale(ticks[0]), scale(ticks[-1])

    def x(value: float) -> float:
        return round(left + (right - left) * (scale(value) - start) / (end - start), 1)

    on.text(20, 20, title, bold=True)
    bottom = 40 + row_px * len(rows)
    for tick in ticks:
        on.line((x(tick), 34), (x(tick), bottom), width=0.5)
        on.text(x(tick), bottom + 18, f"{tick:g}", anchor="middle")
    for i, (label, series) in enumerate(rows):
        y = 52 + row_px * i
        on.text(left - 16, y + 5, label, anchor="end")
        for colour, values in series:
            if len(values) > 1:
                on.line((x(min(values)), y), (x(max(values)), y), colour=colour)
            for value in values:
                on.dot((x(value), y), colour)
    width = 20.0
    for colour, words in key.items():
        on.dot((width + 5, bottom + 32), colour)
        on.text(width + 16, bottom + 36, words, colour=colour)
        width += 40 + 7.5 * len(words)
    return on


def figure_calibration() -> Drawing:
    """Draw the force error of five methods in each session."""
    colours = (GREY, GREY, GREEN, ORANGE, BLUE)
    rows: list[Row] = []
    for session, *cells in _rows("README.md", "Accuracy"):
        found = [(colour, _numbers(cell)[:1]) for colour, cell in zip(colours, cells, strict=True) if _numbers(cell)]
        rows.append((session, found))
    key = {GREY: "10-parameter LS; Carlson", GREEN: "LROM", ORANGE: "SROM", BLUE: "ftdrive"}
    title = "Force error in poses that were not used, rms, mN"
    return _dots(title, rows, (50, 100, 1000, 10000, 30000), key, logarithmic=True)


def figure_motion() -> Drawing:
    """Draw error over sigma of calibrations from motion."""
    rows = _rows(f"{FIGURES}/motion.md", "Calibration from motion")
    found: list[Row] = [(label.partition(", which")[0], [(BLUE, sorted(_numbers(cell)))]) for label, cell, _ in rows]
    key = {BLUE: "smallest, overall and largest of 23 parameters; 1 is right"}
    return _dots("Error over sigma, 200 runs a row", found, (0.5, 1, 1.5, 2, 2.5, 3, 3.5), key, logarithmic=False)


def figure_planning() -> Drawing:
    """Draw the distances of the tours: certified, between hulls, between meshes."""
    rows: list[Row] = [
        (arm, [(BLUE, _numbers(certified)), (ORANGE, _numbers(hulls)[:1]), (GREEN, _numbers(meshes))])
        for arm, certified, hulls, meshes in _rows(f"{FIGURES}/planning.md", "Tours against meshes")
    ]
    key = {BLUE: "certified, of each tour", ORANGE: "smallest between hulls", GREEN: "smallest between meshes"}
    title = "Distance of the moving parts on all tours, mm; target 15 between hulls"
    return _dots(title, rows, (0, 15, 20, 25, 30, 35), key, logarithmic=False)


def figure_devices() -> Drawing:
    """Draw how soon a failure of arm or link is reported, and how soon the arm rests."""
    rows: list[Row] = []
    for event, reported, arm, _ in _rows(f"{FIGURES}/devices.md", "Failures of the arm"):
        if reported and _numbers(arm):
            label = event.partition(";")[0].partition(" (")[0].partition(", or")[0]
            rows.append((label, [(ORANGE, _numbers(arm)), (BLUE, _numbers(reported))]))
    key = {BLUE: "reported, target 0.5 s", ORANGE: "the arm rests, target 1 s where a stop can reach it"}
    return _dots(
        "Failures of the arm: seconds after the event", rows, (0, 0.25, 0.5, 0.75, 1, 1.25), key, logarithmic=False
    )


def figure_fleet() -> Drawing:
    """Draw after how many days a drift is found."""
    rows: list[Row] = [
        (case, [(BLUE, _numbers(days))]) for case, days, _ in _rows(f"{FIGURES}/fleet.md", "Drift") if _numbers(days)
    ]
    key = {BLUE: "median, 90 % and 99 % of 200 cells"}
    return _dots(
        "A drift of the bias is found after, days", rows, (0, 10, 20, 30, 40, 50, 60, 70, 80), key, logarithmic=False
    )


DRAWINGS: Mapping[str, Callable[[], Drawing]] = MappingProxyType(
    {
        "frames": frames,
        "wrench-sign": wrench_sign,
        "measure": measure,
        "run-folder": run_folder,
        "data-flow": data_flow,
        "load-check": load_check,
        "load-string": load_string,
        "load-bar": load_bar,
        "connect-robot": connect_robot,
        "ur-program": ur_program,
        "ros2-node": ros2_node,
        "figure-calibration": figure_calibration,
        "figure-motion": figure_motion,
        "figure-planning": figure_planning,
        "figure-devices": figure_devices,
        "figure-fleet": figure_fleet,
    }
)
