"""JSON files changed by hand, by a person who then deletes what reveals it."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any


def edit(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the object in a file; its checksum and the id of a calibration go."""
    document = json.loads(path.read_text())
    change(document)
    for name in ("checksum", "id"):
        document.pop(name, None)
    path.write_text(json.dumps(document))
