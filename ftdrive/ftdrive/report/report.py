"""One report in one of its formats."""

import json
from collections.abc import Mapping
from typing import Any, Literal

from ftdrive.report.markdown import markdown
from ftdrive.report.page import page
from ftdrive.report.sections import sections_of

Format = Literal["html", "md", "json"]


def report(facts: Mapping[str, Any], form: Format = "html") -> str:
    """Write the report of these facts.

    Parameters
    ----------
    facts : mapping
        From `ftdrive.report.facts.facts_of`.
    form : {"html", "md", "json"}

    Returns
    -------
    str
        A self-contained page, Markdown, or the facts as one JSON object.

    Raises
    ------
    ConfigError
        A page is asked for without the extra `report`.
    """
    if form == "json":
        return json.dumps(facts, allow_nan=False) + "\n"
    sections = sections_of(facts)
    return markdown(facts, sections) if form == "md" else page(facts, sections)
