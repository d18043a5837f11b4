"""Control requests that act on the arm, as the operator, other clients and the network do."""

import math
from collections.abc import Callable
from typing import Any

from ftmocks.kinematics import ZERO6, vector3, vector6
from ftmocks.ur import dashboard
from ftmocks.ur.hand import guided_by_hand, pendant_program, usual_rest_s
from ftmocks.ur.modes import PERMITTED, RobotMode, Runtime, SafetyMode
from ftmocks.ur.production import Job, Production
from ftmocks.ur.robot import INSTALLED_G_M_S2, Robot
from ftmocks.ur.server import UrServer
from ftmocks.ur.swing import Swing, SwingProgram
from ftmocks.ur.uploads import Upload, start_upload

Request = dict[str, Any]
Verb = Callable[[Request], dict[str, Any] | None]
"""Function that executes a control request; it returns the fields of its answer, or None for an answer without any."""

FOREIGN_PROGRAM_S = 5.0
FOREIGN_SPEED_RAD_S = 0.3
HAND_SPEED_RAD_S = 0.3
SWING_LIMITS = ("speed_rad_s", "acceleration_rad_s2", "acceleration_m_s2")


class Operator:
    """Acts on the arm like the operator, other clients and the network.

    Parameters
    ----------
    robot, server
        The controller and its TCP ports.
    """

    def __init__(self, robot: Robot, server: UrServer) -> None:
        self._robot = robot
        self._server = server
        self.verbs: dict[str, Verb] = {
            "protective-stop": lambda _: robot.protective_stop("requested"),
            "emergency-stop": lambda request: robot.emergency_stop(_on(request)),
            "safeguard": lambda request: robot.safeguard_stop(_on(request)),
            "reduced": lambda request: robot.reduced_mode(_on(request)),
            "mode": self._mode,
            "unlock": lambda _: self._pendant("unlock protective stop"),
            "play": lambda _: self._pendant("play"),
            "dashboard-stop": lambda _: {"reply": dashboard.answer(robot, "stop", by="another dashboard client")},
            "crash-script": lambda _: {"accepted": robot.crash("requested")},
            "foreign-program": self._foreign_program,
            "close-popup": self._close_popup,
            "hand-move": self._hand_move,
            "hand-guide": self._hand_guide,
            "pendant-program": self._pendant_program,
            "swing": self._swing,
            "production": self._production,
            "push-joint": self._push_joint,
            "slider": self._slider,
            "speed-scaling": self._speed_scaling,
            "remote-control": self._remote_control,
            "set-tcp": self._set_tcp,
            "set-payload": self._set_payload,
            "set-mounting": self._set_mounting,
            "freeze": self._freeze,
            "silent": self._silent,
            "silence-arm": self._silence_arm,
            "drop": self._drop,
            "listen": self._listen,
            "claim-registers": self._claim_registers,
        }
        """Methods by the value of "do". A wrong request raises ValueError, TypeError or KeyError and does nothing."""

    def _mode(self, request: Request) -> dict[str, Any]:
        robot = self._robot
        robot_mode = RobotMode(request["robot"]) if "robot" in request else None
        safety_mode = SafetyMode(request["safety"]) if "safety" in request else None
        if robot_mode is None and safety_mode is None:
            raise KeyError("robot")
        if robot_mode is not None:
            robot.set_mode(robot_mode)
        if safety_mode in PERMITTED:
            robot.reduced_mode(safety_mode == SafetyMode.REDUCED)
            robot.set_safety(SafetyMode.NORMAL, "requested")
        elif safety_mode == SafetyMode.PROTECTIVE_STOP:
            robot.protective_stop("requested")
        elif safety_mode is not None:
            robot.set_safety(safety_mode, "requested")
        return {"robot_mode": robot.robot_mode.name, "safety_mode": robot.safety_mode.name}

    def _pendant(self, command: str) -> dict[str, Any]:
        reply = dashboard.answer(self._robot, command, by="operator")
        return {"accepted": self._robot.events[-1].accepted, "reply": reply}

    def _close_popup(self, request: Request) -> dict[str, Any]:
        self._robot.popup_answer = request.get("value")
        return self._pendant("close popup")

    def _slider(self, request: Request) -> None:
        self._robot.arm.speed_fraction = _fraction(request)
        self._robot.note("operator", "slider", why=f"{request['fraction']}")

    def _remote_control(self, request: Request) -> dict[str, Any]:
        robot = self._robot
        if robot.settings.polyscope[0] < 5:
            raise ValueError("a CB-Series pendant has no local and remote control")
        robot.remote_control = _on(request)
        robot.note("operator", f"{'remote' if robot.remote_control else 'local'} control")
        return {"on": robot.remote_control}

    def _set_tcp(self, request: Request) -> None:
        self._robot.tcp_offset = vector6(request["tcp"])
        self._robot.note("operator", "set-tcp", tcp=list(self._robot.tcp_offset))

    def _set_payload(self, request: Request) -> None:
        payload_kg = float(request["payload_kg"])
        if not 0.0 <= payload_kg < math.inf:
            raise ValueError(f"payload {payload_kg} kg")
        cog_m = vector3(request.get("payload_cog_m", self._robot.payload_cog_m))
        if not all(map(math.isfinite, cog_m)):
            raise ValueError(f"centre of gravity {cog_m} m")
        self._robot.payload_kg, self._robot.payload_cog_m = payload_kg, cog_m
        self._robot.note("operator", "set-payload", payload_kg=payload_kg, payload_cog_m=list(cog_m))

    def _set_mounting(self, request: Request) -> None:
        robot, up = self._robot, vector3(request["up"])
        length = math.hypot(*up)
        if not 0.0 < length < math.inf:
            raise ValueError(f"up {request['up']} is not a direction")
        if robot.runtime != Runtime.STOPPED:
            raise ValueError(f"the installation cannot be changed: the program is {robot.runtime.name}")
        robot.target_gravity_m_s2 = vector3([INSTALLED_G_M_S2 * part / length for part in up])
        robot.note("operator", "set-mounting", target_gravity_m_s2=list(robot.target_gravity_m_s2))

    def _push_joint(self, request: Request) -> None:
        joint, off_rad = int(request["joint"]), math.radians(request["off_deg"])
        if not (1 <= joint <= 6 and math.isfinite(off_rad)):
            raise ValueError(f"the joint is {joint} and the angle {off_rad} rad: give 1 to 6, and a finite angle")
        pushed = [0.0] * 6
        pushed[joint - 1] = off_rad
        self._robot.arm.pushed_rad = vector6(pushed) if off_rad else ZERO6
        self._robot.note("operator", "push-joint", joint=joint, off_deg=request["off_deg"])

    def _hand_move(self, request: Request) -> None:
        q, speed_rad_s = vector6(request["q_rad"]), float(request.get("speed_rad_s", HAND_SPEED_RAD_S))
        if not (speed_rad_s > 0.0 and all(map(math.isfinite, q))):
            raise ValueError(f"expected six joint angles and a positive speed, got {list(q)} and {speed_rad_s}")
        self._robot.hand_move(q, speed_rad_s)
        self._robot.note("operator", "hand-move", q_rad=list(q))

    def _hand_guide(self, request: Request) -> None:
        self._robot.hand = guided_by_hand(self._robot, self._rest_s(request)) if _on(request) else None
        self._robot.note("operator", "hand-guide", on=_on(request))

    def _pendant_program(self, request: Request) -> dict[str, Any]:
        accepted = start_upload(self._robot, pendant_program(self._robot, self._rest_s(request)), by="operator")
        return {"accepted": accepted}

    def _rest_s(self, request: Request) -> float:
        rest_s = float(request.get("rest_s", usual_rest_s(self._robot)))
        if not 0.0 < rest_s < math.inf:
            raise ValueError(f"rest_s {rest_s} is not a positive time")
        return rest_s

    def _swing(self, request: Request) -> dict[str, Any]:
        robot = self._robot
        limits = {name: float(request[name]) for name in SWING_LIMITS if name in request}
        if not robot.arm.at_rest:
            raise ValueError("the arm is moving: wait until it has stopped")
        swing = Swing(robot.arm.dh, robot.arm.q, float(request["seconds"]), **limits)
        accepted = robot.start_soon(SwingProgram(robot, swing), by="operator", obstacle=robot.obstacle)
        return {"accepted": accepted, "seconds": swing.duration_s, "period_s": swing.period_s}

    def _production(self, request: Request) -> dict[str, Any]:
        robot = self._robot
        given = {name: request[name] for name in ("parts_kg", "contacts", "slip_m") if name in request}
        job = Job(request.get("file"), int(request.get("seed", robot.world.seed)), **given)
        if not robot.arm.at_rest:
            raise ValueError("the arm is moving: wait until it has stopped")
        accepted = robot.start_soon(Production(robot, job), by="operator", obstacle=robot.obstacle)
        return {"accepted": accepted}

    def _foreign_program(self, request: Request) -> dict[str, Any]:
        does = f"sleep({float(request.get('seconds', FOREIGN_PROGRAM_S))})"
        if "q_rad" in request:
            speed = float(request.get("speed_rad_s", FOREIGN_SPEED_RAD_S))
            does = f"movej({list(vector6(request['q_rad']))}, a=1.4, v={speed})"
        upload = Upload("other", f"def other():\n  {does}\nend\n", secondary=False)
        accepted = start_upload(self._robot, upload, by="another script client")
        return {"accepted": accepted}

    def _speed_scaling(self, request: Request) -> None:
        self._robot.arm.scaling = _fraction(request)

    def _freeze(self, request: Request) -> dict[str, Any]:
        self._server.frozen = _on(request)
        self._robot.note("network", "freeze", on=self._server.frozen)
        return {"on": self._server.frozen}

    def _silent(self, request: Request) -> None:
        what, on, answers = request["what"], _on(request), bool(request.get("answers", False))
        if answers and what != "rtde":
            raise ValueError(f"only rtde can answer without streaming, not {what!r}")
        self._server.set_silent(what, on and not answers)
        if what == "rtde":
            self._server.streaming = not (on and answers)
        self._robot.note("network", f"silent {what}", on=on, answers=answers)

    def _silence_arm(self, request: Request) -> None:
        for what in set(self._server.ports.values()):
            self._server.set_silent(what, _on(request))
        self._robot.note("network", "silence-arm", on=_on(request))

    def _drop(self, request: Request) -> dict[str, Any]:
        reset = bool(request.get("reset", False))
        self._robot.note("network", f"drop {request['what']}", reset=reset)
        return {"connections": self._server.drop(request["what"], reset=reset)}

    def _listen(self, request: Request) -> None:
        self._server.set_listening(request["what"], _on(request))
        self._robot.note("network", f"listen {request['what']}", on=_on(request))

    def _claim_registers(self, request: Request) -> None:
        first = {"lower": 0, "upper": 24}[request["range"]]
        names = {f"input_{kind}_register_{first + i}" for kind in ("int", "double") for i in range(24)}
        link = self._server.rtde
        link.claimed = link.claimed | names if _on(request) else link.claimed - names


def _on(request: Request) -> bool:
    return bool(request.get("on", True))


def _fraction(request: Request) -> float:
    fraction = float(request["fraction"])
    if not 0.0 <= fraction <= 1.0:
        raise ValueError(f"fraction {fraction} is not between 0 and 1")
    return fraction
