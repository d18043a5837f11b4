"""A state machine with the behaviour of the control script of ur_rtde.

The control script is recognised by its name and not interpreted. This state machine runs instead, one step per control
cycle, with the same loop, registers and blocking behaviour.

Source: the control script inside ur_rtde 1.6.5 (`ScriptClient.getScript()`), read for behaviour.
"""

import math
from collections.abc import Callable, Generator

from ftmocks.arrays import Array
from ftmocks.kinematics import Vector6, forward, inverse, inverse_matrix, matrix_of, pose_of, vector6
from ftmocks.ur.controller_program import ControllerProgram, ScriptError
from ftmocks.ur.motion import JointMove, LineMove, Path
from ftmocks.ur.robot import STOP_SCRIPT, Robot

NAME = "rtde_control"
"""Program name by which an upload is recognised."""
READY, DONE = 1, 2
REALTIME = frozenset({6, 9, 10, 11, 24, 25, 26, 27, 38, 58, 66, 67, 68, 69, 70, 71})
"""Commands that are executed in every cycle while the register holds their number."""

MOVING = {1: "moveJ", 2: "moveJ_IK", 3: "moveL", 4: "moveL_FK", 33: "stopL", 34: "stopJ"}
SETTING = {8: "zeroFtSensor", 17: "setPayload", 29: "setTcp", 31: "triggerProtectiveStop", 35: "setWatchdog"}
SETTING |= {59: "setGravity", 65: "setTargetPayload", STOP_SCRIPT: "stopScript"}
LOGGED = MOVING | SETTING
"""Commands that are logged, because they move the arm or change a setting."""

Steps = Generator[None, None, None]
"""A running thread of the control script; each `next()` runs it for one control cycle."""


