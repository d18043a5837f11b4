"""Frame and stages of a stream as parameters of a Foxglove server."""

from collections.abc import Callable
from dataclasses import asdict

from foxglove import Parameter
from foxglove.websocket import Client, ServerListener

from ftcalib.files import JSON
from ftdrive.errors import ConfigError
from ftdrive.live.processing import ProcessedStream
from ftdrive.live.samples import Stages, WrenchFrame
from ftdrive.servers.parameter_values import checked_value


class Parameters(ServerListener):
    """Lets clients read and set `axes`, `about` and each stage. Called in threads of the SDK.

    Parameters
    ----------
    stream : ProcessedStream
    warn : callable
        Receives the reason when a value is rejected; the parameters keep their values then.
    """

    def __init__(self, stream: ProcessedStream, warn: Callable[[str], None]) -> None:
        self._stream = stream
        self._warn = warn

    def on_get_parameters(
        self, _client: Client, param_names: list[str], _request: str | None = None
    ) -> list[Parameter]:
        """Return those named; all if there are no names."""
        frame, stages = self._stream.frame, asdict(self._stream.stages)
        values: dict[str, JSON] = {
            **frame.to_dict(),
            # A parameter cannot be None: a filter that is off has 0 Hz.
            **{name: 0.0 if value is None else value for name, value in stages.items()},
        }
        return [Parameter(name, value=value) for name, value in values.items() if name in (param_names or values)]

    def on_set_parameters(
        self, client: Client, parameters: list[Parameter], _request: str | None = None
    ) -> list[Parameter]:
        """Set them; return all as they are then."""
        frame, stages = asdict(self._stream.frame), asdict(self._stream.stages)
        try:
            for parameter in parameters:
                group = frame if parameter.name in frame else stages
                group[parameter.name] = checked_value(parameter.name, parameter.get_value())
            self._stream.frame, self._stream.stages = WrenchFrame(**frame), Stages(**stages)
        except ConfigError as error:
            self._warn(str(error))
        return self.on_get_parameters(client, [])
