"""Scenarios with the unmodified ur_rtde clients, one per process: ``python ur_emulator_client.py SCENARIO HOST``.

The client may hang or crash (it is C++ and holds the interpreter's lock in its constructors), so it never runs in the
test process. A scenario prints one line ``@result {...}``; on the way it may ask the station for something with a line
``@ask {...}`` and reads the answer from standard input.
"""

import json
import math
import sys
import time
from collections.abc import Callable
from importlib import import_module
from typing import Any

from rtde_control import RTDEControlInterface
from rtde_receive import RTDEReceiveInterface


def ask(**request: Any) -> dict[str, Any]:
    """Say something on the station's control channel and return the answer."""
    sys.stdout.write("@ask " + json.dumps(request) + "\n")
    sys.stdout.flush()
    answer: dict[str, Any] = json.loads(sys.stdin.readline())
    return answer


def wait_for(condition: Callable[[], bool], timeout_s: float = 30.0) -> bool:
    """Wait until the condition holds; False when it does not in time."""
    end = time.monotonic() + timeout_s
    while time.monotonic() < end:
        if condition():
            return True
        time.sleep(0.002)
    return False


def arrived(receive: Any, goal: list[float]) -> bool:
    return bool(max(abs(a - b) for a, b in zip(receive.getActualQ(), goal, strict=True)) < 1e-4)


def some_cycles(receive: Any) -> None:
    """Let the controller go through ten cycles and more."""
    begun = receive.getTimestamp()
    wait_for(lambda: receive.getTimestamp() > begun + 0.1)


def receive(host: str) -> dict[str, Any]:
    """Everything, and an explicit list at another rate."""
    everything = RTDEReceiveInterface(host)
    some = RTDEReceiveInterface(host, 125.0, ["timestamp", "actual_q", "actual_TCP_pose", "payload"])
    first = everything.getTimestamp()
    advanced = wait_for(lambda: everything.getTimestamp() > first + 0.1)
    state = ask(do="state")
    return {
        "advanced": advanced,
        "q": everything.getActualQ(),
        "same_q": some.getActualQ(),
        "pose": everything.getActualTCPPose(),
        "same_pose": some.getActualTCPPose(),
        "true_q": state["q_rad"],
        "modes": [everything.getRobotMode(), everything.getSafetyMode(), everything.getRuntimeState()],
        "payload": [everything.getPayload(), some.getPayload()],
        "scaling": [everything.getSpeedScaling(), everything.getTargetSpeedFraction()],
    }


