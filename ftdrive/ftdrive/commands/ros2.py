"""`ftdrive ros2`: publish the compensated wrench on ROS 2 topics."""

from collections.abc import Sequence
from contextlib import closing

import click

from ftdrive.commands.options import FRAME, SOURCE, SourceOptions
from ftdrive.stream.samples import WrenchFrame
from ftdrive.terminal.console import messages
from ftdrivers.ros2.middleware import ros2_module

_ROS_ARGS = "--ros-args"


class _RosCommand(click.Command):
    """A command that leaves `--ros-args` and all arguments after it to ROS; click does not parse them."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        start = args.index(_ROS_ARGS) if _ROS_ARGS in args else len(args)
        rest = super().parse_args(ctx, args[:start])
        ctx.params["ros_args"] = tuple(args[start:])
        return rest


@click.command(cls=_RosCommand)
@SOURCE
@FRAME
@click.option(
    _ROS_ARGS,
    "ros_args",
    metavar="...",
    help="ROS arguments, to the end of the line: -r __ns:=/cell_1, -p rate:=100.0, --params-file FILE.",
)
def ros2(source: SourceOptions, frame: WrenchFrame, ros_args: Sequence[str]) -> None:
    """Publish the raw and the compensated wrench on ROS 2 topics.

    The topics are ~/wrench_raw, ~/wrench, ~/contact, ~/status and /diagnostics, the services ~/tare and ~/undo_tare.
    `ros2 param describe` explains each parameter. While a device sends no samples or the calibration does not fit, no
    wrench is published and /diagnostics gives the reason. The arm is only read, never moved. Press Ctrl-C to stop.
    """
    ros2_module("rclpy")  # raise before any work if ROS is missing
    from ftdrive.servers.ros2 import Ros2Node  # needs rclpy

    given = source.path is not None
    calibration = source.calibration() if given else None
    cell = None if source.simulate else source.described.cell()
    try:
        with closing(Ros2Node(ros_args, frame=frame, tool=source.tool or "")) as node:
            calibration = calibration if given else source.calibration()
            messages.print(
                f"Node {node.name} publishes {node.name}/wrench in {node.parameters.frame}, at most "
                f"{node.fixed.rate:g} Hz, {'reliable' if node.fixed.reliable else 'best effort'}. Press Ctrl-C to stop."
            )
            node.serve(lambda: source.stream(cell, calibration, node.parameters.tool))
    except KeyboardInterrupt:
        messages.print("The node has ended.")
