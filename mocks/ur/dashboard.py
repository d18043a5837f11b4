"""The dashboard server's answers: one line in, one line out.

Source: Universal Robots, "Dashboard Server e-Series, port 29999". Wording matters: clients compare it.
"""

from mocks.ur.robot import Robot, Runtime, SafetyMode

BANNER = "Connected: Universal Robots Dashboard Server"
BUILD = 1261331

_TOO_EARLY = (
    "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking"
)


def answer(robot: Robot, line: str) -> str:
    """Carry out one dashboard command and return the reply, without line end."""
    command = line.strip()
    verb = command.lower()
    queries = {
        "polyscopeversion": lambda: f"URSoftware {'.'.join(map(str, robot.settings.polyscope))}.{BUILD} (Mar 24 2022)",
        "get serial number": lambda: robot.settings.serial_number,
        "get robot model": lambda: robot.settings.model.rstrip("e"),
        "is in remote control": lambda: str(robot.remote_control).lower(),
        "robotmode": lambda: f"Robotmode: {robot.robot_mode.name}",
        "safetymode": lambda: f"Safetymode: {robot.safety_mode.name}",
        "safetystatus": lambda: f"Safetystatus: {robot.safety_mode.name}",
        "running": lambda: f"Program running: {str(robot.runtime == Runtime.PLAYING).lower()}",
        "programstate": lambda: f"{robot.runtime.name} {robot.program_name}",
        "isprogramsaved": lambda: f"true {robot.program_name}",
        "get loaded program": lambda: (
            f"Loaded program: {robot.loaded_program}" if robot.loaded_program else "No program loaded"
        ),
    }
    if verb in queries:
        return queries[verb]()
    if verb == "stop":
        robot.stop_program("dashboard stop")
        return "Stopped"
    if verb == "play":
        return "Starting program" if robot.play() else "Failed to execute: play"
    if verb == "pause":
        return "Pausing program" if robot.pause() else "Failed to execute: pause"
    if verb == "unlock protective stop":
        return "Protective stop releasing" if robot.unlock() else _TOO_EARLY
    if verb == "power on":
        robot.power_on()
        return "Powering on"
    if verb == "power off":
        robot.power_off()
        return "Powering off"
    if verb == "brake release":
        robot.brake_release()
        return "Brake releasing"
    if verb == "restart safety":
        if robot.safety_mode != SafetyMode.NORMAL:
            robot.power_off()
        return "Restarting safety"
    if verb.startswith("load "):
        robot.stop_program("another program loaded")
        robot.loaded_program = command[5:].strip()
        return f"Loading program: {robot.loaded_program}"
    talk = {
        "popup": "showing popup",
        "close popup": "closing popup",
        "close safety popup": "closing safety popup",
        "addtolog": "Added log message",
        "quit": "Disconnected",
        "shutdown": "Shutting down",
    }
    for start, reply in talk.items():
        if verb == start or verb.startswith(start + " "):
            return reply
    return f"could not understand: '{command}'"
