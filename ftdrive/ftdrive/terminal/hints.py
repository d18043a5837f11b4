"""Commands in messages, as the user can type them."""

import os
import re
from typing import Final

COMMANDS: Final = (
    *("demo", "init", "config", "plan", "calibrate", "verify", "doctor", "devices", "solve", "report", "live", "push"),
    *("record", "history", "fleet", "diff", "convert", "compensate", "stream", "replay", "bundle", "export"),
    "transcript",
)
"""Those of `ftdrive.cli`, which this module cannot import."""
_COMMAND = re.compile(rf"(?<![\w./-])(?<!uv run )ftdrive (?=(?:{'|'.join(COMMANDS)})\b)")


def as_typed(text: str) -> str:
    """Return a message whose commands begin with `uv run` if this program was started so: nothing else would work."""
    return _COMMAND.sub("uv run ftdrive ", text) if "UV_RUN_RECURSION_DEPTH" in os.environ else text  # uv run sets it