class ControlScript(ControllerProgram):
    """The state machine of the control script.

    Parameters
    ----------
    robot
        The controller whose registers are used.
    int_offset, double_offset
        Numbers of the first general-purpose registers.
    """

    reads_registers = True

    def __init__(self, robot: Robot, int_offset: int = 0, double_offset: int = 0) -> None:
        super().__init__(NAME)
        self._robot = robot
        self._int_offset, self._double_offset = int_offset, double_offset
        self._threads: dict[str, Steps] = {}
        self._stop_is_linear = False
        self._writes = self._operation = 0
        self._main = self._control_loop()
        self._commands: dict[int, Callable[[], Steps | None]] = {
            1: self._movej,
            2: self._movej_ik,
            3: self._movel,
            4: self._movel_fk,
            8: robot.zero_ft,
            17: self._set_payload,
            20: self._accept,
            21: self._accept,
            26: self._step_time,
            28: lambda: self._write_pose(forward(robot.arm.dh, robot.arm.q) @ robot.X_flange_tcp),
            29: self._set_tcp,
            30: lambda: self._write_vector(self._inverse_kin(qnear=self._vector(6))),
            31: self._protective_stop,
            33: self._stop,
            34: self._stop,
            35: self._set_watchdog,
            36: self._pose_within_limits,
            37: lambda: self._write_flag(robot.limits.allow(self._vector(0), robot.X_flange_tcp)),
            39: lambda: self._write_pose(matrix_of(self._vector(0)) @ matrix_of(self._vector(6))),
            40: lambda: self._write_vector(robot.tcp_offset),
            43: lambda: self._write_vector(robot.tcp_pose("actual")),
            44: lambda: self._write_pose(forward(robot.arm.dh, self._vector(0)) @ matrix_of(self._vector(6))),
            46: lambda: self._write_vector(self._inverse_kin(qnear=robot.arm.actual_q)),
            47: lambda: self._write_flag(robot.steady),
            58: lambda: self._write_pose(forward(robot.arm.dh, robot.measured_q)),
            59: self._set_gravity,
            60: lambda: self._write_flag(self._solve(robot.arm.actual_q) is not None),
            61: lambda: self._write_flag(self._solve(self._vector(6)) is not None),
            65: self._set_target_payload,
        }

    def step(self) -> bool:
        """Run one control cycle; return False if the program has ended.

        Raises
        ------
        ScriptError, MotionError
            The program ends with a run-time error.
        """
        for thread in [("main", self._main), *self._threads.items()]:
            name, steps = thread
            if name != "main" and self._threads.get(name) is not steps:
                continue  # another thread has killed this one in this cycle
            try:
                next(steps)
            except StopIteration:
                if name == "main":
                    return False
                del self._threads[name]
        return True

    def close(self) -> None:
        """End the program and its threads. A moving arm comes to rest."""
        for steps in (self._main, *self._threads.values()):
            steps.close()
        self._threads.clear()

    def _control_loop(self) -> Steps:
        self._report_async(-1)
        self._write_int(0, READY)
        executing = False
        while True:
            command = self._read_int(0)
            if command in REALTIME:
                yield from self._execute(command)
                self._write_int(0, READY)
            elif command == 0:
                executing = False
                self._write_int(0, READY)
            else:
                if not executing:
                    if command in LOGGED:
                        self._robot.note("rtde", f"command {command}", why=LOGGED[command])
                    if command == STOP_SCRIPT:
                        return
                    yield from self._execute(command)
                    self._write_int(0, DONE)
                executing = True
            yield

    def _execute(self, command: int) -> Steps:
        handler = self._commands.get(command)
        if handler is None:
            raise ScriptError(f"command {command} is not modelled by this emulator")
        steps = handler()
        if steps is not None:
            yield from steps

    def _accept(self) -> None:
        """Accept a command whose setting is not modelled; do nothing."""

    def _read_int(self, index: int) -> int:
        return self._robot.input_int(index + self._int_offset)

    def _read(self, index: int) -> float:
        value = self._robot.input_double(index + self._double_offset)
        if not math.isfinite(value):
            raise ScriptError(f"input_double_register_{index + self._double_offset} holds {value}")
        return value

    def _vector(self, first: int) -> Vector6:
        return vector6([self._read(first + i) for i in range(6)])

    def _write_int(self, index: int, value: int) -> None:
        self._robot.output_ints[index + self._int_offset] = value

    def _write_flag(self, value: bool) -> None:
        self._write_int(1, int(value))

    def _write_vector(self, values: Vector6) -> None:
        first = self._double_offset
        self._robot.output_doubles[first : first + 6] = values

    def _write_pose(self, X: Array) -> None:
        self._write_vector(pose_of(X))

    def _report_async(self, progress: int) -> None:
        """Write output register 2: operation id, change counter, running bit and progress (-1: end, 0: new start)."""
        self._writes = (self._writes + 1) % 128
        if progress == 0:
            self._operation = (self._operation + 1) % 128
        running = 0x8000 | min(progress, 0x7FFF) if progress >= 0 else 0
        self._write_int(2, self._operation << 24 | self._writes << 16 | running)

    def _movej(self) -> Steps:
        return self._move(JointMove(self._robot.arm.dh, self._vector(0), self._read(6), self._read(7)))

    def _movej_ik(self) -> Steps:
        goal = self._inverse_kin(qnear=self._robot.arm.actual_q)
        return self._move(JointMove(self._robot.arm.dh, goal, self._read(6), self._read(7)))

    def _movel(self) -> Steps:
        return self._move_line(matrix_of(self._vector(0)))

    def _movel_fk(self) -> Steps:
        return self._move_line(forward(self._robot.arm.dh, self._vector(0)) @ self._robot.X_flange_tcp)

    def _move_line(self, goal: Array) -> Steps:
        robot = self._robot
        return self._move(LineMove(robot.arm.dh, robot.X_flange_tcp, goal, self._read(6), self._read(7)))

    def _move(self, path: Path) -> Steps:
        self._kill_async_move()
        if self._read_int(1) == 1:
            self._threads["move"] = self._move_thread(path)
        else:
            yield from self._follow(path, "main")

    def _move_thread(self, path: Path) -> Steps:
        self._report_async(0)
        yield from self._follow(path, "move")
        self._report_async(-1)

    def _follow(self, path: Path, owner: str) -> Steps:
        arm = self._robot.arm
        arm.start(path, owner)
        yield from arm.until_finished(owner)

    def _kill_async_move(self) -> None:
        if self._kill("move"):
            self._report_async(-1)

    def _kill(self, name: str) -> bool:
        thread = self._threads.pop(name, None)
        if thread is None:
            return False
        thread.close()
        return True

    def _stop(self) -> Steps:
        """Execute a stop. An asynchronous one is always linear, and so are all synchronous ones after it."""
        deceleration = self._read(0)
        if self._kill("stop"):
            self._report_async(-1)
        else:
            self._kill_async_move()
        if self._read_int(1) == 1:
            self._stop_is_linear = True
            self._threads["stop"] = self._stop_thread(deceleration)
        else:
            yield from self._brake(deceleration, "main")

    def _stop_thread(self, deceleration: float) -> Steps:
        self._report_async(0)
        yield from self._brake(deceleration, "stop")
        self._report_async(-1)

    def _brake(self, deceleration: float, owner: str) -> Steps:
        arm = self._robot.arm
        if self._stop_is_linear:
            arm.stop_tool(deceleration, owner)
        else:
            arm.stop_joints(deceleration, owner)
        yield from arm.until_finished(owner)

    def _protective_stop(self) -> Steps:
        self._robot.protective_stop("requested by the program")
        yield  # the program is paused here, so the end of the command is not reported

    def _solve(self, qnear: Vector6) -> Vector6 | None:
        X_base_flange = matrix_of(self._vector(0)) @ inverse_matrix(self._robot.X_flange_tcp)
        return inverse(self._robot.arm.dh, X_base_flange, qnear)

    def _inverse_kin(self, qnear: Vector6) -> Vector6:
        q = self._solve(qnear)
        if q is None:
            raise ScriptError(f"get_inverse_kin: no solution for the pose {list(self._vector(0))}")
        return q

    def _pose_within_limits(self) -> None:
        q = self._solve(self._robot.arm.actual_q)
        self._write_flag(q is not None and self._robot.limits.allow(q, self._robot.X_flange_tcp))

    def _set_payload(self) -> None:
        self._robot.payload_kg = self._read(0)
        cog = (self._read(1), self._read(2), self._read(3))
        if any(cog):  # like ur_rtde's script, keeps the old centre for zeros
            self._robot.payload_cog_m = cog

    def _set_target_payload(self) -> None:
        self._set_payload()
        self._robot.payload_inertia = self._vector(4)
        self._robot.zero_ft()

    def _set_tcp(self) -> None:
        self._robot.tcp_offset = self._vector(0)

    def _set_gravity(self) -> None:
        self._robot.target_gravity_m_s2 = (self._read(0), self._read(1), self._read(2))

    def _set_watchdog(self) -> None:
        self._robot.set_watchdog(f"input_int_register_{self._int_offset}", self._read(0))

    def _step_time(self) -> None:
        self._robot.output_doubles[self._double_offset] = self._robot.period_s
