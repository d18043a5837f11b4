"""One report as a page or as JSON."""

import json
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal

from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrive.report.document import Section, capital
from ftdrive.report.figures import draw
from ftdrive.report.sections import sections_of
from ftdrivers.installation import missing_extra

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def page(facts: Mapping[str, Any], sections: Sequence[Section]) -> str:
    """Write the page. Raises `ConfigError` without the extra `report`."""
    environment = templates("ftdrive.report", "a report in HTML", "report", "--format json")
    from markupsafe import Markup

    environment.filters["sentence"] = lambda text: with_code(capital(text))
    drawn = {one.name: Markup(draw(one.name, facts)) for section in sections for one in section.figures}
    template = environment.get_template("report.html.j2")
    return template.render(facts=facts, sections=sections, drawn=drawn, version=__version__)


def templates(package: str, what: str, extra: str, instead: str) -> "Environment":
    """Return the templates of a package, which escape every value.

    Raises
    ------
    ConfigError
        jinja2 is not installed: `what` needs it, `extra` has it, and the option `instead` does without it.
    """
    try:
        from jinja2 import Environment, PackageLoader, StrictUndefined
    except ImportError:
        raise ConfigError(f"{missing_extra(what, 'jinja2', extra)}, or give {instead}") from None
    return Environment(
        loader=PackageLoader(package),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def with_code(text: str) -> "Markup":
    """Escape a text, and set what stands between backticks as code."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))


Format = Literal["html", "json"]


def report(facts: Mapping[str, Any], form: Format = "html") -> str:
    """Write the report of these facts.

    Parameters
    ----------
    facts : mapping
        From `ftdrive.report.facts.facts_of`.
    form : {"html", "json"}

    Returns
    -------
    str
        A self-contained page, or the facts as one JSON object.

    Raises
    ------
    ConfigError
        A page is asked for without the extra `report`.
    """
    if form == "json":
        return json.dumps(facts, allow_nan=False) + "\n"
    return page(facts, sections_of(facts))
