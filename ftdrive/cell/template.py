"""The text of a new `ftdrive.toml`: what was found and asked, and in comments what is still to be measured."""

from collections.abc import Sequence

from ftdrive.cell.config import FORMAT, CellConfig, Rows, as_toml


def cell_file(cell: CellConfig, found: Sequence[str]) -> str:
    """Write a cell as a file with comments; `workcell.measured` is false in it, whatever the cell says.

    Parameters
    ----------
    cell : CellConfig
        What stays at its default is written as a comment, so that the user's file still counts.
    found : sequence of str
        What the devices said of themselves.
    """
    robot, sensor, tool, workcell = cell.robot, cell.sensor, cell.tool, cell.workcell
    lines = [
        f'format = "{FORMAT}"',
        "",
        *(f"# {_one_line(words)}" for words in found),
        "# What counts in the end, and where it comes from: ftdrive config show --origin",
        "",
        "[robot]",
        _line("host", robot.host),
        _line("model", robot.model, "checked against the controller where it can tell"),
        _line("serial", robot.serial, "of the arm: where it is said, nothing moves on another"),
        _line("speed_deg_s", robot.speed_deg_s, "of the fastest joint, 60 at most; the first run of a plan is slower"),
        _line("# acceleration_deg_s2", robot.acceleration_deg_s2),
        _line("# tip_speed_mm_s", robot.tip_speed_mm_s, "of the tool's farthest point, 250 at most"),
        "",
        "[sensor]",
        _line("url", sensor.url),
        _line("# sign", sensor.sign, "-1 for a sensor that reports the reaction: ftdrive doctor --push tells"),
        _line("height_mm", sensor.height_mm, "of its origin above the flange face"),
        _line("mass_kg", sensor.mass_kg, "of sensor and adapter: scale or datasheet; the sensor cannot weigh itself"),
        "",
        "[tool]",
        _line("name", tool.name),
        "# Everything mounted on the flange: from, to, diameter in mm from the flange face; two more numbers put the",
        "# axis aside (x, y). Measure cables, cameras and screws too: what is not in here may collide.",
        *_rows("cylinders_mm", tool.cylinders_mm),
        "# Of what hangs on the sensor, about. Checked against it: the controller's payload, the sensor's range, and",
        "# until the tool is known every change of the wrench: one that is more than it can weigh stops the arm.",
        _line("mass_kg", tool.mass_kg),
        "",
        "[workcell]",
        _line("mounting", workcell.mounting, "floor, wall, ceiling, or degrees it leans towards its -x: 90 is wall"),
        "# PLACEHOLDERS until measured: mm from the centre of the base, in its axes; what it stands on is known.",
        "# Planes, [nx, ny, nz, mm]: the arm stays where normal times point is mm or more; [-1, 0, 0, -800] is a wall",
        "# 800 mm away towards +x. Boxes, [x, y, z, x, y, z]: two opposite corners of a block.",
        *_rows("planes_mm", workcell.planes_mm),
        *_rows("boxes_mm", workcell.boxes_mm),
        "# Set it to true when cylinders, planes and boxes are measured and complete: nothing moves before.",
        "measured = false",
        "",
        "[sampling]",
        "# How long to average at each pose is chosen from a record of the sensor at rest, before the tour.",
        _line("# noise_record_s", cell.sampling.noise_record_s, "how long that record is; 0 for none"),
        _line("# average_s", cell.sampling.average_s, "said alone: average so long, without a record"),
        "",
        "[site]",
        _line("# g_m_s2", cell.site.g_m_s2, "local gravity"),
    ]
    return "".join(f"{line}\n" for line in lines)


def _line(key: str, value: object, why: str = "") -> str:
    text = f"# {key} =" if value is None else f"{key} = {as_toml(value)}"
    return f"{text:<32} # {why}" if why else text


def _rows(key: str, rows: Rows) -> list[str]:
    return [f"{key} = [", *(f"  {as_toml(row)}," for row in rows), "]"] if rows else [f"{key} = []"]


def _one_line(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)