def moves(host: str) -> dict[str, Any]:
    """Blocking and asynchronous moves, both stops, straight lines."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    q = r.getActualQ()
    q[5] += 1.0
    out: dict[str, Any] = {"moveJ": c.moveJ(q, 1.0, 2.0)}
    out["moveJ_arrived"] = wait_for(lambda: arrived(r, q))
    pose = r.getActualTCPPose()
    pose[2] -= 0.05
    out["moveL"] = c.moveL(pose, 0.25, 1.2)
    some_cycles(r)
    out["moveL_error_m"] = max(abs(a - b) for a, b in zip(r.getActualTCPPose()[:3], pose[:3], strict=True))
    out["moveJ_IK"] = c.moveJ_IK(pose, 1.0, 2.0)

    before = c.getAsyncOperationProgressEx()
    far = r.getActualQ()
    far[5] -= 2.0
    out["async"] = c.moveJ(far, 0.01, 2.0, True)
    out["running"] = wait_for(lambda: bool(c.getAsyncOperationProgressEx().isAsyncOperationRunning()))
    out["next_operation"] = c.getAsyncOperationProgressEx().operationId() - before.operationId()
    wait_for(lambda: abs(r.getTargetQd()[5]) > 0.008)
    c.stopJ(2.0)
    out["stopped"] = wait_for(lambda: not any(r.getTargetQd()))
    out["ended"] = wait_for(lambda: not c.getAsyncOperationProgressEx().isAsyncOperationRunning())
    out["short_of_goal"] = abs(r.getActualQ()[5] - far[5]) > 0.5

    near = r.getActualQ()
    near[4] += 0.3
    c.moveJ(near, 1.0, 2.0, True)
    wait_for(lambda: bool(c.getAsyncOperationProgressEx().isAsyncOperationRunning()))
    out["async_ended"] = wait_for(lambda: not c.getAsyncOperationProgressEx().isAsyncOperationRunning())
    out["async_arrived"] = wait_for(lambda: arrived(r, near))
    out["steady"] = wait_for(c.isSteady)
    c.stopScript()
    return out


def kinematics(host: str) -> dict[str, Any]:
    """Everything the controller computes."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    q, pose = r.getActualQ(), r.getActualTCPPose()

    def twice(question: Callable[..., Any], *about: Any) -> Any:
        """Ask again after some cycles, because the client may read a result before the script has run."""
        question(*about)
        some_cycles(r)
        return question(*about)

    return {
        "flange": twice(c.getActualToolFlangePose),
        "q": q,
        "pose": pose,
        "ik": twice(c.getInverseKinematics, pose),
        "ik_near": twice(c.getInverseKinematics, pose, q),
        "has": twice(c.getInverseKinematicsHasSolution, pose),
        "has_not": twice(c.getInverseKinematicsHasSolution, [3.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        "fk": twice(c.getForwardKinematics),
        "fk_of_q": twice(c.getForwardKinematics, q, [1e-12, 0.0, 0.0, 0.0, 0.0, 0.0]),
        "trans": twice(c.poseTrans, [1.0, 2.0, 3.0, 0.0, 0.0, math.pi / 2], [1.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        "joints_safe": twice(c.isJointsWithinSafetyLimits, q),
        "joints_unsafe": twice(c.isJointsWithinSafetyLimits, [7.0, *q[1:]]),
        "pose_safe": twice(c.isPoseWithinSafetyLimits, pose),
        "pose_below_plane": twice(c.isPoseWithinSafetyLimits, [*pose[:2], 0.05, *pose[3:]]),
        "pose_unreachable": twice(c.isPoseWithinSafetyLimits, [3.0, *pose[1:]]),
        "script_alive": c.isProgramRunning(),
        "unreachable_ik": c.getInverseKinematics([3.0, 0.0, 0.0, 0.0, 0.0, 0.0]),
        "script_died": wait_for(lambda: not c.isProgramRunning()),
    }


def settings(host: str) -> dict[str, Any]:
    """TCP, payload, force sensor, speed slider."""
    r, c = RTDEReceiveInterface(host), RTDEControlInterface(host)
    io = import_module("rtde_io").RTDEIOInterface(host)
    wait_for(lambda: any(c.getActualToolFlangePose()))  # zeros until the controller's first answer is read
    some_cycles(r)
    flange, bare = c.getActualToolFlangePose(), r.getActualTCPPose()
    out: dict[str, Any] = {"offset_before": c.getTCPOffset(), "setTcp": c.setTcp([0.0, 0.0, 0.1, 0.0, 0.0, 0.0])}
    out["offset"] = c.getTCPOffset()
    c.getActualToolFlangePose()
    some_cycles(r)
    out |= {"flange": flange, "flange_after": c.getActualToolFlangePose(), "bare": bare, "tcp": r.getActualTCPPose()}
    wait_for(lambda: math.hypot(*r.getActualTCPForce()) < 1e-9)
    ask(do="push", wrench=[0, 0, 10, 0, 0, 0])
    out["pushed"] = wait_for(lambda: abs(math.hypot(*r.getActualTCPForce()[:3]) - 10.0) < 1e-6)
    out["zeroed"] = c.zeroFtSensor() and wait_for(lambda: math.hypot(*r.getActualTCPForce()) < 1e-9)
    out["setPayload"] = c.setPayload(1.5, [0.0, 0.01, 0.05])
    out["payload_seen"] = wait_for(lambda: r.getPayload() == 1.5 and r.getPayloadCog() == [0.0, 0.01, 0.05])
    out["setTargetPayload"] = c.setTargetPayload(2.0, [0.0, 0.0, 0.06], [0.1, 0.2, 0.3, 0.0, 0.0, 0.0])
    out["inertia_seen"] = wait_for(lambda: r.getPayloadInertia()[:3] == [0.1, 0.2, 0.3])
    out["setSpeedSlider"] = io.setSpeedSlider(0.25)
    out["slider_seen"] = wait_for(lambda: r.getTargetSpeedFraction() == 0.25)
    c.stopScript()
    return out


SCENARIOS: dict[str, Callable[[str], dict[str, Any]]] = {f.__name__: f for f in (receive, moves, kinematics, settings)}

if __name__ == "__main__":
    sys.stdout.write("@result " + json.dumps(SCENARIOS[sys.argv[1]](sys.argv[2])) + "\n")
    sys.stdout.flush()
