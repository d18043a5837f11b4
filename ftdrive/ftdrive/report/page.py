"""A report as a self-contained HTML page."""

import re
from typing import TYPE_CHECKING

from ftdrive import __version__
from ftdrive.errors import ConfigError
from ftdrive.report.sections import Facts, capitalized, sections_of
from ftdrivers.installation import missing_extra

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup


def render_page(facts: Facts) -> str:
    """Return a report as an HTML page, from the facts of `facts_of`. Raises `ConfigError` if jinja2 is missing."""
    environment = templates("ftdrive.report", "a report in HTML", "report", "--format json")
    from markupsafe import Markup

    from ftdrive.report.figures import draw_figure

    sections = sections_of(facts)
    environment.filters["sentence"] = lambda text: with_code(capitalized(text))
    drawn = {one.name: Markup(draw_figure(one.name, facts)) for section in sections for one in section.figures}
    template = environment.get_template("report.html.j2")
    return template.render(facts=facts, sections=sections, drawn=drawn, version=__version__)


def templates(package: str, what: str, extra: str, instead: str) -> "Environment":
    """Return the HTML templates in a Python package, which escape every value that they show.

    Raises
    ------
    ConfigError
        jinja2 is not installed. The message says that `what` needs it, and to install `extra` or give `instead`.
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
    """Escape a text for HTML, and turn text between backticks into code elements."""
    from markupsafe import Markup, escape

    return Markup(re.sub(r"`([^`]*)`", r"<code>\1</code>", str(escape(text))))
